"""The map out of what is on disk: a ledger is folded again, with who saw what from where."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from ..config import Config, load_config
from ..consensus import Consensus
from ..contribution import Contribution
from ..folded import Picture
from ..kernels.geometry import apply_pose
from ..ledger import Ledger
from ..model import FLEET_FRAME, AuthorId, FrameId, Int32s, Int64s, OutputError, StoreError
from ..transaction import parse
from ..wire import Refusal
from ..worldmap import build_map
from .export import MapLike, read_ply
from .exported import FIELDS, MapTable, Observations, last_seen
from .settings import load_settings
from .store import Store


def read_map(path: Path, config: Path | None = None) -> MapTable:
    """The map of a replay's folder, a `ledger.db`, an agent's TOML file, or a `map.ply`.

    config: the TOML file of the parameters under which a ledger was written; default: for a
        replay's folder its `summary.json`, else DAGmap's own defaults.
    Raises DagmapError that names the file and the remedy.
    """
    if path.suffix.lower() == ".ply":
        return _of_ply(path)
    if path.suffix == ".toml":
        settings = load_settings(path)
        return _fold(settings.ledger, settings.config)
    if not path.exists():
        raise OutputError(f"{path}: there is no such file or folder; check the path")
    ledger, folder = (_ledger_in(path), path) if path.is_dir() else (path, path.parent.parent)
    return _fold(ledger, _replayed(folder) if config is None else load_config(config))


def _ledger_in(folder: Path) -> Path:
    """Of a replay any ledger: all robots hold the same."""
    found = [folder / "ledger.db", *sorted((folder / "ledgers").glob("*.db"))]
    for path in found:
        if path.is_file():
            return path
    raise OutputError(
        f"{folder}: neither ledgers/*.db nor ledger.db is in it; give a folder that `dagmap "
        "replay` wrote, a robot's data folder, a ledger, or a map.ply"
    )


def _replayed(folder: Path) -> Config:
    """The parameters of a replay, where this is the folder of one; else the defaults."""
    path = folder / "summary.json"
    if not path.is_file():
        return Config()
    try:
        summary = msgspec.json.decode(path.read_bytes())
        return msgspec.convert(summary["parameters"], Config)
    except (OSError, msgspec.MsgspecError, LookupError, TypeError) as error:
        raise OutputError(
            f"{path}: its `parameters` cannot be read ({error}); name the TOML file of the replay "
            "with --config"
        ) from None


def _of_ply(path: Path) -> MapTable:
    world = read_ply(path)
    return MapTable(world.positions, world.colors, _verdicts(world))


def _verdicts(world: MapLike) -> dict[str, np.ndarray]:
    columns = {"state": world.states, "hits": world.hits, "misses": world.misses}
    columns["witnesses"] = world.witnesses
    most = {name: np.iinfo(FIELDS[name]).max for name in columns}
    return {
        name: np.minimum(np.asarray(column, np.int64), most[name]).astype(FIELDS[name])
        for name, column in columns.items()
    }


def _fold(path: Path, config: Config) -> MapTable:
    if not path.is_file():
        raise StoreError(f"{path}: no ledger is here; check the path")
    with Store.open(path, config.fleet_id) as store:
        consensus = _consensus(store, config)
        origin = _component(store.author, consensus, config)
    consensus.advance()
    picture = consensus.picture(origin)
    world = build_map(picture, config.fold.cell)
    robots = [_name(consensus, id_) for id_ in sorted(consensus.authors)]
    seen = _observations(consensus, picture)
    first = np.zeros(len(world), FIELDS["robot"])
    first[seen.node[::-1]] = seen.robot[::-1]  # the first in canonical order is written last
    fields = {**_verdicts(world), "robot": first, "stamp": last_seen(seen, len(world))}
    return MapTable(world.positions, world.colors, fields, tuple(robots), seen)


def _consensus(store: Store, config: Config) -> Consensus:
    """The fold of what counts in a ledger. Order is no matter: the map is a function of the set."""
    ledger, consensus = Ledger(config), Consensus(config)
    lost = 0
    for data in store:
        try:
            tx = parse(data, config)
        except Refusal:
            lost += 1
            continue
        lost += len(ledger.add(tx, again=True).refused)
        if tx.id in ledger:
            tx.drop_columns()  # decoded again below: a ledger may be larger than the memory
    if lost:
        raise StoreError(
            f"{store.path}: {lost} of {len(store)} transactions do not hold under these "
            "parameters; name the TOML file under which the ledger was written with --config"
        )
    for chain in ledger.chains.values():
        for tx in chain.main[: chain.end]:
            if ledger.counts(tx) and not tx.payload.revocations:
                tx.payload = tx.decode_again(config)
                consensus.add(tx)
    return consensus


def _component(author: AuthorId | None, consensus: Consensus, config: Config) -> FrameId:
    """Where the ledger's robot is; one that has not mapped looks at where it would start."""
    consensus.advance()
    known = None if author is None else consensus.authors.get(author)
    if author is not None and known is not None and known.anchors:
        newest = known.anchors[max(known.anchors)]
        return consensus.placement(author, newest.session)[0]
    start = FLEET_FRAME if config.start_pose is not None else FrameId(author or bytes(8), 0)
    return (
        start
        if consensus.picture(start).component is not None
        else _any_component(consensus, start)
    )


def _any_component(consensus: Consensus, otherwise: FrameId) -> FrameId:
    """The frame that most transactions lie in."""
    counts: dict[FrameId, int] = {}
    for contribution in consensus.contributions():
        for part in contribution.parts:
            counts[part.component] = counts.get(part.component, 0) + 1
    return max(sorted(counts), key=lambda c: counts[c], default=otherwise)


def _name(consensus: Consensus, id_: AuthorId) -> str:
    return consensus.authors[id_].name or id_.hex()


def _observations(consensus: Consensus, picture: Picture) -> Observations:
    """Every observation that is in the map, in canonical order."""
    number = {id_: i for i, id_ in enumerate(sorted(consensus.authors))}
    parts = [_nothing()]
    if picture.component is not None:
        fold = picture.component.fold
        for contribution in picture.contributions:
            author = contribution.author
            nodes = fold.feature_nodes(author.index)
            parts += _of(consensus, contribution, nodes, number[author.id])
    return Observations(
        np.concatenate([p.node for p in parts]),
        np.concatenate([p.robot for p in parts]),
        np.concatenate([p.stamp for p in parts]),
        np.concatenate([p.sensor for p in parts]),
    )


def _of(
    consensus: Consensus, contribution: Contribution, nodes: Int32s, robot: int
) -> list[Observations]:
    """What one transaction adds: a part a cycle for its features, one a cycle seen again."""
    out, author, base = [], contribution.author, contribution.base
    for cycle, start, end in zip(
        contribution.cycles.tolist(),
        contribution.starts[:-1].tolist(),
        contribution.starts[1:].tolist(),
        strict=True,
    ):
        anchor = author.anchors.get(cycle)
        if anchor is None:
            continue
        _, frame = consensus.placement(author.id, anchor.session)
        sensor = _carried(frame, anchor.pose[4:])
        out.append(_rows(nodes[base + start : base + end], robot, anchor.stamp / 1e6, sensor))
    for sighting in contribution.sightings:
        anchor = author.anchors.get(sighting.cycle)
        if anchor is not None:
            again = nodes[sighting.numbers[sighting.numbers < len(nodes)]]
            out.append(_rows(again, robot, anchor.stamp / 1e6, np.full(3, np.nan)))
    return out


def _carried(frame: Int32s, translation: Int32s) -> np.ndarray:
    """(3,) m: a place in a SLAM frame carried into its component."""
    out = np.zeros((1, 3), np.int32)
    apply_pose(frame, np.ascontiguousarray(translation[None]), out, np.ones(1, np.bool_))
    return np.asarray(out[0] / 1000.0, np.float64)


def _rows(nodes: Int32s | Int64s, robot: int, stamp: float, sensor: np.ndarray) -> Observations:
    node = nodes[nodes >= 0].astype(np.int64)
    count = len(node)
    return Observations(
        node,
        np.full(count, robot, np.int64),
        np.full(count, stamp),
        np.tile(sensor, (count, 1)),
    )


def _nothing() -> Observations:
    none = np.zeros(0, np.int64)
    return Observations(none, none, np.zeros(0), np.zeros((0, 3)))
