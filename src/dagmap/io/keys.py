"""Keys on disk: the folder of a fleet, and what each robot takes along.

    fleet folder                                robot folder
    fleet.key     the fleet's private key       robot.key    the robot's private key
    fleet.toml    fleet, fleet_key, ...         robot.toml   its name, and all of fleet.toml
    ca.pem        X.509 authority for TLS       certificate  hexadecimal, see identity.py
    robots/       NAME.json, who is enrolled    tls.pem, ca.pem
    revocations/  0000.tx, 0001.tx, ...         revocations/  copies; see revocations.py

Private keys are PEM (PKCS8), made with mode 0600 from the start, and not read where others can read
them. A folder appears whole or not at all. The fleet's folder belongs in one place: revocations are
a chain, and two that are made with one number would prove a fork of the fleet key.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ..config import Config, load_config
from ..identity import Identity, author_of, certificate_holds
from ..model import MAX_NAME, AuthorId, ConfigError, KeysError
from ..payload import MAX_SEQUENCE, Payload, Revocation
from ..text import printable
from ..transaction import Transaction, parse, seal
from ..wire import Refusal
from .certificates import make_authority, make_leaf, valid_until

AUTHORITY_DAYS = 3650
_MAX_KEY = 4096  # bytes of a key file
_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")  # names of robots become file names
_FLEET_TOML = """\
# What the configuration of every robot of this fleet must hold alike. Parameters that are the
# fleet's ([fold], [transaction], n_p and n_c_max of [graph]) belong here too, where they are not
# the defaults: revocations are made by them.
fleet = {quoted}
fleet_key = "{key}"
"""


@dataclass(frozen=True, slots=True)
class Enrolled:
    """A robot as its fleet knows it."""

    name: str
    author: AuthorId
    public_key: bytes


@dataclass(frozen=True, slots=True)
class Robot:
    """What a robot's folder holds."""

    folder: Path
    name: str
    identity: Identity
    config: Config
    tls_until: datetime


class Fleet:
    """The folder of a fleet, with its private key. All methods raise KeysError."""

    def __init__(self, folder: Path, config: Config, key: Ed25519PrivateKey) -> None:
        """Use `create_fleet` or `open_fleet`."""
        self.folder, self.config, self._key = folder, config, key
        self.identity = Identity.from_seed(key.private_bytes_raw())

    def robots(self) -> dict[str, Enrolled]:
        """Who is enrolled, by name."""
        found = {}
        for path in sorted((self.folder / "robots").glob("*.json")):
            try:
                public_key = bytes.fromhex(json.loads(_read(path))["public_key"])
                if len(public_key) != 32:
                    raise ValueError("no key")
            except (ValueError, KeyError, TypeError):
                raise KeysError(f"{path}: damaged; restore the folder from a backup") from None
            found[path.stem] = Enrolled(path.stem, author_of(public_key), public_key)
        return found

    def enroll(self, name: str, out: Path, days: int, addresses: Sequence[str] = ()) -> Enrolled:
        """Make a robot's folder `out`: its key, the fleet's certificate for it, TLS for `days`.

        A folder that is there but not on the fleet's list, since something ended the command
        before that was written, is put on it as it is.
        """
        if _FILE_NAME.fullmatch(name) is None:
            raise KeysError(
                f"name {name!r}: 1 to 63 letters, digits, dots, dashes and underscores are wanted, "
                "a letter or digit first"
            )
        if name in self.robots():
            raise KeysError(
                f"{self.folder}: {name} is enrolled already; take another name, or renew its TLS "
                f"certificate with: dagmap keys renew {name}"
            )
        unlisted = self._unlisted(name, out)
        if unlisted is not None:
            return self._list(name, unlisted)
        key = Ed25519PrivateKey.generate()
        public_key = key.public_key().public_bytes_raw()
        certificate = self.identity.certify(self.config.fleet_id, public_key, name)
        with _new_folder(out) as folder:
            _write_new(folder / "robot.key", _pem(key), 0o600)
            _write_new(folder / "certificate", certificate.hex().encode() + b"\n")
            lines = f'name = "{name}"\n\n'.encode() + _read(self.folder / "fleet.toml")
            _write_new(folder / "robot.toml", lines)
            _write_new(folder / "tls.pem", self._leaf(public_key, name, addresses, days))
            _write_new(folder / "ca.pem", _read(self.folder / "ca.pem"))
            (folder / "revocations").mkdir()
        return self._list(name, public_key)

    def _unlisted(self, name: str, folder: Path) -> bytes | None:
        """Public key of the robot in a folder, where it is this fleet's and called so."""
        if not (folder / "robot.key").exists():
            return None
        try:
            robot = open_robot(folder)
        except KeysError:
            return None
        mine = (robot.name, robot.config.fleet_id) == (name, self.config.fleet_id)
        return robot.identity.public_key if mine else None

    def _list(self, name: str, public_key: bytes) -> Enrolled:
        """Last of all: a name that is on the list has a folder, and cannot be had again."""
        entry = json.dumps({"public_key": public_key.hex()}).encode() + b"\n"
        _write_new(self.folder / "robots" / f"{name}.json", entry)
        return Enrolled(name, author_of(public_key), public_key)

    def renew(self, name: str, out: Path, days: int, addresses: Sequence[str] = ()) -> datetime:
        """Write a new TLS certificate of a robot to the file `out`; returns when it expires."""
        robot = self._known(name)
        pem = self._leaf(robot.public_key, name, addresses, days)
        _write_new(out, pem)
        return valid_until(pem)

    def revocations(self) -> list[Transaction]:
        """The fleet key's chain as far as this folder has made it."""
        chain: list[Transaction] = []
        files = (self.folder / "revocations").glob("*.tx")
        for path in sorted(files, key=lambda path: (len(path.name), path.name)):
            try:
                tx = parse(_read(path), self.config)
            except Refusal as refusal:
                raise KeysError(f"{path}: {refusal}; restore it from a backup") from None
            previous = chain[-1].id if chain else None
            mine = (self.identity.author, len(chain), previous, f"{len(chain):04d}")
            if (tx.author, tx.sequence, tx.previous, path.stem) != mine:
                raise KeysError(f"{path}: does not follow from the one before; restore the folder")
            chain.append(tx)
        return chain

    def revoke(self, name: str, last: int) -> Path:
        """Sign that a robot counts up to its transaction number `last` (-1: none) and no further.

        Returns the file that a robot of the fleet is to be given.
        """
        author, chain = self._author(name), self.revocations()
        if not -1 <= last <= MAX_SEQUENCE:
            raise KeysError(f"--last {last}: the number of a transaction, or -1 for none of them")
        known = [g.count for tx in chain for g in tx.payload.revocations if g.author == author]
        if known and last + 1 >= min(known):
            raise KeysError(
                f"{name} is revoked from number {min(known)} on already; a revocation can only be "
                "followed by one that lets less count"
            )
        payload = Payload(revocations=(Revocation(author, last + 1),))
        previous = chain[-1].id if chain else None
        lamport = chain[-1].lamport + 1 if chain else 1
        data = seal(self.identity, self.config, len(chain), previous, lamport, (), payload)
        path = self.folder / "revocations" / f"{len(chain):04d}.tx"
        _write_new(path, data)
        return path

    def _leaf(self, public_key: bytes, name: str, addresses: Sequence[str], days: int) -> bytes:
        if not 1 <= days <= AUTHORITY_DAYS:
            raise KeysError(f"--days {days}: 1 to {AUTHORITY_DAYS} is wanted")
        try:
            return make_leaf(self._key, self.config.fleet, public_key, name, addresses, days)
        except ValueError as error:
            raise KeysError(f"--address {' '.join(addresses)}: {error}") from None

    def _known(self, name: str) -> Enrolled:
        robots = self.robots()
        if name not in robots:
            known = ", ".join(robots) or "none"
            raise KeysError(f"{self.folder}: no robot {name!r} is enrolled; known are: {known}")
        return robots[name]

    def _author(self, name: str) -> AuthorId:
        """A robot by its name, or by the 16 digits of its author id."""
        if name not in self.robots() and re.fullmatch("[0-9a-f]{16}", name):
            return bytes.fromhex(name)
        return self._known(name).author


def create_fleet(folder: Path, name: str) -> Fleet:
    """Make a fleet's key and folder. Raises KeysError where the folder holds something."""
    if not 0 < len(name.encode()) <= MAX_NAME or not printable(name):
        raise KeysError(f"--name {name!r}: 1 to {MAX_NAME} bytes of printable text are wanted")
    key = Ed25519PrivateKey.generate()
    public_key = key.public_key().public_bytes_raw().hex()
    quoted = json.dumps(name, ensure_ascii=False)
    text = _FLEET_TOML.format(quoted=quoted, key=public_key)
    with _new_folder(folder) as new:
        _write_new(new / "fleet.key", _pem(key), 0o600)
        _write_new(new / "fleet.toml", text.encode())
        _write_new(new / "ca.pem", make_authority(key, name, AUTHORITY_DAYS))
        (new / "robots").mkdir()
        (new / "revocations").mkdir()
    return Fleet(folder, Config(fleet=name, fleet_key=public_key), key)


def open_fleet(folder: Path) -> Fleet:
    """Read a fleet's folder. Raises KeysError where it is none, damaged or open to others."""
    config, key = _config(folder / "fleet.toml"), _private_key(folder / "fleet.key")
    if config.name:
        raise KeysError(f"{folder / 'fleet.toml'}: name is a robot's, not the fleet's; take it out")
    if config.fleet_key != key.public_key().public_bytes_raw().hex():
        raise KeysError(
            f"{folder}: fleet.toml names another fleet_key than that of fleet.key; "
            "one of them is another fleet's, restore it from a backup"
        )
    return Fleet(folder, config, key)


def open_robot(folder: Path) -> Robot:
    """Read a robot's folder: what it signs with, and in which fleet. Raises KeysError."""
    identity, config = load_identity(folder), _config(folder / "robot.toml")
    certificate = identity.certificate or b""
    fleet = (config.fleet_public_key, config.fleet_id, identity.public_key)
    if not config.closed or not certificate_holds(certificate, *fleet):
        raise KeysError(
            f"{folder}: the certificate is not one of the fleet {config.fleet!r} of robot.toml for "
            "the key in robot.key; the files are of different robots or fleets, enroll it anew"
        )
    path = folder / "tls.pem"
    try:
        until = valid_until(_read(path))
    except ValueError:
        raise KeysError(f"{path}: no X.509 certificate; make one with: dagmap keys renew") from None
    return Robot(folder, identity.name or "", identity, config, until)


def load_identity(folder: Path) -> Identity:
    """A robot's key and certificate out of its folder. Raises KeysError."""
    key, path = _private_key(folder / "robot.key"), folder / "certificate"
    try:
        certificate = bytes.fromhex(_read(path).decode())
        identity = Identity.from_seed(key.private_bytes_raw(), certificate)
        named = bool(identity.name)  # bytes of it may be no text
    except ValueError:
        named = False
    if not named:
        raise KeysError(f"{path}: no certificate; take the file as it was enrolled")
    return identity


def _private_key(path: Path) -> Ed25519PrivateKey:
    """Read a private key that nobody else can read."""
    try:
        with open(path, "rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            data = file.read(_MAX_KEY)
    except OSError as error:
        raise KeysError(f"{path}: cannot be read ({error.strerror})") from None
    if mode & 0o077:
        raise KeysError(
            f"{path}: others on this machine can use this private key (mode {mode:04o}); close it "
            f"with: chmod 600 {path} (and make a new one where somebody may have copied it)"
        )
    try:
        key = serialization.load_pem_private_key(data, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        raise KeysError(f"{path}: no Ed25519 private key in PEM; restore it, or enroll anew")
    return key


def _config(path: Path) -> Config:
    try:
        return load_config(path)
    except ConfigError as error:
        raise KeysError(str(error)) from None


def _pem(key: Ed25519PrivateKey) -> bytes:
    plain = serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise KeysError(f"{path}: cannot be read ({error.strerror})") from None


def _write_new(path: Path, data: bytes, mode: int = 0o644) -> None:
    """A file that appears whole, with its mode from the start, where there was none."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.unlink(missing_ok=True)  # of a process of this number that was killed
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        try:
            with open(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(descriptor)
            os.link(part, path)
        finally:
            part.unlink()
    except FileExistsError as error:
        raise KeysError(f"{error.filename2 or part}: exists; nothing is overwritten") from None
    except OSError as error:
        raise KeysError(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder for its owner alone, filled beside its place and then renamed."""
    part: Path | None = None
    folder = folder.absolute()
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise KeysError(f"{folder}: exists and is not empty; name another folder")
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        yield part
        os.replace(part, folder)
        part = None
    except OSError as error:
        raise KeysError(f"{folder}: cannot be written ({error.strerror})") from None
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
