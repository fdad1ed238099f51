"""Facts of all frames of a clip that several steps need: each is computed once, and handed on to the next step.

A fact is found again by what the images show, not by where they come from: a frame that was changed in between, or left
out, has facts of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from hashlib import blake2b
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .camera_motion import CameraMotion, camera_motion
from .changes import Changes, find_changes
from .image_operations import Image, InOrder, Mask

Array = TypeVar("Array", Image, Mask)


class KnownFacts:
    """The facts of the last images that were asked for."""

    def __init__(self) -> None:
        self._changes: tuple[bytes, Changes] | None = None
        self._motion: tuple[bytes, CameraMotion] | None = None

    def find_changes(self, images: Callable[[], Iterable[Image]], each: InOrder = map) -> Changes:
        """`changes.find_changes`. Args: images: opens the images (H, W, 3), in order."""
        if self._changes is None or self._changes[0] != _digest(images()):
            seen = _Seen()
            found = find_changes(seen.along(images()), each)
            self._changes = seen.digest, found
        return self._changes[1]

    def camera_motion(
        self, images: Callable[[], Iterable[Image]], tissue: Callable[[], Iterable[Mask]], each: InOrder = map
    ) -> CameraMotion:
        """`camera_motion.camera_motion`. Args: tissue: opens the masks (H, W), True on tissue."""
        if self._motion is None or self._motion[0] != _digest(images()) + _digest(tissue()):
            colors, masks = _Seen(), _Seen()
            found = camera_motion(colors.along(images()), masks.along(tissue()), each)
            self._motion = colors.digest + masks.digest, found
        return self._motion[1]


class _Seen:
    """A digest of arrays that are on their way to somebody else."""

    def __init__(self) -> None:
        self._hash = blake2b(digest_size=16)

    def along(self, arrays: Iterable[Array]) -> Iterator[Array]:
        """The arrays, each of which counts."""
        for array in arrays:
            self._hash.update(repr(array.shape).encode())
            self._hash.update(np.ascontiguousarray(array).data)
            yield array

    @property
    def digest(self) -> bytes:
        """Of the arrays so far."""
        return self._hash.digest()


def _digest(arrays: Iterable[NDArray]) -> bytes:
    seen = _Seen()
    for _ in seen.along(arrays):
        pass
    return seen.digest
