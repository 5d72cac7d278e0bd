"""Odometry of pictures with depth, where there are no poses: ORB and PnP against a key frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...model import Floats, Uint8s
from ._poses import inverse
from ._rgbd import Camera, Straight

_FEATURES = 2000
_LEAST = 25  # inliers without which it does not know where it is
_SHARE = 0.25  # of all matches: fewer agree by chance
_KEEP = 0.4  # share of a key frame's features that is still seen, or a new one is taken
_PIXELS = 2.5  # error of reprojection of an inlier


class PictureOdometry:
    """Where the camera is, in the frame of the first picture of a session.

    Pictures in which it finds too little of the key frame start a session: a frame of its own.
    straight: see `FrontEnd`.
    """

    def __init__(self, cv2: Any, camera: Camera, straight: Straight | None = None) -> None:
        self._cv2, self._camera, self._straight = cv2, camera, straight
        cv2.setRNGSeed(0)  # RANSAC draws
        self._orb = cv2.ORB_create(nfeatures=_FEATURES)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        self._key: tuple[Floats, Uint8s] | None = None  # points in the world, descriptors
        self._guess = np.eye(4)  # world to camera
        self.session = -1

    def register(self, picture: Uint8s, metres: Floats) -> Floats:
        """(4, 4) of the camera of a picture (H, W, 3) BGR with depths (H, W) m.

        `session` is then the one that the pose belongs to.
        """
        gray = self._cv2.cvtColor(picture, self._cv2.COLOR_BGR2GRAY)
        found, descriptors = self._orb.detectAndCompute(gray, None)
        places = np.array([k.pt for k in found], np.float64).reshape(-1, 2)
        places, pixels, descriptors = self._flattened(places, descriptors)
        inliers = self._find(places, descriptors)
        if inliers < _LEAST:
            self.session, self._guess = self.session + 1, np.eye(4)
        pose = inverse(self._guess)
        if inliers < _LEAST or self._key is None or inliers < _KEEP * len(self._key[0]):
            self._take_key(pose, places, pixels, descriptors, metres)
        return pose

    def _flattened(
        self, seen: Floats, descriptors: Uint8s | None
    ) -> tuple[Floats, Floats, Uint8s | None]:
        """Places as the pinhole has them, as the picture has them, and what is there."""
        if self._straight is None or descriptors is None:
            return seen, seen, descriptors
        places = self._straight(seen)
        good = np.isfinite(places).all(axis=1)
        return places[good], seen[good], np.ascontiguousarray(descriptors[good])

    def _find(self, places: Floats, descriptors: Uint8s | None) -> int:
        """Move the guess to where the key frame's points are seen; the number of inliers."""
        if self._key is None or descriptors is None or len(self._key[0]) < _LEAST:
            return 0
        matches = self._matcher.match(self._key[1], descriptors)
        if len(matches) < _LEAST:
            return 0
        points = self._key[0][[match.queryIdx for match in matches]]
        seen = places[[match.trainIdx for match in matches]]
        turn, _ = self._cv2.Rodrigues(self._guess[:3, :3])
        done, turn, shift, inliers = self._cv2.solvePnPRansac(
            points, seen, self._k, None, turn, self._guess[:3, 3:].copy(), True, 200, _PIXELS, 0.999
        )
        wanted = max(_LEAST, int(_SHARE * len(matches)))
        if not done or inliers is None or len(inliers) < wanted:
            return 0
        rows = inliers.ravel()
        turn, shift = self._cv2.solvePnPRefineLM(
            points[rows], seen[rows], self._k, None, turn, shift
        )
        if not np.isfinite(turn).all() or not np.isfinite(shift).all():
            return 0
        self._guess = np.eye(4)
        self._guess[:3, :3], _ = self._cv2.Rodrigues(turn)
        self._guess[:3, 3] = shift.ravel()
        return len(rows)

    def _take_key(
        self,
        pose: Floats,
        places: Floats,
        pixels: Floats,
        descriptors: Uint8s | None,
        metres: Floats,
    ) -> None:
        if descriptors is None:
            self._key = None
            return
        camera = self._camera
        pixel = np.floor(pixels + 0.5).astype(np.int64)
        pixel = np.clip(pixel, 0, (camera.width - 1, camera.height - 1))
        z = metres[pixel[:, 1], pixel[:, 0]]
        near = np.flatnonzero(np.isfinite(z) & (z > 0))
        z, places = z[near], places[near]
        x = (places[:, 0] - camera.cx) * z / camera.fx
        y = (places[:, 1] - camera.cy) * z / camera.fy
        points = np.stack([x, y, z], axis=1) @ pose[:3, :3].T + pose[:3, 3]
        self._key = points, np.ascontiguousarray(descriptors[near])
