"""X.509 for the sessions between robots (TLS with mutual authentication), and nothing else.

The fleet key is the certificate authority, a robot's own key that of its leaf: Ed25519 throughout,
which rustls (and so Zenoh) takes. Expiry is judged here alone, when a session is opened; what a
transaction is worth never depends on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from ipaddress import ip_address

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_SLACK = timedelta(days=1)  # robots' clocks may be behind the one that signs


def make_authority(key: Ed25519PrivateKey, fleet: str, days: int) -> bytes:
    """PEM of the fleet's own certificate, signed by itself, valid for `days` from now on."""
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    builder = _begin(key.public_key(), fleet, fleet, days)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(usage, critical=True)
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    builder = builder.add_extension(identifier, critical=False)
    return builder.sign(key, None).public_bytes(Encoding.PEM)


def make_leaf(
    authority: Ed25519PrivateKey,
    fleet: str,
    public_key: bytes,
    name: str,
    addresses: Sequence[str],
    days: int,
) -> bytes:
    """PEM of a robot's certificate for both ends of a session, valid for `days` from now on.

    addresses: IP addresses and host names under which others connect, beside the robot's name;
    needed only where the connecting side checks names.
    """
    public = Ed25519PublicKey.from_public_bytes(public_key)
    both = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    names = x509.SubjectAlternativeName([_address(entry) for entry in (name, *addresses)])
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.public_key())
    builder = _begin(public, name, fleet, days)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
    builder = builder.add_extension(names, critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(both), critical=False)
    builder = builder.add_extension(issuer, critical=False)
    return builder.sign(authority, None).public_bytes(Encoding.PEM)


def valid_until(pem: bytes) -> datetime:
    """When a certificate expires. Raises ValueError where the bytes are no certificate."""
    return x509.load_pem_x509_certificate(pem).not_valid_after_utc


def _begin(
    public_key: Ed25519PublicKey, subject: str, issuer: str, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(timezone.utc)
    return (
        x509.CertificateBuilder()
        .subject_name(_named(subject))
        .issuer_name(_named(issuer))
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SLACK)
        .not_valid_after(now + timedelta(days=days))
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _address(entry: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(entry))
    except ValueError:
        pass
    if not entry or not entry.isprintable() or " " in entry:
        raise ValueError(f"{entry!r} is no IP address or host name")
    return x509.DNSName(entry)
