"""The thread between a robot's ROS and its agent: topics in as cycles, the map out as topics."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple, Protocol

import numpy as np

from ...model import Cycle, DagmapError, NetworkError
from ..closing import Closing
from ..log import Log
from ..queues import Inbox, Question
from ..sources._poses import inverse
from ..sources._ros import Unusable
from . import telling
from .config import RosConfig
from .feed import Feed, wanted
from .types import Types

Send = Callable[[bytes], None]
Take = Callable[[bytes, str, str], None]  # bytes; type and definition, where they came along
Quality = Literal["sensor", "reliable", "still"]
_QUALITY: dict[str, Quality] = {"cloud": "sensor", "odometry": "sensor", "tf_static": "still"}
_OVERHEAD = 200  # bytes that a message takes beside its own


class Link(Protocol):
    """What carries serialised messages. Any thread of it may call what `subscribe` was given."""

    ros2: bool  # whether messages are CDR

    def subscribe(self, name: str, kind: str, quality: Quality, take: Take) -> None:
        """quality: sensor: the newest counts, not each; still: what was said before counts too."""

    def advertise(self, name: str, kind: str, still: bool) -> Send:
        """still: the last message is kept for who comes later. Sending never raises."""

    def close(self) -> None:
        """Nothing is heard or said any more."""


class _Heard(NamedTuple):
    role: str
    kind: str
    definition: str  # of the type, or empty
    raw: bytes


class _Backlog:
    """Messages that wait to be decoded, up to so many bytes; the oldest one is dropped first."""

    def __init__(self, most: int) -> None:
        self._most, self._size, self.dropped = most, 0, 0
        self._change = threading.Condition()
        self._queue: deque[_Heard] = deque()

    def put(self, item: _Heard) -> None:
        with self._change:
            self._queue.append(item)
            self._size += _OVERHEAD + len(item.raw)
            while self._size > self._most:
                self._size -= _OVERHEAD + len(self._queue.popleft().raw)
                self.dropped += 1
            self._change.notify()

    def take(self, patience: float) -> _Heard | None:
        """The next one, or None after so many seconds."""
        with self._change:
            self._change.wait_for(lambda: bool(self._queue), max(0.0, patience))
            if not self._queue:
                return None
            item = self._queue.popleft()
            self._size -= _OVERHEAD + len(item.raw)
            return item


class Bridge(Closing):
    """Feeds an agent from ROS and tells ROS of its map, until it is stopped."""

    def __init__(
        self,
        config: RosConfig,
        link: Link,
        inbox: Inbox,
        log: Log,
        session: int = 0,
        ready: Callable[[], bool] = lambda: True,
    ) -> None:
        """session: of the first cycle. ready: whether cycles may go to the agent yet.

        Raises NetworkError.
        """
        self._config, self._link, self._inbox, self._log = config, link, inbox, log
        self._ready = ready
        self._types = Types(link.ros2)
        self._feed = Feed(config, session)
        self._backlog = _Backlog(config.queue_bytes)
        self._unusable = 0
        self._assumed = ""  # what the log was last told of what is assumed
        self._stopped = threading.Event()
        self._question: Question | None = None
        self._picture: telling.Picture | None = None
        self._next_map = self._next_tf = 0.0
        self.error: DagmapError | None = None
        self.over = False  # a SLAM that runs has no end
        self._send = self._advertise()
        for role, name, kind in wanted(config):
            quality = _QUALITY.get(role, "reliable")
            link.subscribe(name, kind, quality, partial(self._hear, role, kind))
        self._thread = threading.Thread(target=self._run, name="dagmap ros", daemon=True)

    def start(self) -> None:
        """Begin, in a thread of its own."""
        self._thread.start()

    def close(self) -> None:
        """Hear and say nothing more; wait until the thread has ended."""
        self._stopped.set()
        self._link.close()
        self._inbox.close()
        if self._thread.is_alive():
            self._thread.join()

    def _advertise(self) -> dict[str, Send]:
        config = self._config
        topics = {
            "map": (config.map, telling.CLOUD, True),
            "graph": (config.graph, telling.MARKERS, True),
            "diagnostics": (config.diagnostics, telling.DIAGNOSTICS, False),
            "tf": (config.tf if config.fleet_frame else "", telling.TRANSFORMS, False),
        }
        return {
            role: self._link.advertise(name, kind, still)
            for role, (name, kind, still) in topics.items()
            if name
        }

    def _hear(self, role: str, kind: str, raw: bytes, sent: str, definition: str) -> None:
        """In a thread of the link's."""
        self._backlog.put(_Heard(role, sent or kind, definition, raw))

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                self._step()
        except DagmapError as error:
            self.error = error
        except Exception as error:  # noqa: BLE001  a robot that hears nothing more must say so
            self.error = NetworkError(
                f"[ros]: a message could not be worked with ({type(error).__name__}: {error}); "
                "start the robot again"
            )

    def _step(self) -> None:
        now = time.monotonic()
        due = min(self._next_map, self._next_tf, now + self._config.patience + 0.01)
        item = self._backlog.take(due - now) if self._ready() else None
        if item is None and not self._ready():
            self._stopped.wait(0.02)
        now = time.monotonic()
        cycles = self._feed.tick(now)
        if item is not None:
            cycles += self._decoded(item, now)
        for cycle in cycles:
            if not self._inbox.put_cycle(cycle):
                return
        self._tell(time.monotonic())

    def _decoded(self, item: _Heard, now: float) -> list[Cycle]:
        try:
            if item.definition:
                self._types.learn(item.kind, item.definition)
            return self._feed.take(item.role, self._types.decode(item.kind, item.raw), now)
        except Unusable as fault:
            reason = fault
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            reason = Unusable(f"its fields do not fit together ({error})")
        self._unusable += 1
        self._log.seldom("warning", "message refused", item.role, topic=item.role, reason=reason)
        return []

    def _tell(self, now: float) -> None:
        """Say what is due. The agent is asked; its answer is told when it comes."""
        if self._question is not None and self._question.answered.is_set():
            self._picture, self._question = self._question.answer, None
            self._tell_map()
        elif self._question is None and now >= self._next_map:
            begun = self._next_map > 0  # at first there is nothing to be heard yet
            self._next_map = now + self._config.publish_period
            edges = self._config.max_edges if self._config.graph else 0
            self._question = Question(partial(telling.take_picture, edges=edges))
            self._inbox.put_question(self._question)
            problem = self._said()[1] if begun else None
            if problem is not None:
                self._log.seldom("warning", "no cycles", "feed", reason=problem)
            if self._feed.assumed != self._assumed:
                self._assumed = self._feed.assumed
                if self._assumed:
                    self._log.write("warning", "frame assumed", reason=self._assumed)
        if now >= self._next_tf:
            self._next_tf = now + self._config.tf_period
            self._tell_frame()

    def _tell_map(self) -> None:
        picture, types, config, stamp = self._picture, self._types, self._config, self._stamp
        assert picture is not None
        if picture.placed:
            fleet = config.fleet_frame or "fleet"
            raw = telling.map_message(types, picture.world, stamp, fleet, config.max_nodes)
            self._send["map"](raw)
        here = self._feed.map_frame()
        if "graph" in self._send and here is not None:
            name, pose = here
            raw = telling.graph_message(types, picture.edges, inverse(pose), stamp, name)
            self._send["graph"](raw)
        if "diagnostics" in self._send:
            feed, problem = self._said()
            raw = telling.diagnostics_message(types, picture, feed, problem, stamp)
            self._send["diagnostics"](raw)

    def _tell_frame(self) -> None:
        """fleet -> map: the pose of the robot's map frame in the fleet's frame."""
        here = self._feed.map_frame()
        if "tf" not in self._send or here is None or self._picture is None:
            return
        name, pose = here
        if self._picture.frame is not None:
            placed, fleet = self._picture.frame @ pose, self._config.fleet_frame
            stamp = self._stamp
            self._send["tf"](telling.transform_message(self._types, placed, fleet, name, stamp))

    @property
    def _stamp(self) -> float:
        """The robot's clock, as its messages tell it: simulated or played time, too."""
        newest = self._feed.newest
        return newest if np.isfinite(newest) else time.time()

    def _said(self) -> tuple[dict[str, object], str | None]:
        feed = self._feed
        said: dict[str, object] = {
            "clouds waiting": feed.waiting,
            "messages refused": self._unusable,
            "messages dropped": self._backlog.dropped,
            **{f"{what} left out": count for what, count in sorted(feed.dropped.items())},
        }
        if feed.assumed:
            said["assumed"] = feed.assumed
        problem = feed.problem
        if problem is None and not np.isfinite(feed.newest):
            heard = ", ".join(topic.name for topic in wanted(self._config))
            problem = f"nothing was heard yet on {heard}"
        elif problem is None and feed.lost_frame:
            problem = f"no tf leads from {feed.lost_frame} to map_frame = {self._config.map_frame}"
        return said, problem
