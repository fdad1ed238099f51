"""Make the pictures of the documentation again: `make figures`, or `python bench/figures.py WORK`.

Writes docs/images/report.jpg from the demo, player.jpg and viewer.jpg from its scene in headless Chromium, and
own_video.jpg from the two clips that `ENDOPRIOR_DATA` holds (`bowel_lift_stereo_sbs.mp4` with its .json,
`mono_endo.mp4`). WORK keeps sequences and runs; what is there is not made again. Pictures of benchmarks come from
bench/publish.py.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

IMAGES = Path(__file__).parents[1] / "docs" / "images"
WIDTH_PX = 1280
JPEG_QUALITY = 85
PORT = 8199
PAGE_SECONDS = 12.0
"""A page drawn without a graphics card takes its time."""
CLIPS = {"stereo": ("bowel_lift_stereo_sbs.mp4", "bowel_lift_stereo.json", 97), "mono": ("mono_endo.mp4", None, 169)}
"""Video, calibration and the held-out frame that is shown."""


def endoprior(*args: object) -> None:
    subprocess.run([sys.executable, "-m", "endoprior", *map(str, args)], check=True)


def save(name: str, picture: np.ndarray) -> None:
    """Write (H, W, 3) BGR as docs/images/`name`, at most `WIDTH_PX` wide."""
    factor = min(1.0, WIDTH_PX / picture.shape[1])
    small = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(IMAGES / name), small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    print(IMAGES / name)


def report(work: Path) -> None:
    if not (work / "demo" / "report.png").exists():
        endoprior("demo", work / "demo")
    save("report.jpg", cv2.imread(str(work / "demo" / "report.png")))


def own_video(work: Path, data: Path) -> None:
    """Input, model and depth of a held-out frame of each clip, one below the other."""
    rows = []
    for name, (video, calibration, frame) in CLIPS.items():
        sequence, run, renders = (work / f"{name}_{part}" for part in ("sequence", "run", "renders"))
        if not sequence.exists():
            options = ["--calibration", data / calibration] if calibration else []
            endoprior("prepare", data / video, sequence, *options)
        if not (run / "metrics.json").exists():
            endoprior("train", sequence, run, "--no-networks")
        if not renders.exists():
            endoprior("render", run, renders, "--split", "test")
        rows.append(cv2.imread(str(renders / "side_by_side" / f"{frame:06d}.png")))
    save("own_video.jpg", np.vstack(rows))


def pages(work: Path) -> None:
    """The player and the viewer in headless Chromium, both with the demo's scene."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from browser import chromium_path, open_page

    if chromium_path() is None:
        print("player.jpg, viewer.jpg: left as they are, because there is no Chromium")
        return
    run, player = work / "demo" / "run", (work / "player.html").absolute()
    if not player.exists():
        endoprior("export", run, player, "--format", "html", "--title", "Phantom")
    with open_page(player.as_uri(), width=1100, height=760) as page:
        page.wait_for("document.readyState == 'complete'")
        time.sleep(PAGE_SECONDS)
        page.screenshot(work / "player.png")
    command = [sys.executable, "-m", "endoprior", "view", "demo/run", "--port", str(PORT)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, encoding="utf-8", cwd=work) as viewer:
        try:
            print(viewer.stdout.readline().strip())
            with open_page(f"http://127.0.0.1:{PORT}", width=1100, height=760) as page:
                time.sleep(PAGE_SECONDS)
                page.evaluate("document.querySelectorAll('[class*=Notification-close]').forEach(b => b.click())")
                time.sleep(1.0)
                page.screenshot(work / "viewer.png")
        finally:
            viewer.terminate()
    save("player.jpg", cv2.imread(str(work / "player.png")))
    save("viewer.jpg", cv2.imread(str(work / "viewer.png")))


def main() -> None:
    work, data = Path(sys.argv[1] if len(sys.argv) > 1 else "figures"), os.environ.get("ENDOPRIOR_DATA")
    work.mkdir(parents=True, exist_ok=True)
    report(work)
    pages(work)
    if data and all((Path(data) / video).exists() for video, _, _ in CLIPS.values()):
        own_video(work, Path(data))
    else:
        print("own_video.jpg: left as it is, because ENDOPRIOR_DATA does not hold the two clips")


if __name__ == "__main__":
    main()
