"""Who signs: an Ed25519 key, the 8-byte author id that follows from it, and in a closed fleet the
certificate with which the fleet key vouches for it.

    certificate: name of the robot (1 to 64 bytes of UTF-8, see text.py) | Ed25519 signature 64,
    the fleet key's over "dagmap certificate 1\\0" | fleet id 8 | public key of the robot 32 | name

It is a record of its own and no X.509, so that what is accepted depends on no library's parser, and
it does not expire, so that a later joiner accepts what the others have accepted.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import (
    Ed25519PrivateKey,
    Ed25519PublicKey,
)

from .config import Config
from .model import MAX_NAME, AuthorId, ConfigError
from .text import printable

_CERTIFIED = b"dagmap certificate 1\0"


class Identity:
    """A robot's private key. Its repr shows the author id, never the key.

    certificate: what a closed fleet demands (`dagmap keys enroll` makes it), else None.
    """

    def __init__(
        self, key: Ed25519PrivateKey, seed: bytes, certificate: bytes | None = None
    ) -> None:
        self._key = key
        self.certificate = certificate
        self.public_key = key.public_key().public_bytes_raw()
        self.author = author_of(self.public_key)
        salt = hashlib.blake2b(seed, digest_size=8, person=b"dagmap salt").digest()
        self.salt = int.from_bytes(salt, "little") >> 2  # keeps hash tables unguessable to others
        self._secret = hashlib.blake2b(seed, digest_size=32, person=b"dagmap secret").digest()

    @classmethod
    def from_seed(cls, seed: bytes, certificate: bytes | None = None) -> Identity:
        """The identity of a 32-byte secret. Raises ValueError for another length."""
        if len(seed) != 32:
            raise ValueError("Identity.from_seed wants 32 secret bytes")
        return cls(Ed25519PrivateKey.from_private_bytes(bytes(seed)), bytes(seed), certificate)

    @property
    def name(self) -> str | None:
        """What the certificate calls the robot, where there is one."""
        return None if self.certificate is None else self.certificate[:-64].decode()

    def sign(self, message: bytes) -> bytes:
        """64 bytes of Ed25519 signature."""
        return self._key.sign(message)

    def secret(self, purpose: bytes) -> bytes:
        """32 bytes that only this robot knows, others for every purpose."""
        return hashlib.blake2b(purpose, digest_size=32, key=self._secret).digest()

    def certify(self, fleet_id: bytes, public_key: bytes, name: str) -> bytes:
        """The certificate of another robot, where this is the fleet's own key.

        Raises ValueError where the name is not 1 to 64 bytes of printable UTF-8.
        """
        encoded = name.encode()
        if not 0 < len(encoded) <= MAX_NAME or not printable(name):
            raise ValueError(f"name {name!r}: 1 to 64 bytes of printable UTF-8 are wanted")
        return encoded + self.sign(_CERTIFIED + fleet_id + public_key + encoded)

    def __repr__(self) -> str:
        return f"Identity({self.author.hex()})"


def author_of(public_key: bytes) -> AuthorId:
    """The author id of a public key: the first 8 bytes of its BLAKE2b-256."""
    return hashlib.blake2b(public_key, digest_size=32).digest()[:8]


def signature_holds(public_key: bytes, signature: bytes, message: bytes) -> bool:
    """Whether the signature over the message is the key's."""
    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


@lru_cache(maxsize=1024)  # whoever shows a robot's certificate again costs no second check of it
def certificate_holds(
    certificate: bytes, fleet_key: bytes, fleet_id: bytes, public_key: bytes
) -> bool:
    """Whether the fleet key vouches with this certificate for this public key."""
    name, signature = certificate[:-64], certificate[-64:]
    message = _CERTIFIED + fleet_id + public_key + name
    return bool(name) and signature_holds(fleet_key, signature, message)


def check_certificate(identity: Identity, config: Config) -> None:
    """Raises ConfigError where the fleet is closed and the identity has no certificate of it.

    Such a robot would be heard by nobody.
    """
    certificate, remedy = identity.certificate, "enroll the robot (dagmap keys enroll)"
    if not config.closed:
        return
    if certificate is None:
        raise ConfigError(
            f"Config: fleet_key closes the fleet {config.fleet!r}, but {identity} has no "
            f"certificate; {remedy} and load its folder"
        )
    holds = certificate_holds(
        certificate, config.fleet_public_key, config.fleet_id, identity.public_key
    )
    if not holds:
        raise ConfigError(
            f"Config: the certificate of {identity} is not one of the fleet {config.fleet!r} with "
            f"fleet_key = {config.fleet_key!r}; {remedy} in that fleet, or correct both keys"
        )
    name = identity.name
    if config.name not in ("", name):
        raise ConfigError(
            f"Config: name = {config.name!r}, but the certificate names the robot {name!r}; "
            "leave the name out"
        )
