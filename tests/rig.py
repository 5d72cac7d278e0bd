"""A textured room as two pinhole cameras with bent lenses see it, laid out as EuRoC does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

SIZE = (320, 240)  # pixels
K = (np.array([[200.0, 0, 158], [0, 202.0, 121], [0, 0, 1]]),
     np.array([[203.0, 0, 161], [0, 201.0, 118], [0, 0, 1]]))  # fmt: skip
BENT = (np.array([-0.15, 0.03, 0.0005, -0.0004]), np.array([-0.14, 0.025, -0.0003, 0.0005]))
ROOM = np.array([1.2, 1.0, 2.5])  # m, half of its edges; cameras look along +z
START = 1403636579763555584  # ns
STEP = 50_000_000
BASELINE = 0.12  # m


def turn(x: float, y: float, z: float) -> np.ndarray:
    return np.array(cv2.Rodrigues(np.array([x, y, z], np.float64))[0])


def rigid(rotation: np.ndarray, place: tuple[float, ...]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, place
    return out


# Where the cameras are in the body: not its axes, and not quite parallel.
MOUNTED = (rigid(turn(0.02, -0.03, 1.5), (-0.02, -0.06, 0.01)),)
MOUNTED += (MOUNTED[0] @ rigid(turn(0.01, 0.02, -0.008), (BASELINE, 0.001, -0.002)),)


def camera_pose(i: int) -> np.ndarray:
    """Of the left camera in the room."""
    return rigid(turn(0.01 * i, 0.015 * i, 0.005 * i), (0.06 * i - 0.3, 0.01 * i, 0.03 * i))


def texture() -> np.ndarray:
    """Noise on several scales: every place looks different."""
    rng, size = np.random.default_rng(5), 1024
    out = np.zeros((size, size))
    for edge, weight in ((8, 0.4), (16, 0.7), (32, 1.0), (64, 0.8)):
        small = rng.normal(size=(size // edge, size // edge)).astype(np.float32)
        out += weight * cv2.resize(small, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 50 * out, 0, 255).astype(np.float32)


def render(pose: np.ndarray, camera: int, wall: np.ndarray, fisheye: bool = False) -> np.ndarray:
    """(H, W) uint8: what a camera of the rig sees at a pose (4, 4)."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    flat = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    rays = np.column_stack([flat(pixels, K[camera], BENT[camera])[:, 0], np.ones(u.size)])
    rays = rays @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        steps = (np.sign(rays) * ROOM - pose[:3, 3]) / rays
    axis = np.argmin(np.where(steps > 0, steps, np.inf), axis=1)
    hit = pose[:3, 3] + rays * steps[np.arange(len(rays)), axis][:, None]
    other = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    place = np.take_along_axis(hit, other, axis=1)
    side = axis * 2 + (np.take_along_axis(rays, axis[:, None], axis=1)[:, 0] > 0)
    place = (place * 100 + 37 * side[:, None]).astype(np.float32) % 1023
    seen = cv2.remap(wall, *(place[:, i].reshape(v.shape) for i in (0, 1)), cv2.INTER_LINEAR)
    return seen.astype(np.uint8)


def sensor_yaml(camera: int, **changed: str) -> str:
    rows = ",\n         ".join(", ".join(map(str, row)) for row in MOUNTED[camera])
    k = K[camera]
    values = {
        "sensor_type": "camera",
        "T_BS": f"\n  cols: 4\n  rows: 4\n  data: [{rows}]",
        "rate_hz": "20",
        "resolution": f"[{SIZE[0]}, {SIZE[1]}]",
        "camera_model": "pinhole",
        "intrinsics": f"[{k[0, 0]}, {k[1, 1]}, {k[0, 2]}, {k[1, 2]}] #fu, fv, cu, cv",
        "distortion_model": "radial-tangential",
        "distortion_coefficients": f"[{', '.join(map(str, BENT[camera]))}]",
    } | changed
    lines = ["#Default camera sensor yaml file", *(f"{key}: {v}" for key, v in values.items())]
    return "\n".join(lines) + "\n"


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """x y z w."""
    axis = cv2.Rodrigues(rotation)[0].ravel()
    half = np.linalg.norm(axis) / 2
    return np.array([*(axis / max(2 * half, 1e-12) * np.sin(half)), np.cos(half)])


def write_rig(path: Path, count: int, truth: bool = True, fisheye: bool = False) -> Path:
    """A recording of `count` pairs under path/mav0."""
    wall = texture()
    stamps = [START + STEP * i for i in range(count)]
    for camera in (0, 1):
        folder = path / "mav0" / f"cam{camera}"
        (folder / "data").mkdir(parents=True)
        model = {"distortion_model": "equidistant"} if fisheye else {}
        (folder / "sensor.yaml").write_text(sensor_yaml(camera, **model))
        for i, stamp in enumerate(stamps):
            pose = camera_pose(i) @ np.linalg.inv(MOUNTED[0]) @ MOUNTED[camera]
            seen = render(pose, camera, wall, fisheye)
            cv2.imwrite(str(folder / "data" / f"{stamp}.png"), seen)
        lines = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
        (folder / "data.csv").write_text("#timestamp [ns],filename\r\n" + lines)
    if truth:
        folder = path / "mav0" / "state_groundtruth_estimate0"
        folder.mkdir()
        lines = "#timestamp, p_RS_R_x [m], ..., q_RS_w [], q_RS_x [], ..., v_RS_R_x [m s^-1]\n"
        for i, stamp in enumerate(stamps):
            body = camera_pose(i) @ np.linalg.inv(MOUNTED[0])
            x, y, z, w = quaternion(body[:3, :3])
            row = [*body[:3, 3], w, x, y, z, 0, 0, 0, 0, 0, 0, 0, 0, 0]
            lines += f"{stamp}," + ",".join(map(str, row)) + "\n"
        (folder / "data.csv").write_text(lines)
    return path


def tum(count: int, nanoseconds: bool = False, body: bool = False) -> str:
    """Poses of the left camera, or of the body, as an inertial SLAM has them."""
    lines = ""
    for i in range(count):
        stamp, pose = START + STEP * i, camera_pose(i)
        pose = pose @ np.linalg.inv(MOUNTED[0]) if body else pose
        moment = f"{stamp}.000000" if nanoseconds else f"{stamp / 1e9:.6f}"
        numbers = [*pose[:3, 3], *quaternion(pose[:3, :3])]
        lines += " ".join([moment, *map(str, numbers)]) + "\n"
    return lines


def off_walls(points: np.ndarray) -> np.ndarray:
    """(N,) m from the nearest wall of the room, for points (N, 3) in it."""
    return np.abs(np.abs(points) - ROOM).min(axis=1)
