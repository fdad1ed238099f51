"""Facts of frames are computed once: found again by what the images show, and anew where anything changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from endoprior.footage import known_facts
from endoprior.footage.known_facts import KnownFacts

IMAGES = [np.random.default_rng(i).integers(0, 255, (64, 96, 3), np.uint8) for i in range(5)]
TISSUE = [np.ones((64, 96), bool)] * 5


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the facts that are computed."""
    made = list[str]()

    def counted(name: str) -> Callable:
        compute = getattr(known_facts, name)

        def instead(*arguments):
            made.append(name)
            return compute(*arguments)

        return instead

    for name in ("find_changes", "camera_motion"):
        monkeypatch.setattr(known_facts, name, counted(name))
    return made


def test_the_same_images_are_measured_once(calls):
    facts = KnownFacts()
    first = facts.find_changes(lambda: IMAGES)
    assert facts.find_changes(lambda: [image.copy() for image in IMAGES]) is first
    motion = facts.camera_motion(lambda: IMAGES, lambda: TISSUE)
    assert facts.camera_motion(lambda: iter(IMAGES), lambda: iter(TISSUE)) is motion
    assert calls == ["find_changes", "camera_motion"]


def test_the_first_time_images_are_opened_once():
    opened = []

    def images() -> Iterator:
        opened.append(1)
        return iter(IMAGES)

    KnownFacts().find_changes(images)
    assert len(opened) == 1


@pytest.mark.parametrize("changed", ["a pixel", "a frame less", "a mask"])
def test_what_changed_is_measured_anew(calls, changed):
    facts = KnownFacts()
    facts.find_changes(lambda: IMAGES)
    facts.camera_motion(lambda: IMAGES, lambda: TISSUE)
    images, tissue = [image.copy() for image in IMAGES], [mask.copy() for mask in TISSUE]
    if changed == "a pixel":
        images[3][7, 9, 1] ^= 1
    elif changed == "a frame less":
        images, tissue = images[:-1], tissue[:-1]
    else:
        tissue[2][40, 50] = False
    facts.camera_motion(lambda: images, lambda: tissue)
    facts.find_changes(lambda: images)
    again = ["camera_motion"] if changed == "a mask" else ["camera_motion", "find_changes"]
    assert calls[2:] == again
