"""A nats-server of a test's own, with the files of its streams, TLS and a file of credentials."""

import base64
import json
import os
import shutil
import socket
import subprocess
import uuid
from contextlib import contextmanager

import nkeys
import pytest

from tests.waiting import wait_until
from tests.web.serving import free_port

BINARY = shutil.which("nats-server", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")


class NatsServer:
    """nats-server with JetStream; its port and its streams survive a kill."""

    def __init__(self, folder, scheme="nats", configuration=""):
        self.port = free_port()
        self.url = f"{scheme}://127.0.0.1:{self.port}"
        self._file = folder / "nats.conf"
        self._file.write_text(
            f"host: 127.0.0.1\nport: {self.port}\n"
            f"jetstream {{ store_dir: {json.dumps(str(folder / 'streams'))} }}\n{configuration}"
        )
        self.start()

    def start(self):
        self._process = subprocess.Popen(
            [BINARY, "--config", self._file], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wait_until(self._listens, 30.0)

    def _listens(self):
        assert self._process.poll() is None, "nats-server ended by itself"
        try:
            socket.create_connection(("127.0.0.1", self.port)).close()
        except OSError:
            return False
        return True

    def kill(self):
        self._process.kill()
        self._process.wait()


@contextmanager
def nats_server(folder, *arguments):
    if BINARY is None:
        pytest.skip("there is no nats-server on this machine")
    folder.mkdir()
    server = NatsServer(folder, *arguments)
    try:
        yield server
    finally:
        server.kill()


# ---- TLS and credentials ---------------------------------------------------------------------


def certificate(folder):
    """A certificate for 127.0.0.1 that signs itself, and its key."""
    made = folder / "certificate.pem", folder / "key.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    command += ["-subj", "/CN=bus", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([*command, "-out", made[0], "-keyout", made[1]], capture_output=True, check=True)
    return made


def tls(certificate, key):
    """The part of a configuration by which clients have to speak TLS."""
    return (
        f"tls {{ cert_file: {json.dumps(str(certificate))}, key_file: {json.dumps(str(key))} }}\n"
    )


class Account:
    """An operator with an account, whose users have files of credentials."""

    def __init__(self):
        self._operator = _key_pair(nkeys.PREFIX_BYTE_OPERATOR)
        self._account, self._system = (_key_pair(nkeys.PREFIX_BYTE_ACCOUNT) for _ in range(2))

    def configuration(self):
        """The part of a configuration by which clients need the credentials of a user."""
        operator = _signed(self._operator, self._operator, {"type": "operator"})
        named = ("subs", "data", "payload", "imports", "exports", "conn", "leaf")
        limits = dict.fromkeys(named, -1) | {"wildcards": True}
        # JetStream is not for the account of the system.
        stored = dict.fromkeys(("mem_storage", "disk_storage", "streams", "consumer"), -1)
        accounts = {self._system: limits, self._account: limits | stored}
        tokens = "\n".join(
            f"{_name(pair)}: {_signed(self._operator, pair, {'type': 'account', 'limits': given})}"
            for pair, given in accounts.items()
        )
        return (
            f"operator: {operator}\nsystem_account: {_name(self._system)}\n"
            f"resolver: MEMORY\nresolver_preload: {{\n{tokens}\n}}\n"
        )

    def credentials(self, file):
        """Write the credentials of a new user."""
        user = _key_pair(nkeys.PREFIX_BYTE_USER)
        unlimited = {"subs": -1, "data": -1, "payload": -1}
        token = _signed(self._account, user, {"type": "user"} | unlimited)
        parts = (("NATS USER JWT", token), ("USER NKEY SEED", user.seed.decode()))
        file.write_text(
            "".join(
                f"-----BEGIN {name}-----\n{text}\n------END {name}------\n\n"
                for name, text in parts
            )
        )
        return file


def _key_pair(prefix):
    return nkeys.from_seed(nkeys.encode_seed(os.urandom(32), prefix))


def _name(pair):
    return pair.public_key.decode()


def _signed(issuer, subject, content):
    """A token of NATS: who issues it says what another one may."""
    claims = {
        "jti": uuid.uuid4().hex,
        "iat": 1_700_000_000,
        "iss": _name(issuer),
        "sub": _name(subject),
        "nats": content | {"version": 2},
    }
    header = {"typ": "JWT", "alg": "ed25519-nkey"}
    signed = ".".join(_encoded(json.dumps(each).encode()) for each in (header, claims))
    return f"{signed}.{_encoded(issuer.sign(signed.encode()))}"


def _encoded(content):
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()
