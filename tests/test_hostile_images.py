"""Small images and videos that unfold to gigabytes; encoders that run out of memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from endoprior.data.images import save_png
from endoprior.data.reading import MAX_PIXELS

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))
from corpus_damage import jpeg_bomb, jpeg_of_two_sizes, mov_bomb, png_bomb, tiff_bomb

OPENED = """
import resource, sys
from pathlib import Path
from endoprior.system.surroundings import set_up_process
set_up_process()
from endoprior.core.checks import InputError
from endoprior.data import images
from endoprior.data.images import ImageHeader
from endoprior.prepare.video import Video

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

deceived, *files = sys.argv[1:]
if deceived == "True":
    images.read_header = lambda encoded: ImageHeader(48, 40, 1)
before = peak()
for file in map(Path, files):
    try:
        print(Video(file) if file.suffix == ".mov" else images.decode_image(file, None).shape)
    except InputError as error:
        print(str(error).removeprefix(str(file.parent)))
print((peak() - before) // 1024)
"""
"""Prints the error of each file, and by how many MB (KB on macOS) the largest use of memory has grown."""
EMPTY_PNG = np.frombuffer(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(17), np.uint8)
BOMBS = {
    "a.jpg": jpeg_bomb(),
    "b.jpg": jpeg_of_two_sizes(),
    "c.tif": tiff_bomb((20000, 20000)),
    "d.tif": tiff_bomb((20000, 20000), (64, 48)),
    "e.png": png_bomb(),
}
VIDEOS = {"f.mov": mov_bomb(png_bomb(16000, 15000)), "g.mov": mov_bomb(jpeg_bomb(16000, 16000), "mjpeg")}
OUT_OF_MEMORY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
static int left;
static void *(*real)(unsigned long);
void fail_at(int n) { left = n; }
void *malloc(unsigned long size) {
  if (!real) real = dlsym(RTLD_NEXT, "malloc");
  return left > 0 && size >= 30000 && --left == 0 ? 0 : real(size);
}
"""
"""A library that lets the n-th allocation of at least 30,000 bytes fail."""
MASKS = """
import ctypes, os, sys
from pathlib import Path
import cv2, numpy as np
from endoprior.data.images import save_png
fail_at, file = ctypes.CDLL(os.environ["LD_PRELOAD"]).fail_at, Path(sys.argv[1])
for n in range(1, 40):
    file.unlink(missing_ok=True)
    fail_at(n)
    try:
        save_png(file, np.zeros((1080, 1920), np.uint8))
        error = None
    except (MemoryError, cv2.error) as caught:
        error = caught
    fail_at(0)
    assert file.exists() is (error is None) and (error or cv2.imdecode(np.fromfile(file, np.uint8), -1) is not None)
    print(type(error).__name__)
"""


def opened(folder: Path, files: dict[str, bytes], deceived: bool = False) -> tuple[list[str], int]:
    """What a process of its own says of each file, and how much memory it took for them, MB."""
    for name, content in files.items():
        (folder / name).write_bytes(content)
    words = [sys.executable, "-c", OPENED, str(deceived), *(str(folder / name) for name in files)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    assert not done.stderr
    *said, grown = done.stdout.splitlines()
    return said, int(grown) // (1024 if sys.platform == "darwin" else 1)


@pytest.mark.slow
def test_images_and_videos_are_rejected_before_they_unfold(tmp_path):
    assert sum(map(len, (BOMBS | VIDEOS).values())) < 600_000
    said, grown = opened(tmp_path, BOMBS | VIDEOS)
    for name, side in (("a.jpg", 65500), ("c.tif", 20000), ("d.tif", 20000), ("e.png", 60000)):
        size = f"{side}x{side}"
        assert f"/{name}: expected an image of at most 64 Mpx, got {size} px in its header. Fix: Scale it down." in said
    assert "cannot be decoded" in said[1] and all(
        "at most 64 Mpx, got none that can be decoded" in line for line in said[5:]
    )
    assert len(said) == 7 and grown < 100


@pytest.mark.slow
def test_the_decoder_of_images_has_the_same_limit(tmp_path):
    said, grown = opened(tmp_path, BOMBS, deceived=True)
    assert all("cannot be decoded" in line for line in said) and grown < 100


def test_opencv_is_told_the_limit():
    code = "import os; from endoprior.cli import main; main([]); print(os.environ['OPENCV_IO_MAX_IMAGE_PIXELS'])"
    environment = {name: value for name, value in os.environ.items() if "OPENCV" not in name}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[-1]) == MAX_PIXELS


@pytest.mark.parametrize("answer", [(False, EMPTY_PNG), (True, EMPTY_PNG), (False, None)])
def test_an_encoder_that_stops_writes_nothing(tmp_path, monkeypatch, answer):
    monkeypatch.setattr(cv2, "imencode", lambda *options: answer)
    with pytest.raises(MemoryError, match="PNG encoder"):
        save_png(tmp_path / "a.png", np.zeros((8, 8), np.uint8))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="replaces malloc by LD_PRELOAD")
def test_masks_are_written_whole_or_not_at_all_when_memory_runs_out(tmp_path):
    (tmp_path / "a.c").write_text(OUT_OF_MEMORY)
    library = tmp_path / "a.so"
    try:
        subprocess.run(["gcc", "-shared", "-fPIC", "-w", "-o", library, tmp_path / "a.c", "-ldl"], check=True)
    except FileNotFoundError:
        pytest.skip("needs gcc")
    words = [sys.executable, "-c", MASKS, str(tmp_path / "mask.png")]
    environment = os.environ | {"LD_PRELOAD": str(library)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]
    assert "MemoryError" in done.stdout and done.stdout.endswith("NoneType\n")
