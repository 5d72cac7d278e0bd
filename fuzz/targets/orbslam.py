"""A map of ORB-SLAM3 in text: a trajectory of key frames and points."""

from __future__ import annotations

import re
from collections.abc import Iterable
from random import Random

from dagmap.io.sources import orbslam
from grammar import Flip
from targets import Target
from targets._files import workplace
from targets._folders import change, pack, read

_FOLDER = workplace() / "map"
_NAME = re.compile(r"[A-Za-z0-9._-]{1,60}\Z")


def run(data: bytes) -> bool:
    return read(orbslam, _FOLDER, data, _NAME)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, rng, flip)


def seeds() -> Iterable[bytes]:
    poses = (b"KeyFrameTrajectory.txt", b"1 0 0 0 0 0 0 1\n1.5 0 0 0.1 0 0 0 1\n")
    points = b"# x y z\n" + b"".join(b"0.%d 0 2\n" % i for i in range(60))
    yield pack([poses, (b"MapPoints.txt", points)])
    yield pack([poses, (b"map_points.csv", b"x,y,z\n0,0,2\n0,0,-2\nnan,0,1\n")])
    yield pack([poses, (b"map_points.csv", b"0,0,2\nx,y\n")])
    yield pack([poses, (b"PointCloud.xyz", b"0 0 1e8 1\n")])
    yield pack([poses, (b"PointCloud.xyz", b"0 0 1e300\n")])
    yield pack([(b"kf_a.txt", b"2e18 0 0 0 0 0 0 1\n"), (b"MapPoints.txt", points)])
    yield pack([(b"kf_a.txt", b"1 0 0 1e9 0 0 0 1\n"), (b"MapPoints.txt", b"0 0 1e9\n")])
    yield pack([(b"kf_a.txt", b"1 0 0 x 0 0 0 1\n"), (b"MapPoints.txt", points)])
    yield pack([(b"kf_a.txt", b"1 2\n"), (b"MapPoints.txt", points)])
    yield pack([(b"kf_a.txt", b"1 0 0 0 9 0 0 1\n"), (b"MapPoints.txt", points)])
    yield pack([(b"kf_a.txt", b"#\n"), (b"MapPoints.txt", points)])
    yield pack([poses, (b"MapPoints.txt", b"#\n")])
    ply = b"ply\nformat ascii 1.0\nelement vertex 1\n"
    ply += b"".join(b"property float %c\n" % axis for axis in b"xyz")
    rgb = b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
    yield pack([poses, (b"PointCloud.ply", ply + rgb + b"end_header\n0 0 2 4 5 6\n")])
    yield pack([poses])
    yield pack([(b"MapPoints.txt", points)])
    yield pack([(b"other.txt", points)])
    damaged = b"x 0 0 0 0 0 0 1\n1403636579763555584.0 0 0 0 0 0 0 1\n"
    yield pack([(b"kf_a.txt", damaged), (b"MapPoints.txt", points)])
    body, seen = (b"body", b""), (b"MapPoints.txt", points)
    mounted = b"T_BS:\n  data: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    mounted += b"resolution: [48, 32]\nintrinsics: [60, 60, 24, 16]\n"
    mounted += b"camera_model: pinhole\ndistortion_model: none\ndistortion_coefficients: []\n"
    yield pack([poses, seen, body])
    yield pack([poses, seen, body, (b"sensor.yaml", mounted)])


PARSERS = {"dagmap.io.sources.orbslam": (), "dagmap.io.sources._trajectory": ()}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=4096)
