"""An EuRoC folder: sensor.yaml, lists of pictures, ground truth."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from random import Random

import cv2
import numpy as np

from dagmap.io.sources import euroc
from grammar import Flip
from targets import Target
from targets._files import workplace
from targets._folders import WORDS, change, pack, read

_FOLDER = workplace() / "walk"
_NAME = re.compile(r"(mav0/)?((cam0|cam1)/(data/)?|state_groundtruth_estimate0/)?[\w.-]{1,60}\Z")
_WORDS = (*WORDS, "T_BS", "data", "equidistant", "radial-tangential", "plumb_bob", "pinhole", "48")
_WORDS += ("intrinsics", "resolution", "[48, 32]", "[]", "  ", "\t", "1.0\xe9", "1e-300", "-0.1")
_SIZE = (48, 32)
_CAMERA = """T_BS:
  cols: 4
  data: [1, 0, 0, {0},
         0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] # m
resolution: [48, 32]
camera_model: pinhole
intrinsics: [60, 60, 24, 16]
distortion_model: {1}
distortion_coefficients: [{2}]
"""


def run(data: bytes) -> bool:
    return read(euroc, _FOLDER, data, _NAME)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, rng, flip, _WORDS)


def _rig(model: str = "radial-tangential", bent: str = "0.01, 0, 0, 0", far: str = "0.2"):  # type: ignore[no-untyped-def]
    yield b"mav0/cam0/sensor.yaml", _CAMERA.format("0", model, bent).encode()
    yield b"mav0/cam1/sensor.yaml", _CAMERA.format(far, model, bent).encode()


def _pictures() -> Iterator[tuple[bytes, bytes]]:
    """Two pairs of one view, six pixels apart."""
    noise = np.random.default_rng(1).integers(0, 256, (16, 40), np.uint8)
    wide = cv2.resize(noise, (80, 32), interpolation=cv2.INTER_LINEAR)
    for stamp in (1000000000, 1100000000):
        for i, at in enumerate((10, 16)):
            picture = cv2.imencode(".png", np.ascontiguousarray(wide[:, at : at + 48]))[1]
            yield f"mav0/cam{i}/data/{stamp}.png".encode(), picture.tobytes()


def seeds() -> Iterable[bytes]:
    pictures = list(_pictures())
    lists = [
        (
            f"mav0/cam{i}/data.csv".encode(),
            b"#t\n1000000000,1000000000.png\n1100000000,1100000000.png\n",
        )
        for i in (0, 1)
    ]
    truth = b"#t\n1000000000,0,0,0,1,0,0,0,0,0\n1100000000,0.1,0,0,1,0,0,0,0,0\n"
    poses = (b"mav0/state_groundtruth_estimate0/data.csv", truth)
    rig = list(_rig())
    yield pack([*rig, *pictures, *lists, poses])
    yield pack([*rig, *pictures, poses])
    yield pack([*rig, *pictures])
    yield pack([*_rig("equidistant"), *pictures, poses])
    yield pack([*_rig("none", ""), *pictures, poses])
    yield pack([*_rig("magic"), *pictures, poses])
    yield pack([*_rig(far="500"), *pictures])
    yield pack([*_rig(far="-0.2"), *pictures])
    yield pack([*_rig("equidistant", "1, 2"), *pictures])
    yield pack([rig[0], *pictures])
    yield pack([(b"mav0/cam0/", b""), (b"mav0/cam1/", b"")])
    turned = _CAMERA.replace("[1, 0, 0, {0}", "[9, 0, 0, {0}").format("0", "none", "").encode()
    yield pack([(rig[0][0], turned), rig[1], *pictures])
    up = rig[1][1].replace(b"0.2,", b"0,").replace(b"1, 0, 0, 0, 0, 1", b"1, 0, 0.2, 0, 0, 1")
    yield pack([rig[0], (rig[1][0], up), *pictures])
    small = rig[1][1].replace(b"48, 32", b"48, 31")
    yield pack([rig[0], (rig[1][0], small), *pictures])
    both = [(name, text.replace(b"48, 32", b"48, 33")) for name, text in rig]
    yield pack([*both, *pictures])
    yield pack([(rig[0][0], rig[0][1].replace(b"60, 60", b"0, 60")), rig[1], *pictures])
    yield pack([(rig[0][0], rig[0][1].replace(b"60, 60", b"60, x")), rig[1], *pictures])
    yield pack([(rig[0][0], rig[0][1].replace(b"intrinsics", b"others")), rig[1], *pictures])
    yield pack([(rig[0][0], b"\xff"), rig[1], *pictures])
    yield pack([(rig[0][0], b"a\nb: [1\n"), rig[1], *pictures])
    far = truth.replace(b"\n1", b"\n9")
    yield pack([*rig, *pictures, (poses[0], far)])
    yield pack([*rig, *pictures, (poses[0], b"#\n")])
    yield pack([*rig, *pictures, (poses[0], b"1,2\n")])
    yield pack([*rig, *pictures, (poses[0], b"1000000000,0,0,0,x,0,0,0\n")])
    yield pack([*rig, *pictures, lists[0], (lists[1][0], b"#\n")])
    yield pack([*rig, *pictures, lists[0], (lists[1][0], b"1,2,3\n")])
    yield pack([*rig, *pictures, lists[0], (lists[1][0], b"2,a.png\n1,b.png\n")])
    yield pack([*rig, *pictures, lists[0], (lists[1][0], b"x,a.png\n")])
    yield pack([*rig, *pictures, lists[0], (lists[1][0], b"9000000000,1000000000.png\n")])
    yield pack([*rig, *pictures, lists[0], (lists[1][0], b"1000000000,gone.png\n")])
    yield pack([*rig, pictures[0], (pictures[1][0], pictures[1][1][:-9]), poses])
    slam = (b"slam.txt", b"1.0 0 0 0 0 0 0 1\n1100000000e9 0 0 0 0 0 0 1\n")
    yield pack([*rig, *pictures, slam])
    yield pack([*rig, *pictures, slam, (b"body", b"")])
    yield pack([(b"other.txt", b"")])
    yield pack([(name.removeprefix(b"mav0/"), body) for name, body in [*rig, *pictures, poses]])


PARSERS = {
    "dagmap.io.sources.euroc": (),
    "dagmap.io.sources._stereo": (),
}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=32_768)
