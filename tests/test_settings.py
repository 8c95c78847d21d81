"""Settings come from the environment, and a mistake is named."""

from pathlib import Path

import pytest

from service.errors import BadConfiguration
from service.settings import Settings


def test_nothing_set_means_sqlite_here_and_loopback():
    settings = Settings.from_environment({})
    assert settings == Settings()
    assert (settings.database, settings.host, settings.port) == (
        "sqlite:///acquire.db",
        "127.0.0.1",
        8000,
    )


def test_every_setting_has_its_variable():
    assert Settings.from_environment(
        {
            "ACQUIRE_DATABASE": "postgresql://user@host/name",
            "ACQUIRE_MISSIONS": "/site/missions",
            "ACQUIRE_CATALOG": "/site/catalog.npz",
            "ACQUIRE_SHELF_MB": "64",
            "ACQUIRE_HOST": "::1",
            "ACQUIRE_PORT": "9000",
            "ACQUIRE_TOKEN": "acq_from-elsewhere",
            "ACQUIRE_PROBE_PORT": "9001",
            "ACQUIRE_CONNECTIONS_PER_ADDRESS": "32",
            "ACQUIRE_KEEP_ALIVE_SECONDS": "120",
            "ACQUIRE_TRUSTED_PROXIES": "10.1.2.3, 2001:db8::/32",
            "ACQUIRE_WEBHOOK_NETWORKS": "10.20.0.0/16",
            "ACQUIRE_ARCHIVE_FOLDER": "/archive",
            "ACQUIRE_FOLLOW": "tls://bus/TELEMETRY",
            "ACQUIRE_FOLLOW_CONSUMER": "ops",
            "ACQUIRE_FOLLOW_ANSWERS": "attitudes",
            "ACQUIRE_FOLLOW_CREDENTIALS": "/site/acquire.creds",
            "ACQUIRE_FOLLOW_AUTHORITY": "/site/bus.pem",
            "HOME": "/root",
        }
    ) == Settings(
        database="postgresql://user@host/name",
        missions=Path("/site/missions"),
        catalog=Path("/site/catalog.npz"),
        shelf_mb=64,
        host="::1",
        port=9000,
        token="acq_from-elsewhere",
        probe_port=9001,
        connections_per_address=32,
        keep_alive_seconds=120,
        trusted_proxies="10.1.2.3, 2001:db8::/32",
        webhook_networks="10.20.0.0/16",
        archive_folder=Path("/archive"),
        follow="tls://bus/TELEMETRY",
        follow_consumer="ops",
        follow_answers="attitudes",
        follow_credentials=Path("/site/acquire.creds"),
        follow_authority=Path("/site/bus.pem"),
    )


def test_an_empty_variable_counts_as_not_set():
    assert Settings.from_environment({"ACQUIRE_PORT": "", "ACQUIRE_CATALOG": ""}) == Settings()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("ACQUIRE_PORT", "http", "whole number"),
        ("ACQUIRE_PORT", "65536", "from 0 to 65535"),
        ("ACQUIRE_PROBE_PORT", "0", "from 1 to 65535"),
        ("ACQUIRE_PROBE_PORT", "8000", "another port than ACQUIRE_PORT"),
        ("ACQUIRE_CONNECTIONS_PER_ADDRESS", "0", "from 1 to"),
        ("ACQUIRE_KEEP_ALIVE_SECONDS", "0", "from 1 to"),
        ("ACQUIRE_TRUSTED_PROXIES", "proxy.example", "addresses or networks"),
        ("ACQUIRE_TRUSTED_PROXIES", "10.1.2.3/8", "addresses or networks"),
        ("ACQUIRE_WEBHOOK_NETWORKS", "10.20", "addresses or networks"),
        ("ACQUIRE_SHELF_MB", "0", "from 1 to"),
        ("ACQUIRE_SHELF_MB", "1.5", "whole number"),
        ("ACQUIRE_DATABASE", "   ", "must be a URL"),
        ("ACQUIRE_HOST", "http://here", "an address or a name"),
        ("ACQUIRE_DATABSE", "sqlite:///x.db", "ACQUIRE_DATABASE"),
    ],
)
def test_a_mistake_names_the_variable_and_what_is_allowed(name, value, said):
    with pytest.raises(BadConfiguration, match=said) as refusal:
        Settings.from_environment({name: value})
    assert name in str(refusal.value)
