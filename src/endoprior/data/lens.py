"""A calibrated lens as reconstruction programs store it, and the maps that make its images pinhole images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
}
"""COLMAP's camera models in the order of their numbers, and the parameters of each in the order of its files."""
UNSUPPORTED = ("FOV", "THIN_PRISM_FISHEYE")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of OpenCV
FISHEYE = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Lens:
    """Camera matrix and distortion of images of one size."""

    width: int
    height: int
    matrix: NDArray[np.float64]  # (3, 3) K, px; the left-most pixel is centered at 0.5
    distortion: NDArray[np.float64]  # (8,) k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV, or (4,) k1 k2 k3 k4 of a fisheye

    @classmethod
    def of(cls, model: str, width: int, height: int, values: dict[str, float]) -> Lens:
        """The lens of a model with these parameters; those that are not given are 0, and the center that of the image.

        Raises:
            ValueError: the model is not supported, or has no focal length above 0.
        """
        if model not in MODELS or model in UNSUPPORTED:
            raise ValueError(f"the camera model {model}")
        fx = values.get("fx", values.get("f", 0.0))
        fy, cx, cy = values.get("fy", fx), values.get("cx", width / 2), values.get("cy", height / 2)
        names = FISHEYE if model.endswith("FISHEYE") else COEFFICIENTS
        distortion = np.array([values.get(name, 0.0) for name in names])
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        if not (min(fx, fy) > 0 and np.isfinite(matrix).all() and np.isfinite(distortion).all()):
            raise ValueError(f"focal lengths {fx:g}, {fy:g} px")
        return cls(width, height, matrix, distortion)

    @property
    def is_bent(self) -> bool:
        """Whether images are not those of a pinhole camera."""
        return len(self.distortion) == len(FISHEYE) or bool(self.distortion.any())

    def scaled(self, width: int, height: int) -> Lens:
        """The lens in px of images of another size."""
        grow = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, matrix=grow @ self.matrix)


class Undistorter:
    """Resamples images of a lens to the pinhole camera of the same matrix and size. The periphery may be lost."""

    def __init__(self, lens: Lens) -> None:
        self.lens = lens

    @cached_property
    def _maps(self) -> tuple[NDArray, NDArray] | None:
        """Column and row in the original of each pixel; None if the images stay as they are."""
        lens = self.lens
        if not lens.is_bent:
            return None
        matrix = lens.matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # OpenCV counts pixel centers from 0
        make = cv2.fisheye.initUndistortRectifyMap if len(lens.distortion) == 4 else cv2.initUndistortRectifyMap
        return make(matrix, lens.distortion, np.eye(3), matrix, (lens.width, lens.height), cv2.CV_32FC1)

    @cached_property
    def shown(self) -> NDArray[np.bool_]:
        """(H, W) True where the original shows something."""
        return self.nearest(np.ones((self.lens.height, self.lens.width), np.uint8)) > 0

    def smooth(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) bicubic."""
        return image if self._maps is None else np.asarray(cv2.remap(image, *self._maps, cv2.INTER_CUBIC), np.uint8)

    def nearest(self, image: NDArray) -> NDArray:
        """(H, W) nearest pixel, 0 outside of the original."""
        return image if self._maps is None else cv2.remap(image, *self._maps, cv2.INTER_NEAREST)
