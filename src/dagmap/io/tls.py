"""The three PEM files of a session between robots, looked at before it is opened.

Zenoh says nothing where a handshake fails: a robot with a wrong file would only be alone.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.types import PublicKeyTypes
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import NameOID

from ..model import NetworkError
from .settings import TlsConfig

_MOST = 1 << 20  # bytes of a file
_MADE = {
    "ca": "the ca.pem that `dagmap keys enroll` made",
    "certificate": "the tls.pem that `dagmap keys enroll` or `dagmap keys renew` made",
    "key": "the robot.key that `dagmap keys enroll` made",
}


def tls_doubts(tls: TlsConfig, folder: Path, now: datetime) -> list[tuple[Path, str]]:
    """What keeps others from this robot although its files can be used: (file, why and remedy).

    folder: that of the robot's file. now: with a time zone; a robot's clock may be wrong, so that
    a certificate has expired is a doubt, no error. Raises NetworkError, with file and remedy,
    where a file cannot be read, others can read the key, or it is another certificate's.
    """
    ca, path, key = (folder / name for name in (tls.ca, tls.certificate, tls.key))
    authorities, chain = _certificates("ca", ca), _certificates("certificate", path)
    if _public_key(key) != _key_bytes(chain[0].public_key()):
        raise NetworkError(
            f"network.tls.certificate: {path} is not of the key in {key}; name the two files of "
            "one robot, or make the certificate anew with: dagmap keys renew"
        )
    return [(path, why) for why in _doubts(chain, authorities, ca, now)]


def _doubts(
    chain: list[x509.Certificate], authorities: list[x509.Certificate], ca: Path, now: datetime
) -> Iterator[str]:
    """chain: the robot's certificate, and what is between it and the authority."""
    own = chain[0]
    names = own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    name = next((entry.value for entry in names if isinstance(entry.value, str)), "NAME")
    remedy = f"renew it with: dagmap keys renew {name}"
    if now > own.not_valid_after_utc:
        yield f"it expired {own.not_valid_after_utc:%Y-%m-%d}, if the clock is right; {remedy}"
    if now < own.not_valid_before_utc:
        first = f"{own.not_valid_before_utc:%Y-%m-%d}"
        yield f"it is not valid before {first}: set the clock right, or {remedy}"
    if not any(_issued(one, authority) for one in chain for authority in authorities):
        yield f"no authority in {ca} has signed it; name the ca.pem of its fleet, or {remedy}"


def _issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, InvalidSignature):
        return False
    except (TypeError, UnsupportedAlgorithm):  # of a kind that only Zenoh can judge
        return True
    return True


def _certificates(part: str, path: Path) -> list[x509.Certificate]:
    data, _ = _read(part, path)
    try:
        return x509.load_pem_x509_certificates(data)
    except ValueError:
        raise NetworkError(
            f"network.tls.{part}: {path} holds no X.509 certificate in PEM; name {_MADE[part]}"
        ) from None


def _public_key(path: Path) -> bytes:
    """That of a private key which nobody else on this machine can read."""
    data, mode = _read("key", path)
    if mode & 0o077:
        raise NetworkError(
            f"network.tls.key: others on this machine can use {path} (mode {mode:04o}); close it "
            f"with: chmod 600 {path} (and make a new one where somebody may have copied it)"
        )
    try:
        return _key_bytes(load_pem_private_key(data, password=None).public_key())
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise NetworkError(
            f"network.tls.key: {path} holds no private key in PEM without a password; name "
            f"{_MADE['key']}"
        ) from None


def _key_bytes(key: PublicKeyTypes) -> bytes:
    return key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)


def _read(part: str, path: Path) -> tuple[bytes, int]:
    """A file and its mode."""
    try:
        with path.open("rb") as file:
            return file.read(_MOST), stat.S_IMODE(path.stat().st_mode)
    except FileNotFoundError:
        raise NetworkError(f"network.tls.{part}: {path} is missing; correct the path") from None
    except OSError as error:
        raise NetworkError(
            f"network.tls.{part}: {path} cannot be read ({error.strerror}); correct it"
        ) from None
