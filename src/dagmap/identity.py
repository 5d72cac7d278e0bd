"""Who signs: an Ed25519 key and the 8-byte author id that follows from it."""

from __future__ import annotations

import hashlib

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import (
    Ed25519PrivateKey,
    Ed25519PublicKey,
)

from .model import AuthorId


class Identity:
    """A robot's private key. Its repr shows the author id, never the key."""

    def __init__(self, key: Ed25519PrivateKey, seed: bytes) -> None:
        self._key = key
        self.public_key = key.public_key().public_bytes_raw()
        self.author = author_of(self.public_key)
        salt = hashlib.blake2b(seed, digest_size=8, person=b"dagmap salt").digest()
        self.salt = int.from_bytes(salt, "little") >> 2  # keeps hash tables unguessable to others
        self._secret = hashlib.blake2b(seed, digest_size=32, person=b"dagmap secret").digest()

    @classmethod
    def from_seed(cls, seed: bytes) -> Identity:
        """The identity of a 32-byte secret. Raises ValueError for another length."""
        if len(seed) != 32:
            raise ValueError("Identity.from_seed wants 32 secret bytes")
        return cls(Ed25519PrivateKey.from_private_bytes(bytes(seed)), bytes(seed))

    def sign(self, message: bytes) -> bytes:
        """64 bytes of Ed25519 signature."""
        return self._key.sign(message)

    def secret(self, purpose: bytes) -> bytes:
        """32 bytes that only this robot knows, others for every purpose."""
        return hashlib.blake2b(purpose, digest_size=32, key=self._secret).digest()

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
