"""Webhooks reach public addresses and named networks only, on the address connected to."""

import ipaddress
import socket
import ssl
import subprocess
from ipaddress import IPv6Address, ip_address, ip_network

import pytest

from service.errors import BadInput
from service.features.webhooks.addresses import (
    MAX_URL,
    NOT_PUBLIC,
    Refused,
    require_reachable,
    require_url,
)
from service.settings import networks
from tests.features.webhooks.conftest import HERE, receiving, serving
from tests.waiting import wait_until

LITERALS = [
    "https://127.0.0.1/",
    "https://127.255.255.254/",
    "https://10.0.0.1/",
    "https://172.16.0.1/",
    "https://192.168.1.1/",
    "https://169.254.169.254/latest/meta-data",
    "https://100.100.100.200/",
    "https://168.63.129.16/",
    "https://100.64.0.1/",
    "https://0.0.0.0/",
    "https://224.0.0.1/",
    "https://239.255.255.250/",
    "https://255.255.255.255/",
    "https://240.0.0.1/",
    "https://192.0.2.1/",
    "https://[::1]/",
    "https://[::]/",
    "https://[fe80::1]/",
    "https://[fc00::1]/",
    "https://[fd00:ec2::254]/",
    "https://[ff02::1]/",
    "https://[::ffff:127.0.0.1]/",
    "https://[::ffff:8.8.8.8]/",
    "https://[::127.0.0.1]/",
    "https://[2002:7f00:1::]/",
    "https://[2002:a00:1::1]/",
    "https://[64:ff9b::7f00:1]/",
    "https://[64:ff9b::a9fe:a9fe]/",
    "https://[64:ff9b:1::a00:1]/",
    "https://[2001:0:7f00:1::]/",
    "https://[2001:db8::1]/",
    "https://192.0.0.1/",
    "https://192.0.0.9/",
    "https://192.0.0.171/",
    "https://192.88.99.2/",
    "https://[3fff::1]/",
    "https://[3fff:fff:ffff:ffff::1]/",
    "https://[5f00::1]/",
    "https://[::ffff:0:8.8.8.8]/",
    "https://[100::1]/",
    "https://[100:0:0:1::1]/",
    "https://[64:ff9b::c000:1]/",
    "https://[64:ff9b::c0a8:101]/",
    "https://[2002:c0a8:101::1]/",
    "https://[2002:c000:1::1]/",
    "https://[2001:1::1]/",
    "https://[4000::1]/",
    "https://[fec0::1]/",
]
"""Each is refused by itself; those that stand for an IPv4 address, for that one."""

FORMS = [
    ("ftp://receiver.example/", "https"),
    ("file:///etc/passwd", "https"),
    ("http://receiver.example/", "https"),
    ("https://user:hunter2@receiver.example/", "user name"),
    ("https://receiver.example:22/", "port"),
    ("https://receiver.example:25/", "port"),
    ("https://receiver.example:1023/", "port"),
    ("https://receiver.example:6000/", "port"),
    ("https://receiver.example:6667/", "port"),
    ("https://receiver.example/#part", "fragment"),
    ("https:///path", "host"),
    ("receiver.example", "https"),
    ("https://receiver.example:99999/", "port"),
    ("https://[::1/", "URL"),
    ("https://0177.0.0.1/", "URL"),
    ("https://xn--a.example/", "URL"),
    ("https://xn--/", "URL"),
    ("https://receiver.example/".ljust(MAX_URL + 1, "a"), "characters"),
]

LOOPBACK = ["localhost", "2130706433", "0x7f000001", "127.1"]
"""Plain http to them is refused when it is asked for."""

NAMES = [
    "rebind.example",
    "mixed.example",
    "metadata.example",
    "mapped.example",
]
"""They are refused when they are resolved, by a name server of ours."""


@pytest.mark.parametrize("url", LITERALS)
def test_an_address_that_is_not_public_is_refused(url):
    with pytest.raises(BadInput) as refused:
        require_url(url, ())
    assert [fault.field for fault in refused.value.faults] == ["url"]


@pytest.mark.parametrize("answer", [True, False])
def test_the_table_of_this_python_decides_nothing(answer, monkeypatch):
    for kind in (ipaddress.IPv4Address, ipaddress.IPv6Address):
        for name in ("is_global", "is_private", "is_reserved", "is_multicast", "is_unspecified"):
            monkeypatch.setattr(kind, name, answer)
    for url in LITERALS:
        with pytest.raises(BadInput):
            require_url(url, ())
    for url in ("https://8.8.8.8/", "https://[2606:4700::1111]/", "https://[64:ff9b::808:808]/"):
        require_url(url, ())


def test_the_addresses_beside_a_special_network_are_public(rng):
    """Just outside of each network, unless another one is there; inside, all are refused."""
    for network in NOT_PUBLIC:
        first, size = int(network.network_address), network.num_addresses
        inside = {first, first + size - 1, *(first + int(rng.random() * size) for _ in range(20))}
        for each in inside:
            with pytest.raises(Refused):
                require_reachable(type(network.network_address)(each), ())
    for beside in (
        *("1.0.0.0", "9.255.255.255", "11.0.0.0", "100.63.255.255", "100.128.0.0"),
        *("126.255.255.255", "128.0.0.0", "169.253.255.255", "172.15.255.255", "172.32.0.0"),
        *("191.255.255.255", "192.0.1.0", "192.0.3.0", "192.88.98.255", "192.167.255.255"),
        *("198.17.255.255", "198.20.0.0", "198.51.101.0", "203.0.114.0", "223.255.255.255"),
        *("2001:200::", "2001:db7:ffff::", "2001:db9::", "3ffe:ffff::", "3fff:1000::", "2000::"),
    ):
        require_reachable(ip_address(beside), ())


REGISTRIES = networks(
    "0.0.0.0/8, 0.0.0.0/32, 10.0.0.0/8, 100.64.0.0/10, 127.0.0.0/8, 169.254.0.0/16, 172.16.0.0/12,"
    "192.0.0.0/24, 192.0.0.0/29, 192.0.0.8/32, 192.0.0.9/32, 192.0.0.10/32, 192.0.0.170/32,"
    "192.0.0.171/32, 192.0.2.0/24, 192.88.99.0/24, 192.88.99.2/32, 192.168.0.0/16, 198.18.0.0/15,"
    "198.51.100.0/24, 203.0.113.0/24, 240.0.0.0/4, 255.255.255.255/32,"
    "::1/128, ::/128, ::ffff:0:0/96, 64:ff9b:1::/48, 100::/64, 100:0:0:1::/64, 2001::/23,"
    "2001::/32, 2001:1::1/128, 2001:1::2/128, 2001:1::3/128, 2001:2::/48, 2001:3::/32,"
    "2001:4:112::/48, 2001:10::/28, 2001:20::/28, 2001:30::/28, 2001:db8::/32, 3fff::/20,"
    "5f00::/16, fc00::/7, fe80::/10"
)
"""Every block of IANA's two registries of special-purpose addresses but those below."""
REACHABLE = networks("192.31.196.0/24, 192.52.193.0/24, 192.175.48.0/24, 2620:4f:8000::/48")
"""Blocks that the registries call globally reachable, outside of a block that is not."""
OF_IPV4 = {"64:ff9b::/96": 0, "2002::/16": 80}
"""Blocks whose addresses are as public as the IPv4 address that they carry, so many bits up."""


def test_each_block_of_the_registries_is_refused_or_reachable_as_they_say(rng):
    def some(network):
        size = network.num_addresses
        places = {0, size - 1, *(int(rng.random() * size) for _ in range(20))}
        return [network[place] for place in places]

    for each in REGISTRIES:
        for address in some(each):
            with pytest.raises(Refused):
                require_reachable(address, ())
    for each in REACHABLE:
        for address in some(each):
            require_reachable(address, ())
    for block, bits in OF_IPV4.items():
        base = int(ip_network(block).network_address)
        for each in (each for each in REGISTRIES if each.version == 4):
            for inner in some(each):
                with pytest.raises(Refused):
                    require_reachable(IPv6Address(base | int(inner) << bits), ())
        require_reachable(IPv6Address(base | int(ip_address("8.8.8.8")) << bits), ())
    of_others = {"224.0.0.0/4", "ff00::/8", "::/96", "::ffff:0:0:0/96", "fec0::/10"}
    assert {str(each) for each in set(NOT_PUBLIC) - set(REGISTRIES)} == of_others


@pytest.mark.parametrize(("url", "said"), FORMS, ids=[url[:40] for url, _ in FORMS])
def test_another_form_of_url_is_refused(url, said):
    with pytest.raises(BadInput, match=said) as refused:
        require_url(url, ())
    assert [fault.field for fault in refused.value.faults] == ["url"]
    assert "hunter2" not in str(refused.value)


@pytest.mark.parametrize(
    "url",
    ["https://8.8.8.8/", "https://[2606:4700::1111]/", "https://x.y/", "https://x.y:1024/"],
)
def test_public_addresses_and_names_are_accepted(url):
    require_url(url, ())
    require_url(url.ljust(MAX_URL, "a"), ())


def test_a_setting_allows_networks_but_never_metadata():
    allowed = networks("10.0.0.0/8, 169.254.0.0/16, 127.0.0.2/32")
    require_url("http://10.1.2.3/", allowed)
    require_url("https://10.1.2.3:8443/", allowed)
    for refused in ("https://169.254.169.254/", "https://127.0.0.1/", "http://8.8.8.8/"):
        with pytest.raises(BadInput, match="url"):
            require_url(refused, allowed)
    with pytest.raises(Refused):
        require_reachable(ip_address("::ffff:10.1.2.3"), allowed)


def test_an_interface_beside_the_address_makes_no_other_address_of_it():
    allowed = networks("fd00::/8")
    require_url("https://[fd00::1]/", allowed)
    for refused in ("fd00:ec2::254", "fd00:ec2::254%25lo", "fd00:ec2::254%lo"):
        with pytest.raises(BadInput, match="never allowed"):
            require_url(f"https://[{refused}]/", allowed)


@pytest.fixture
def names(monkeypatch):
    """A name server of ours: a list of answers for each name, and what was looked up."""
    real, asked = socket.getaddrinfo, []
    answers = {
        "metadata.example": [["169.254.169.254"]],
        "mapped.example": [["::ffff:127.0.0.1"]],
        "mixed.example": [["127.0.0.2", "127.0.0.1"]],
        "rebind.example": [["127.0.0.2"], ["127.0.0.2"], ["127.0.0.1"]],
        "good.example": [["127.0.0.2"]],
        "xn--fa-hia.example": [["127.0.0.2"]],
    }

    def getaddrinfo(host, port, *given, **named):
        name = host.decode() if isinstance(host, bytes) else host
        if name not in answers:
            return real(host, port, *given, **named)
        asked.append(name)
        known = answers[name]
        found = known.pop(0) if len(known) > 1 else known[0]
        return [
            (socket.AF_INET6 if ":" in each else socket.AF_INET, 1, 6, "", (each, port))
            for each in found
        ]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    return asked


@pytest.fixture
def guarded(chosen_database):
    """A service that may reach 127.0.0.2 alone, which stands for the world."""
    with serving(chosen_database(), allowed="127.0.0.2/32") as service:
        yield service


def test_names_are_refused_on_the_address_that_they_resolve_to(guarded, names):
    with receiving("127.0.0.2") as world, receiving("127.0.0.1", world.port) as inside:
        for name in LOOPBACK:
            local = {"name": "local", "url": f"http://{name}:{world.port}/"}
            assert guarded.client.post(HERE, json=local).status_code == 422, name
        for name in NAMES:
            asked = {"name": name, "url": f"http://{name}:{world.port}/"}
            answer = guarded.client.post(HERE, json=asked)
            if answer.status_code == 422:
                assert name != "rebind.example"
                continue
            hook = answer.json()
            told = guarded.ask(hook, "test").json()
            if name == "rebind.example":
                # One look-up for each attempt, and its address is where the request goes.
                assert told["delivered"] is True
                assert names.count(name) == 2
                told = guarded.ask(hook, "test").json()
                assert names.count(name) == 3
            assert told["delivered"] is False, name
            assert told["fault"].startswith("refused: "), (name, told)
        assert inside.requests == []
        assert len(world.requests) == 1
        assert world.requests[0].headers["Host"] == f"rebind.example:{world.port}"


def test_a_name_is_looked_up_as_it_stands_in_the_url(guarded, names):
    # The name of 2008's faß; by the rules of 2003 that is fass, another owner's name.
    with receiving("127.0.0.2") as world:
        hook = guarded.hook(f"http://xn--fa-hia.example:{world.port}/")
        assert guarded.ask(hook, "test").json()["delivered"] is True
        assert names == ["xn--fa-hia.example"]
        assert world.requests[0].headers["Host"] == f"xn--fa-hia.example:{world.port}"


def test_redirects_are_not_followed_and_proxies_not_asked(guarded, names, monkeypatch):
    with receiving("127.0.0.2") as world, receiving("127.0.0.1") as inside:
        for name in ("http_proxy", "HTTP_PROXY", "ALL_PROXY"):
            monkeypatch.setenv(name, inside.url)
        hook = guarded.hook(f"http://good.example:{world.port}/")
        for status in (301, 302, 303, 307, 308):
            world.answer = lambda handler, _, status=status: handler.say(
                status, Location=inside.url
            )
            told = guarded.ask(hook, "test").json()
            assert told["fault"] == f"status {status}: redirects are not followed"
        assert inside.requests == []
        assert len(world.requests) == 5


def test_plain_http_is_for_named_networks_alone(chosen_database):
    with serving(chosen_database(), allowed="") as service:
        for url in ("http://receiver.example/", "https://127.0.0.1/", "https://u:p@x.example/"):
            answer = service.client.post(HERE, json={"name": "n", "url": url})
            assert answer.status_code == 422
            assert [each["field"] for each in answer.json()["errors"]] == ["url"]


@pytest.fixture
def certificate(tmp_path):
    """A certificate for good.example that signs itself, and its key."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    command += ["-subj", "/CN=good.example", "-addext", "subjectAltName=DNS:good.example"]
    made = subprocess.run(
        [*command, "-keyout", key, "-out", certificate], capture_output=True, check=False
    )
    assert made.returncode == 0, made.stderr
    return certificate, key


def test_the_certificate_must_be_that_of_the_name(certificate, names, monkeypatch, chosen_database):
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)

    def wrap(listening):
        return context.wrap_socket(listening, server_side=True)

    with (
        receiving("127.0.0.2", wrap=wrap) as world,
        serving(chosen_database(), allowed="127.0.0.2/32") as service,
    ):
        good = service.hook(f"https://good.example:{world.port}/")
        assert service.ask(good, "test").json()["delivered"] is True
        other = service.hook(f"https://rebind.example:{world.port}/")
        fault = service.ask(other, "test").json()["fault"]
        assert "certificate" in fault
        assert len(world.requests) == 1
        assert wait_until(lambda: service.read(other))["last_fault"] is None
