"""The map in a browser: viser draws it, this decides when what is drawn anew.

Callbacks of viser only note what is wanted; one thread, that of `run`, reads it and draws.
"""

from __future__ import annotations

import io
import math
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ...model import DagmapError, Floats
from ..closing import Closing
from ..export import PlyMap
from ..panels import rgb, robot_colors
from . import words
from .controls import Controls
from .eye import Eye
from .once import Once
from .pace import Headstart
from .picture import Picture, Stand
from .snapshot import Snapshot, edges_near, newest_features
from .source import Source

if TYPE_CHECKING:
    import viser

POINTS = 400_000  # drawn of a map at most, unless somebody asks for more
_MOVING = 10_000  # points all over the map: what a browser without a graphics card can turn
_RESTING = 40_000  # that it can draw when nothing moves, about the place it looks at
_EDGES = 20_000
_TICK = 0.05  # s between two looks at what is wanted
_REST = 0.3  # s without a movement of the camera, after which its surroundings are drawn
_NEWS = 1.0  # s between two questions to a running fleet, or thrice what an answer takes
_PLAY = 0.2  # s between two steps of the ledger while it plays
_MARK, _NEWEST = (20, 20, 20), (230, 0, 180)  # colours of the picked point and of what is new
T = TypeVar("T")


class Window(Closing):
    """Serves the view of a source. `run` draws until `stop`, or until somebody presses Ctrl-C.

    port: 0 for any that is free. Raises DagmapError where viser is missing or the port is taken.
    """

    def __init__(self, source: Source, host: str, port: int, points: int = POINTS) -> None:
        module = load_viser()
        _check_port(host, port)
        with redirect_stdout(io.StringIO()):  # viser greets
            self._server: viser.ViserServer = module.ViserServer(host, port, verbose=False)
        self._host, self._source = host, source
        self._light()
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label("DAGmap")
        self.controls = Controls(self._server.gui, points)
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._eyes: dict[int, Eye] = {}
        self._ray: tuple[Floats, Floats] | None = None  # a click that nobody has looked at yet
        self._picked: Floats | None = None  # (3,) m
        self._looked_at = np.zeros(3)
        self._latest: Snapshot | None = None
        self._shown: Snapshot | None = None
        self._picture: Picture | None = None
        self._stand: Stand | None = None
        self._names: list[str] = []
        self._next_news = self._next_play = 0.0
        self._headstart = Headstart()
        self._done: dict[str, Once] = {}
        self._server.on_client_connect(self._come)
        self._server.on_client_disconnect(self._leave)
        self._server.scene.on_click()(self._click)

    @property
    def url(self) -> str:
        """What to open in the browser."""
        host = "localhost" if self._host in ("0.0.0.0", "::") else self._host
        return f"http://{host}:{self._server.get_port()}"

    def run(self) -> None:
        """Draw, and go on drawing what is new or wanted."""
        self.show_first()
        while not self._stopped.wait(_TICK):
            self.step()

    def show_first(self) -> None:
        """What can be shown before the ledger is read."""
        first = self._source.first()
        if first is not None:
            self._show(first)
            self._headstart.shown(time.monotonic())

    def stop(self) -> None:
        """End `run`. From any thread."""
        self._stopped.set()

    def close(self) -> None:
        """Let go of the port and of all browsers."""
        self.stop()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def step(self) -> None:
        """Look once at what is new and at what is wanted."""
        self._listen()
        self._walk()
        if self._shown is not None:
            self._draw(self._shown)

    def _light(self) -> None:
        """Colours as the legend has them; no work for shadows, which points do not cast."""
        scene = self._server.scene
        scene.configure_default_lights(enabled=False, cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/light", intensity=math.pi)  # of which a surface returns 1 / pi

    # What the browser says, in threads of viser's.

    def _come(self, client: viser.ClientHandle) -> None:
        self._headstart.came(time.monotonic())
        eye = Eye(client)
        eye.moved()  # what is near comes once it has drawn what is everywhere
        with self._lock:
            self._eyes[client.client_id] = eye

        client.camera.on_update(lambda _: eye.moved())

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._eyes.pop(client.client_id, None)

    def _click(self, event: Any) -> None:
        self._ray = np.asarray(event.ray_origin), np.asarray(event.ray_direction)

    # What is to be shown.

    def _listen(self) -> None:
        """Take what is new."""
        now = time.monotonic()
        if self._latest is None:
            if not self._headstart.is_over(now):
                return
        elif not self._source.live or now < self._next_news:
            return
        latest = self._working(self._source.latest)
        self._next_news = time.monotonic() + max(_NEWS, 3 * (time.monotonic() - now))
        self.controls.offer(self._source.count)
        standings, remark = self._source.standings(), self._source.remark()
        if self._changed("standing", latest, tuple(standings), remark):
            self.controls.standing.content = words.standing(
                self._source.title, standings, latest.digest, remark
            )
        if latest is not self._latest:
            self._latest = latest
            if self.controls.latest.value:
                self._show(latest)

    def _walk(self) -> None:
        """Go to the transaction at which the slider stands."""
        count, now = self._source.count, time.monotonic()
        if now >= self._next_play:
            self._next_play = now + _PLAY
            self.controls.step(count)
        wanted = self.controls.wanted_count(count)
        if not self._changed("count", wanted, count) or self._latest is None:
            return
        if wanted == count:
            self._show(self._latest)
        else:
            self._show(self._working(lambda say: self._source.at(wanted, say)))

    def _working(self, work: Callable[[Callable[[float], None]], T]) -> T:
        """Do it, and show how far it is where it takes long."""
        bar, begun = self.controls.busy, time.monotonic()

        def say(share: float) -> None:
            if time.monotonic() - begun > 0.3:
                bar.visible, bar.value = True, 100 * min(max(share, 0.0), 1.0)
            if self._shown is not None:
                self._draw(self._shown)  # meanwhile the view goes on

        try:
            return work(say)
        finally:
            if bar.visible:
                bar.visible = False

    def _show(self, snapshot: Snapshot) -> None:
        self._shown = snapshot
        names = sorted({*self._names, *snapshot.names})
        self._names = self._names if names == self._names else names
        if self._stand is None or (snapshot.paths and self._stand.blind):
            self._stand = Stand(snapshot)
            self._place(self._stand)
        self._draw(snapshot)

    def _place(self, stand: Stand) -> None:
        """Where cameras begin."""
        self._server.scene.set_up_direction(stand.up)
        self._server.initial_camera.position = tuple(stand.position)
        self._server.initial_camera.look_at = tuple(stand.look_at)
        self._looked_at = stand.look_at
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = stand.position, stand.look_at

    # Drawing. Each part is drawn again where what it depends on has changed.

    def _draw(self, snapshot: Snapshot) -> None:
        controls = self.controls
        if self._changed("picture", snapshot, controls.wanted_states, self._names):
            self._picture = Picture(snapshot, controls.wanted_states, self._names)
        picture = self._picture
        assert picture is not None
        self._draw_base(picture)
        self._draw_details(picture)
        self._draw_paths(snapshot)
        self._pick(snapshot, picture)
        self._draw_edges(snapshot)
        self._draw_newest(snapshot)

    def _draw_base(self, picture: Picture) -> None:
        controls = self.controls
        colouring, size = controls.colouring.value, controls.size.value
        budget = min(_MOVING, 1000 * int(controls.points.value))
        if not self._changed("base", picture, colouring, size, budget):
            return
        rows = picture.everywhere(budget)
        self._cloud(
            self._server.scene,
            "/map",
            picture.positions[rows],
            picture.colors(colouring)[rows],
            size,
        )
        controls.legend.content = words.colours(colouring, self._names)
        controls.counts.content = words.counts(picture.snapshot, min(len(picture), self._budget))

    @property
    def _budget(self) -> int:
        return 1000 * int(self.controls.points.value)

    def _draw_details(self, picture: Picture) -> None:
        """What a browser shows about the place it looks at, once its camera rests."""
        with self._lock:
            eyes = list(self._eyes.values())
        for eye in eyes:
            if not eye.pace.rests(time.monotonic(), _REST):
                continue
            camera = eye.client.camera
            centre = np.asarray(camera.look_at, np.float64)
            radius = 1.3 * float(np.linalg.norm(np.asarray(camera.position) - centre))
            colouring, size = self.controls.colouring.value, self.controls.size.value
            budget = max(0, self._budget - _MOVING)
            budget = min(budget, _RESTING) if eye.pace.slow else budget
            if eye.drawn.changed(picture, colouring, size, budget, centre, radius):
                self._looked_at = centre
                rows = picture.near(centre, radius, budget)
                eye.detail = self._cloud(
                    eye.client.scene,
                    "/detail",
                    picture.positions[rows],
                    picture.colors(colouring)[rows],
                    size,
                )
            if eye.detail is not None and not eye.detail.visible:
                eye.detail.visible = True

    def _draw_paths(self, snapshot: Snapshot) -> None:
        wanted = self.controls.paths.value
        if not self._changed("paths", snapshot, wanted, self._names):
            return
        scene, size = self._server.scene, self._stand.size if self._stand else 1.0
        scene.remove_by_name("/robots")
        colors = np.rint(255 * rgb(robot_colors(len(self._names)))).astype(np.uint8)
        for path in snapshot.paths if wanted else ():
            number = self._names.index(path.robot)
            color = tuple(int(channel) for channel in colors[number])
            track, name = path.poses[:, :3, 3], f"/robots/{number}"
            if len(track) > 1:
                segments = np.stack([track[:-1], track[1:]], axis=1).astype(np.float32)
                scene.add_line_segments(
                    f"{name}/path", segments, color, thickness=2.5, thickness_units="screen"
                )
            here = tuple(track[-1])
            scene.add_icosphere(f"{name}/here", 0.008 * size, color, position=here)
            scene.add_label(f"{name}/name", path.robot, position=here)

    def _pick(self, snapshot: Snapshot, picture: Picture) -> None:
        """What a click said, and what is to be said of that point."""
        ray, self._ray = self._ray, None
        if ray is not None:
            node = picture.pick(*ray)
            self._picked = None if node is None else snapshot.world.positions[node]
        if not self._changed("picked", snapshot, self._picked):
            return
        scene, world = self._server.scene, snapshot.world
        scene.remove_by_name("/picked")
        if self._picked is None or not len(world.positions):
            self.controls.node.content = words.plain("click on a point")
            return
        node = int(np.argmin(np.linalg.norm(world.positions - self._picked, axis=1)))
        place = world.positions[node]
        radius = 0.0015 * self.controls.size.value
        scene.add_icosphere("/picked", radius, _MARK, position=tuple(place))
        if not isinstance(world, PlyMap):
            fold = self._source.config.fold
            self.controls.node.content = words.node(world, node, snapshot.said, fold)
        else:
            self.controls.node.content = words.plain("the ledger is still being read")

    def _draw_edges(self, snapshot: Snapshot) -> None:
        controls = self.controls
        wanted, radius = controls.edges.value, float(controls.radius.value)
        centre = self._looked_at if self._picked is None else self._picked
        if not self._changed("edges", snapshot, wanted, radius, centre if wanted else None):
            return
        scene = self._server.scene
        scene.remove_by_name("/edges")
        if not wanted:
            return
        ends, robots = edges_near(snapshot.said, self._source.config, centre, radius, _EDGES)
        if not len(ends):
            return
        palette = np.rint(255 * rgb(robot_colors(len(self._names)))).astype(np.uint8)
        colors = palette[[self._names.index(robot) for robot in robots]]
        scene.add_line_segments(
            "/edges",
            ends.astype(np.float32),
            np.repeat(colors[:, None], 2, axis=1),
            thickness=1.2,
            thickness_units="screen",
        )

    def _draw_newest(self, snapshot: Snapshot) -> None:
        """The newest transactions, and where they are: of a ledger that moves."""
        if not self._changed("newest", snapshot):
            return
        count = len(snapshot.said)
        self.controls.newest.content = words.newest(snapshot.said, count)
        moves = self._source.live or snapshot is not self._latest
        points = newest_features(snapshot.said, 1 if moves else 0)
        colors = np.broadcast_to(np.array(_NEWEST, np.uint8), points.shape)
        size = 1.8 * float(self.controls.size.value)
        self._cloud(self._server.scene, "/newest", points, colors, size)

    def _cloud(
        self, scene: viser.SceneApi, name: str, points: Floats, colors: Any, millimetres: float
    ) -> viser.PointCloudHandle:
        return scene.add_point_cloud(
            name,
            np.asarray(points, np.float32),
            np.ascontiguousarray(colors),
            point_size=millimetres / 1000.0,
            precision="float32",
            point_shading="flat",
        )

    def _changed(self, what: str, *key: Any) -> bool:
        return self._done.setdefault(what, Once()).changed(*key)


def load_viser() -> Any:
    """The module `viser`. Raises DagmapError that names the extra where it is missing."""
    try:
        return import_module("viser")
    except ImportError as error:
        raise DagmapError(
            f"the view needs viser ({error}); install it: pip install 'dagmap[view]'"
        ) from None


def _check_port(host: str, port: int) -> None:
    """viser would quietly take the next one."""
    try:
        with socket.create_server((host, port)):
            pass
    except (OSError, OverflowError) as error:
        raise DagmapError(
            f"--port {port} on {host}: cannot be used ({getattr(error, 'strerror', None) or error})"
            "; name another one, or 0 for any that is free"
        ) from None
