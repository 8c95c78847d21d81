"""App on a database, and submissions to give to them."""

import pytest

from service.app.factory import open_app
from service.missions.motion import GyroSettings
from service.settings import Settings
from service.storage.recording.signing import PublicKey, make_key
from service.storage.upkeep.verify import verify
from tests.storage import samples, sealed


@pytest.fixture
def opened(database, tmp_path):
    """Opens operations on the test's database, as often as asked; all are closed at the end."""
    held = []

    def open_operations(mission=None, **wanted):
        # Processes of their own take seconds to start: only tests about them ask for some.
        usual = {"database": database, "replay_processes": 0}
        # With PostgreSQL uploads are stored in the working folder, which all tests share.
        if not database.startswith("sqlite"):
            usual["spool"] = tmp_path / "spool"
        settings = Settings(**(usual | wanted))
        held.append(open_app(settings, mission))
        return held[-1]

    yield open_operations
    for app in held:
        app.close()


@pytest.fixture
def app(opened):
    """App on a database of their own."""
    return opened()


@pytest.fixture
def make(sky, missions):
    """Makes submissions: make("b1", kind="suspect", run="r", after_s=60)."""

    def submission(name="b1", **wanted):
        return samples.submission(sky, missions, name, **wanted)

    return submission


@pytest.fixture
def key(tmp_path):
    """A private key and the file of its public key."""
    (tmp_path / "public.pem").write_text(make_key(tmp_path / "key.pem"))
    return tmp_path / "key.pem", tmp_path / "public.pem"


@pytest.fixture
def signed(opened, make, key, missions):
    """Fills the test's database with results and rows of every kind, all in signed heads."""
    gyro = GyroSettings(sigma_v_rad_s0_5=3e-7, sigma_u_rad_s1_5=3e-10)
    mission = missions["XTE"].model_copy(update={"gyro": gyro})
    app = opened(mission, record_key=str(key[0]))
    sealed.fill(app, make, missions)
    app.close()
    return app


@pytest.fixture
def faults(database, key):
    """Faults of the database, with the key; `faults(public=False)` without."""

    def found(public=True, anchors=()):
        return verify(database, public_key=PublicKey(key[1]) if public else None, anchors=anchors)

    return found
