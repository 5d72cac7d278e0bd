"""What a CameraInfo says: P of rectified pictures, K and the distortion of raw ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bags import HEIGHT, WIDTH, Make, Message, pictures, write_bag
from dagmap.io.sources import Options, describe_source, open_source
from dagmap.io.sources._lens import Distortion, is_rectified, lens_of
from dagmap.io.sources._ros import Unusable
from dagmap.model import RecordingError

K = np.array([[100.0, 0, 80], [0, 110.0, 60], [0, 0, 1]])
P = (90.0, 0, 75, 0, 0, 95.0, 55, 0, 0, 0, 1, 0)
BENT = {
    "plumb_bob": (-0.25, 0.08, 0.001, -0.002, 0.01),
    "rational_polynomial": (0.3, 0.05, 0.001, -0.001, 0.01, 0.6, 0.1, 0.02),
    "equidistant": (0.05, -0.02, 0.01, -0.003),
}
DEPTH = 2.0  # m, of the wall


def bend(flat: np.ndarray, model: str, d: tuple[float, ...]) -> np.ndarray:
    """Where a lens shows rays (N, 2), by the published formulas."""
    x, y = flat.T
    r2 = x * x + y * y
    if model == "equidistant":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(d)))
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        x, y = x * scale, y * scale
    else:
        k1, k2, p1, p2, k3, *more = d
        k4, k5, k6 = more or (0.0, 0.0, 0.0)
        scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x, y = (
            x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.column_stack([100 * x + 80, 110 * y + 60])


def recorded(make: Make, topic: str, **info: Any) -> list[Message]:
    out = [make.odometry(1.0 + 0.1 * i, "camera") for i in range(6)]
    for i in range(2):
        stamp = 1.05 + 0.2 * i
        color, depth = pictures(i)
        out.append(make.camera_info(stamp, **info))
        out.append(make.image("/camera/depth/image", stamp, depth, "16UC1"))
        out.append(make.image(topic, stamp, np.ascontiguousarray(color[:, :, ::-1]), "rgb8"))
    return sorted(out, key=lambda message: message[2])


def opened(path: Path, topic: str = "/camera/color/image_raw", **info: Any) -> Any:
    make = Make(ros2=path.suffix != ".bag")
    return open_source(write_bag(path, make, recorded(make, topic, **info)))


def rays(source: Any) -> np.ndarray:
    points = np.concatenate([np.asarray(cycle.points) for cycle in source])
    assert len(points) > 20 and np.allclose(points[:, 2], DEPTH)
    return np.asarray(points[:, :2] / points[:, 2:])


def features(count: int = 2) -> np.ndarray:
    """(N, 2) pixels of all that ORB finds where there is depth."""
    found = []
    for i in range(count):
        color, depth = pictures(i)
        gray = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
        for key in cv2.ORB_create(nfeatures=1000).detect(gray, None):
            x, y = (int(np.floor(v + 0.5)) for v in key.pt)
            if depth[min(y, HEIGHT - 1), min(x, WIDTH - 1)]:
                found.append(key.pt)
    return np.array(found)


def same_places(found: np.ndarray) -> bool:
    """Whether pixels (N, 2) are those of the features, in whatever order."""
    seen = features()
    away = np.abs(found[:, None] - seen[None]).max(axis=2)
    return bool(away.min(axis=1).max() < 0.02 and len(found) > 0.9 * len(seen))


@pytest.mark.parametrize("name", ["walk.mcap", "walk.bag"])
@pytest.mark.parametrize("model", list(BENT))
def test_raw_pictures_are_straightened(tmp_path: Path, name: str, model: str) -> None:
    source = opened(tmp_path / name, model=model, d=BENT[model], p=P)
    assert same_places(bend(rays(source), model, BENT[model]))
    assert f"/camera/color/image_raw is raw: its {model} distortion is taken out" in source.notes


def test_rectified_pictures_have_the_pinhole_of_p(tmp_path: Path) -> None:
    source = opened(tmp_path / "a.mcap", "/camera/color/image_rect_color", d=BENT["plumb_bob"], p=P)
    assert same_places(rays(source) * (90, 95) + (75, 55)) and len(source.notes) == 1
    without = opened(tmp_path / "b.mcap", p=P)  # nothing bends
    assert same_places(rays(without) * (90, 95) + (75, 55))


def test_without_p_k_counts(tmp_path: Path) -> None:
    rectified = "/camera/color/image_rect"
    source = opened(tmp_path / "a.mcap", rectified, model="magic", d=(1.0, 2.0))
    assert same_places(rays(source) * (100, 110) + (80, 60))
    assert same_places(rays(opened(tmp_path / "b.mcap", d=())) * (100, 110) + (80, 60))


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({"model": "magic", "d": (0.1, 0.2)}, "model 'magic' is none of plumb_bob, .*image_rect"),
        ({"model": "", "d": (0.1,) * 5}, "model '' is none of plumb_bob"),
        ({"d": (0.1, 0.2)}, "D = .0.1, 0.2., but plumb_bob has 4 or 5 or 8"),
        ({"model": "equidistant", "d": (0.1,) * 5}, "but equidistant has 4 numbers"),
        ({"d": (float("nan"),) * 5}, "D = .nan.*calibrate the camera anew"),
        ({"p": (-1.0,) * 12}, "not calibrated .*P = .-1"),
        ({"p": (float("inf"),) * 12}, "not calibrated .*P = .inf"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, info: dict[str, Any], said: str) -> None:
    with pytest.raises(RecordingError, match=f"a.mcap: /camera/color/camera_info, .*{said}"):
        opened(tmp_path / "a.mcap", **info)
    problem = describe_source(tmp_path / "a.mcap").problem
    assert problem is not None and "\n" not in problem and "--camera" in problem


def test_a_camera_file_counts_instead(tmp_path: Path) -> None:
    with pytest.raises(RecordingError):
        opened(tmp_path / "a.mcap", model="magic", d=(0.1,))
    (tmp_path / "camera.json").write_text(
        '{"fx": 90, "fy": 95, "cx": 75, "cy": 55, "width": 160, "height": 120, "depth_scale": 1000}'
    )
    source = open_source(tmp_path / "a.mcap", Options(camera=tmp_path / "camera.json"))
    assert same_places(rays(source) * (90, 95) + (75, 55))


def test_odometry_of_raw_pictures_follows_the_rays(tmp_path: Path) -> None:
    """A wall that moves sideways in front of a bent lens: PnP must agree with the points."""
    make, model, rng = Make(), "plumb_bob", np.random.default_rng(3)
    wall = np.kron(rng.integers(0, 256, (150, 150), np.uint8), np.ones((6, 6), np.uint8))
    wall = cv2.GaussianBlur(wall, (0, 0), 1.0)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    bent = Distortion(model, np.array(BENT[model]), False)
    camera, _ = lens_of(make.camera_info(0.0)[3], False)
    places = bent.straight(cv2, camera, np.column_stack([u.ravel(), v.ravel()]))
    assert np.isfinite(places).all()
    flat = (places - (80, 60)) / (100, 110) * DEPTH
    out = []
    for i in range(3):
        there = (flat + np.array([0.1 * i, 0])) * 55 + 300
        on_wall = there.astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        seen = cv2.remap(wall, on_wall[..., 0], on_wall[..., 1], cv2.INTER_LINEAR)
        depth = np.full(seen.shape, int(1000 * DEPTH), np.uint16)
        out.append(make.camera_info(1.0 + i, model=model, d=BENT[model]))
        out.append(make.image("/depth", 1.0 + i, depth, "16UC1"))
        out.append(make.image("/color", 1.0 + i, np.repeat(seen[:, :, None], 3, axis=2), "rgb8"))
    found = list(open_source(write_bag(tmp_path / "walk.mcap", make, out)))
    assert [cycle.session for cycle in found] == [0, 0, 0]
    seen_wall = np.column_stack([flat, np.full(len(flat), DEPTH)])
    for i, cycle in enumerate(found):  # a turn and a step are nearly one, before a wall
        world = seen_wall @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        assert np.abs(world - seen_wall - (0.1 * i, 0, 0)).mean() < 0.01


def test_places_that_no_ray_reaches_are_none() -> None:
    """Far outside, this lens's polynomial turns round: no ray bends to there."""
    camera, none = lens_of(Make().camera_info(0.0)[3], False)
    assert none is None
    bent = Distortion("plumb_bob", np.array([-0.25, 0.0, 0, 0]), False)
    found = bent.straight(cv2, camera, np.array([[80.0, 60.0], [280.0, 60.0]]))
    assert found[0].tolist() == [80, 60] and np.isnan(found[1]).all()
    assert bent.straight(cv2, camera, np.zeros((0, 2))).shape == (0, 2)


def test_names_of_topics_that_are_rectified() -> None:
    names = ("/camera/color/image_rect", "/rgb/rect/image", "/a/image_rect_raw", "/RectColor")
    assert all(map(is_rectified, names))
    assert not any(map(is_rectified, ("/camera/image_raw", "/direct/image", "/unrectified")))


def test_a_message_without_the_fields(tmp_path: Path) -> None:
    info = Make(ros2=False).camera_info(1.0)[3]
    info.width = 0
    with pytest.raises(Unusable, match="not calibrated"):
        lens_of(info, True)
