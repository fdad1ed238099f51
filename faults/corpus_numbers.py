"""Poses and facts of a sequence: NumPy and JSON files that lie, explode or hold what is no number."""

from __future__ import annotations

import numpy as np
from corpus_case import Case
from corpus_damage import (
    NESTED,
    damaged,
    described,
    entry,
    executing_pickle,
    lying_npy,
    npy,
    npz_bomb,
    pickled_npy,
    poses,
    put,
    without,
)

POSES, FACTS = "poses_bounds.npy", "sequence.json"


def stored(name: str, path: str, content: bytes | str, *says: str) -> Case:
    return Case(name, damaged(put(path, content)), (path, *says))


CASES = [
    Case("no poses", damaged(without(POSES)), (POSES, "no such file")),
    Case("poses of another length", damaged(poses(lambda p: p[:5])), (POSES, "(17, 17)", "(5, 17)")),
    Case("NaN in a pose", damaged(entry(3, 1, np.nan)), (POSES, "NaN")),
    Case("infinity in a pose", damaged(entry(3, 8, np.inf)), (POSES, "infinity")),
    Case("a pose that scales", damaged(entry(2, 0, 2.0)), (POSES, "rotations", "row 2")),
    Case("a pose that mirrors", damaged(entry(2, 0, -1.0)), (POSES, "rotations", "row 2")),
    Case("a camera beyond all bounds", damaged(entry(2, 3, 1e300)), ("data", "1e+300 mm", "frame 2")),
    Case("a focal length of 0 in a pose", damaged(entry(0, 14, 0.0), described(fx=None)), (POSES, "focal")),
    stored("poses in a pickle", POSES, executing_pickle(), "pickle"),
    stored("poses as objects", POSES, pickled_npy(), "pickle"),
    stored("an empty file of poses", POSES, b"", "empty"),
    stored("a shape of terabytes", POSES, lying_npy(), "64 bytes"),
    stored("a negative shape", POSES, lying_npy("(-17, 17)"), "-17"),
    stored("a shape of words", POSES, lying_npy("('a', 'b')"), "shape"),
    stored("a header nested without end", POSES, npy("-" * 9000 + "1")),
    stored("a header that is code", POSES, npy("__import__('os').system('touch executed')")),
    Case("a record in place of numbers", damaged(poses(lambda p: np.zeros(17, [("a", "f8")]))), (POSES,)),
    Case("words in place of numbers", damaged(poses(lambda p: np.full((17, 17), "x"))), (POSES, "finite")),
    Case(
        "an archive that unfolds to 2 GB",
        damaged(lambda d: (d / POSES).write_bytes(npz_bomb())),  # made late: it takes seconds
        (POSES, "1024 MB"),
    ),
    stored("an archive cut short", POSES, b"PK\x03\x04" + bytes(50), "zip"),
    stored("facts that are not JSON", FACTS, "{", "JSON"),
    stored("facts that are a list", FACTS, "[1]", "list"),
    stored("facts nested without end", FACTS, NESTED, "JSON"),
    stored("facts of bytes", FACTS, bytes(range(256)), "JSON"),
    stored("a number of 5000 digits", FACTS, '{"fx": ' + "9" * 5000 + "}", "digits"),
    stored("a focal length of 10^400", FACTS, '{"fx": 1' + "0" * 400 + "}", "fx"),
    Case("a focal length of NaN", damaged(described(fx=float("nan"))), (FACTS, "fx", "nan")),
    Case("a focal length of 1e300", damaged(described(fx=1e300)), (FACTS, "fx", "1e+300")),
    Case("a focal length in words", damaged(described(fx="fifty")), (FACTS, "fx", "fifty")),
    Case("facts of another size", damaged(described(width=640, height=512)), (FACTS, "48x40", "640x512")),
    Case("a unit nobody knows", damaged(described(depth_unit="inch")), (FACTS, "depth_unit", "inch")),
    Case("a format from the future", damaged(described(format_version=99)), (FACTS, "format_version")),
    Case("a depth scale of infinity", damaged(described(depth_scale=float("inf"))), (FACTS, "depth_scale")),
    Case("frames that are not there", damaged(described(unexplained_frames=[99])), (FACTS, "99")),
    Case("a mask value nobody knows", damaged(described(mask_tool_value=7)), (FACTS, "mask_tool_value")),
]
