"""DAGmap: one map for a fleet of robots, the same on every robot, without a central station.

After Park and Kim, "DAGmap: Multi-Drone SLAM via a DAG-Based Distributed Ledger", Drones 2022.
Start with `Agent`. Names are loaded when they are first used, so that importing costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .agent import Agent as Agent
    from .config import Config as Config
    from .config import FoldConfig as FoldConfig
    from .config import GraphConfig as GraphConfig
    from .config import IssuanceConfig as IssuanceConfig
    from .config import load_config as load_config
    from .graph import AdjacencyDag as AdjacencyDag
    from .identity import Identity as Identity
    from .model import Accepted as Accepted
    from .model import ConfigError as ConfigError
    from .model import Cycle as Cycle
    from .model import CycleError as CycleError
    from .model import DagmapError as DagmapError
    from .model import Forked as Forked
    from .model import Issued as Issued
    from .model import MapChanged as MapChanged
    from .model import Outgoing as Outgoing
    from .model import Overloaded as Overloaded
    from .model import Reason as Reason
    from .model import Rejected as Rejected
    from .model import Revoked as Revoked
    from .model import State as State
    from .model import Waiting as Waiting
    from .worldmap import WorldMap as WorldMap

__version__ = "0.1.0"

_HOME = {
    "agent": ("Agent",),
    "config": ("Config", "FoldConfig", "GraphConfig", "IssuanceConfig", "load_config"),
    "graph": ("AdjacencyDag",),
    "identity": ("Identity",),
    "model": (
        "Accepted",
        "ConfigError",
        "Cycle",
        "CycleError",
        "DagmapError",
        "Forked",
        "Issued",
        "MapChanged",
        "Outgoing",
        "Overloaded",
        "Reason",
        "Rejected",
        "Revoked",
        "State",
        "Waiting",
    ),
    "worldmap": ("WorldMap",),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
__all__ = sorted(_MODULE_OF)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'dagmap' has no attribute {name!r}")
    return getattr(import_module(f"dagmap.{module}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
