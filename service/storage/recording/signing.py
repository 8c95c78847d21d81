"""Signing heads of the record with Ed25519; the key is never in the database."""

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import BadConfiguration
from service.extras import require_extra

if TYPE_CHECKING:
    # The library comes with an extra.
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

SETTING = "ACQUIRE_RECORD_KEY"
_BEGIN = "-----BEGIN"


class Signer:
    """Signer with an Ed25519 private key, from a private PEM file or from PEM text."""

    def __init__(self, key: str) -> None:
        """Load the private key; raises `BadConfiguration`, or `NotAvailable` without the extra."""
        require_extra("sign", "cryptography", SETTING, "a key")
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519

        # The text is a secret: it must not appear in messages.
        text = key if key.startswith(_BEGIN) else _private_text(Path(key))
        try:
            loaded = serialization.load_pem_private_key(text.encode(), None)
        except (ValueError, TypeError):
            raise BadConfiguration(
                f"{SETTING}: is no private key in PEM without a password"
            ) from None
        if not isinstance(loaded, ed25519.Ed25519PrivateKey):
            raise BadConfiguration(f"{SETTING}: must be a key of Ed25519")
        self._key: Ed25519PrivateKey = loaded

    def sign(self, statement: bytes) -> str:
        """Ed25519 signature of a statement, in hexadecimal digits."""
        return self._key.sign(statement).hex()


class PublicKey:
    """Ed25519 public key that checks signatures."""

    def __init__(self, file: Path) -> None:
        """Read a public key from a PEM file; raises `BadConfiguration` for any other file."""
        require_extra("sign", "cryptography", "--public-key", str(file))
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519

        try:
            loaded = serialization.load_pem_public_key(file.read_bytes())
        except OSError as error:
            raise BadConfiguration(f"--public-key: {file}: {error.strerror}") from None
        except ValueError:
            raise BadConfiguration(f"--public-key: {file}: is no public key in PEM") from None
        if not isinstance(loaded, ed25519.Ed25519PublicKey):
            raise BadConfiguration(f"--public-key: {file}: must be a key of Ed25519")
        self._key = loaded

    def has_signed(self, statement: bytes, signature: str | None) -> bool:
        """True if a statement has the given signature by this key."""
        from cryptography.exceptions import InvalidSignature

        try:
            self._key.verify(bytes.fromhex(signature or ""), statement)
        except (InvalidSignature, ValueError):
            return False
        return True


def make_key(file: Path) -> str:
    """Make a private key in a new file of mode 600; returns the public key in PEM."""
    require_extra("sign", "cryptography", "FILE", str(file))
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ed25519

    key = ed25519.Ed25519PrivateKey.generate()
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
        opened.write(private)
    public = key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    return public.decode()


def _private_text(file: Path) -> str:
    try:
        with file.open(encoding="ascii") as opened:
            mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
            if mode & 0o077:
                raise BadConfiguration(
                    f"{SETTING}: {file}: others may read it (mode {mode:o}): chmod 600 {file}"
                )
            return opened.read()
    except OSError as error:
        raise BadConfiguration(f"{SETTING}: {file}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise BadConfiguration(f"{SETTING}: {file}: is no key in PEM") from None
