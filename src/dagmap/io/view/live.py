"""A running fleet as something to look at: a participant that listens, copies and folds.

It says nothing about the world: it signs no transaction. As every participant it announces what it
holds, asks for what it lacks, and answers who asks.
"""

from __future__ import annotations

import hashlib
import secrets
import sys
import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from ... import messages
from ...agent import Agent
from ...config import Config
from ...identity import Identity
from ...messages import Head, Heads, Message, Parsers
from ...model import AuthorId, DagmapError, Reason, TransactionId
from ...worldmap import WorldMap
from .. import keys
from ..closing import Closing
from ..log import Log
from ..queues import Inbox, Question
from ..runtime import Runtime
from ..settings import AgentConfig, NetworkConfig, Settings, is_endpoint, load_settings
from ..transport import Transport
from .history import History
from .snapshot import Snapshot, name_of, take
from .source import Progress, Standing

_PATIENCE = 60.0  # s for a snapshot: a participant that copies a large map works on it meanwhile
_PEERS = 256  # senders are not authenticated, so their number must be bounded


class Listener:
    """Notes what every robot announces: `Sync` remembers only what is lacking here."""

    def __init__(self) -> None:
        self._heads: OrderedDict[AuthorId, tuple[int, dict[AuthorId, Head]]] = OrderedDict()
        self.parsers = Parsers(message=self._parse)

    def heads(self) -> dict[AuthorId, dict[AuthorId, Head]]:
        """The newest announcement of each sender, by author."""
        return {sender: dict(heads) for sender, (_, heads) in self._heads.items()}

    def _parse(self, data: bytes, config: Config) -> tuple[AuthorId, Message]:
        sender, message = messages.parse(data, config)
        if isinstance(message, Heads):
            token, known = self._heads.pop(sender, (message.token, {}))
            heads = known if token == message.token else {}  # one of several messages
            heads |= {head.author: head for head in message.heads}
            self._heads[sender] = message.token, heads
            while len(self._heads) > _PEERS:
                self._heads.popitem(last=False)
        return sender, message


class _Nowhere:
    """Takes the place of a ledger on disk: what a looker-on holds it can ask for again."""

    def append_many(self, transactions: Iterable[tuple[TransactionId, bytes]]) -> None:
        """Keep nothing."""


class LiveFleet(Closing):
    """Joins the fleet of a configuration file at an endpoint; None: the fleet of the defaults.

    Raises DagmapError (ConfigError, KeysError, NetworkError) where it cannot.
    """

    live = True

    def __init__(self, endpoint: str, file: Path | None = None) -> None:
        settings = _settings(endpoint, file)
        self.config = config = settings.config
        self._identity = _identity(settings)
        self.title = f"the fleet {config.fleet} at {endpoint}"
        self._listener = Listener()
        self._agent = Agent(self._identity, config, self._listener.parsers)
        self._history = History(config, self._identity)
        self._standings: list[Standing] = []
        self._refused = False
        self._seen: tuple[WorldMap, Snapshot] | None = None  # the agent's map, and what it gave
        inbox = Inbox(config.network.receive_bytes, config.network.receive_bytes_per_robot)
        self._transport = Transport(
            config.network, settings.folder, config.fleet_id, self._identity.author, inbox
        )
        self._inbox = inbox
        log = Log(sys.stderr, "error")
        self._runtime = Runtime(
            self._agent, _Nowhere(), self._transport, inbox, log, lambda _: self._report()
        )
        self._thread = threading.Thread(target=self._runtime.run, name="dagmap view", daemon=True)
        self._thread.start()

    def first(self) -> Snapshot | None:
        return None

    def latest(self, progress: Progress) -> Snapshot:
        question = Question()
        self._inbox.put_question(question)
        question.answered.wait(_PATIENCE)
        snapshot = (question.answer or {}).get("snapshot")
        if not isinstance(snapshot, Snapshot):
            raise DagmapError(f"{self.title}: too busy to be drawn; it goes on")
        self._history.follow([each.transaction.data for each in snapshot.said])
        return snapshot

    @property
    def count(self) -> int:
        return len(self._history)

    def at(self, count: int, progress: Progress) -> Snapshot:
        return take(self._history.agent_at(count, progress))

    def standings(self) -> Sequence[Standing]:
        """Equal heads are equal sets of transactions, and these are equal maps."""
        return self._standings

    def remark(self) -> str:
        if self._refused:
            return (
                "robots here have other fleet-wide parameters ([fold], [transaction], graph.n_p, "
                "graph.n_c_max) than the configuration: give --config the file of one of them"
            )
        if not self._standings:
            return "no robot of this fleet is in reach: check the endpoint, `fleet` and --config"
        return ""

    def close(self) -> None:
        """Leave the fleet."""
        self._runtime.stop()
        self._inbox.close()
        self._thread.join()
        self._transport.close()

    def _report(self) -> dict[str, object]:
        """In the agent's thread."""
        world = self._agent.map
        if self._seen is None or self._seen[0] is not world:
            self._seen = world, take(self._agent)
        snapshot = self._seen[1]
        self._refused = self._runtime.counts.refused[Reason.PARAMETERS] > 0
        self._standings = standings(self._agent, self._listener.heads(), snapshot.digest)
        return {"snapshot": snapshot}


def standings(
    agent: Agent, announced: dict[AuthorId, dict[AuthorId, Head]], digest: str
) -> list[Standing]:
    """How the robots that have announced themselves stand to what the agent holds."""
    mine = {
        a: chain for a, chain in agent.ledger.chains.items() if chain.end or chain.cut is not None
    }
    out = []
    for sender, heads in sorted(announced.items()):
        author = agent.consensus.authors.get(sender)
        name = sender.hex() if author is None else name_of(author)
        behind = sum(max(0, c.end - _length(heads.get(a))) for a, c in mine.items())
        ahead = sum(
            max(0, head.length - (mine[a].end if a in mine else 0)) for a, head in heads.items()
        )
        same = heads.keys() == mine.keys() and all(
            (head.length, head.cut) == (mine[a].end, mine[a].cut)
            and (not head.length or mine[a].main[head.length - 1].id.startswith(head.tip))
            for a, head in heads.items()
        )
        words = [f"{behind} behind"] * bool(behind) + [f"{ahead} ahead"] * bool(ahead)
        detail = "the same transactions" if same else ", ".join(words) or "another branch"
        out.append(Standing(name, digest if same else _heads_digest(heads), same, detail))
    return out


def _heads_digest(heads: dict[AuthorId, Head]) -> str:
    """What a robot that holds other transactions is known by: digests of maps are not sent."""
    words = [f"{a.hex()} {h.length} {h.tip.hex()} {h.cut}" for a, h in sorted(heads.items())]
    found = hashlib.blake2b("\n".join(words).encode(), digest_size=16)
    return f"heads {found.hexdigest()}"


def _length(head: Head | None) -> int:
    return 0 if head is None else head.length


def _settings(endpoint: str, file: Path | None) -> Settings:
    """The file's, but for the way into the network."""
    if file is None:
        config = msgspec.convert({"store": {"path": "."}}, AgentConfig)
        settings = Settings(config, Path())
    else:
        settings = load_settings(file)
    config = settings.config
    network = config.network
    if not is_endpoint(endpoint) or (network.tls and not endpoint.startswith("tls/")):
        example = "tls/robot1.local:7447" if network.tls else "tcp/192.168.1.7:7447"
        raise DagmapError(
            f'--live {endpoint}: an endpoint such as "{example}" is wanted, one that a robot '
            "listens on (`listen` of its [network])"
        )
    mode = "peer" if network.mode == "router" else network.mode
    way = NetworkConfig(
        mode=mode,
        connect=(endpoint,),
        scouting=False,
        gossip=network.gossip,
        tls=network.tls,
        send_bytes=network.send_bytes,
        receive_bytes=network.receive_bytes,
        receive_bytes_per_robot=network.receive_bytes_per_robot,
    )
    return Settings(msgspec.structs.replace(config, network=way, name=""), settings.folder)


def _identity(settings: Settings) -> Identity:
    """A key for this once; in a closed fleet the enrolled one, but never that of a robot."""
    if not settings.config.closed:
        return Identity.from_seed(secrets.token_bytes(32))
    if settings.ledger.exists():
        raise DagmapError(
            f"{settings.ledger}: the ledger of a robot, and two must not go by one name; enroll "
            "the view too (dagmap keys enroll view) and give --config a file with its `keys`"
        )
    return keys.load_identity(settings.keys)
