"""A robot's data folder: its key, its ledger, and the agent that goes on from them."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import msgspec

from ..agent import Agent
from ..identity import Identity
from ..model import StoreError
from ..transaction import glance, id_of
from ..wire import Refusal
from . import keys
from .checkpoint_file import read_checkpoint
from .settings import Settings
from .store import Store

Track = Callable[[Iterable[bytes], int], Iterable[bytes]]
_KEY = "robot.key"
_USED = "robot.ledger"  # beside the key: the name of the one ledger that it signs for


def load_identity(folder: Path) -> Identity:
    """The robot's identity in the open mode: a key that is made at the first start and kept.

    Raises StoreError where the key is damaged, readable for others or cannot be written.
    """
    path = folder / _KEY
    try:
        if not path.exists():
            _write_secret(path, secrets.token_hex(32))
        if path.stat().st_mode & 0o077:
            raise StoreError(f"{path}: others can read this private key; run chmod 600 on it")
        return Identity.from_seed(bytes.fromhex(path.read_text("ascii")))
    except OSError as error:
        raise StoreError(f"{path}: the robot's key is out of reach ({error.strerror})") from None
    except ValueError:
        raise StoreError(
            f"{path}: damaged, 64 hexadecimal digits are wanted; restore it from a backup, or give "
            "the robot a new data folder"
        ) from None


def open_folder(settings: Settings) -> tuple[Identity, Store]:
    """The robot's key and its open ledger, made where this is the first start.

    In a closed fleet the key is the enrolled one. Raises StoreError, and KeysError for that key.
    """
    path, fleet = settings.ledger, settings.config.fleet_id
    if path.is_dir():
        raise StoreError(f"{path}: is a folder; let [store] path name a file in it")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{path.parent}: cannot be made ({error.strerror})") from None
    closed = settings.config.closed
    identity = keys.load_identity(settings.keys) if closed else None
    used = (settings.keys if closed else path.parent) / _USED
    if not path.exists():
        if used.exists() or (path.parent / _KEY).exists():
            anew = "enroll the robot anew" if closed else f"remove {_KEY} and {_USED} too"
            raise StoreError(
                f"{path}: the ledger of the robot's key is gone; put back its newest backup, or "
                f"{anew}: it then starts as a new one. Under its old key it would sign its numbers "
                "twice"
            )
        Store.open(path, fleet).close()  # first of all, so that a key without a ledger is a loss
    if identity is None:
        identity = load_identity(path.parent)
    store = Store.open(path, fleet, identity.author)
    try:
        _claim(used, store)
    except BaseException:
        store.close()
        raise
    return identity, store


def _claim(used: Path, store: Store) -> None:
    """A key signs for one ledger: two would number two chains, and so fork the robot's own."""
    try:
        if not used.exists():
            _write_secret(used, store.name.hex())
        elif used.read_text("ascii").strip() != store.name.hex():
            raise StoreError(
                f"{store.path}: the robot's key has signed for another ledger ({used} names it); "
                "correct [store] path, or give the robot a new key"
            )
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "damaged"
        raise StoreError(
            f"{used}: out of reach ({reason}); the folder of the robot's key must be writable "
            "and have some space"
        ) from None


def restore(settings: Settings, identity: Identity, store: Store, track: Track) -> Agent:
    """The agent that holds what the ledger holds. Raises StoreError where it would hold less.

    track: wraps the transactions (their number is known) to show how far it is.
    """
    config = settings.config
    if config.closed and not config.name:
        config = msgspec.structs.replace(config, name=identity.name or "")
    tracked = track(store, len(store))
    agent = Agent.restore(identity, config, tracked, checkpoint=read_checkpoint(store))
    lost = sum(_lacks(agent, data) for data in store)
    if lost:
        raise StoreError(
            f"{store.path}: {lost} of {len(store)} transactions do not hold under this "
            "configuration; the ledger was written with other fleet-wide parameters ([fold], "
            "[transaction], graph.n_p, graph.n_c_max): give it back those, or another data folder"
        )
    return agent


def _lacks(agent: Agent, data: bytes) -> bool:
    """Whether the agent has dropped what was stored.

    Of a forked author it may: what once proved the fork need not follow from anything, and is let
    go of once a lower proof is known.
    """
    if agent.ledger.find(id_of(data)) is not None:
        return False
    try:
        author, _ = glance(data)
    except Refusal:
        return True
    return agent.ledger.chain(author).cut is None


def next_session(agent: Agent) -> int:
    """The first number for a SLAM that starts anew with this agent: no session has it yet."""
    chain = agent.ledger.chain(agent.identity.author).main
    used = (anchor.session for tx in chain for anchor in tx.payload.anchors)
    return max(used, default=-1) + 1


def _write_secret(path: Path, text: str) -> None:
    """A file for this user only, there as a whole or not at all. Raises OSError."""
    part = path.with_suffix(".part")
    with suppress(FileNotFoundError):
        part.unlink()
    handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        os.write(handle, text.encode("ascii"))
        os.fsync(handle)
    finally:
        os.close(handle)
    os.rename(part, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
