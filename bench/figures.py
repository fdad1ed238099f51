"""Make the pictures of the documentation again: `make figures`, or `python bench/figures.py WORK`.

Writes docs/images/report.jpg from the demo, player.jpg and viewer.jpg from its scene in headless Chromium, and
own_video.jpg, length.jpg, moving_pyvista.jpg and moving_blender.jpg from the clips that `ENDOPRIOR_DATA` holds
(`bowel_lift_stereo_sbs.mp4` with its .json, `mono_endo.mp4`, `bowel_lift`). The last two need PyVista, and Blender as
tests/programs.py finds it. WORK keeps sequences and runs; what is there is not made again. Pictures of benchmarks come
from bench/publish.py.
"""

from __future__ import annotations

import os
import re
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
LENGTH, LENGTH_FRAMES = ((230, 140), (380, 100)), (0, 46, 80)
"""Two points of the first frame of `bowel_lift`, px, and the frames that are shown."""

MAX_MOVED_MM = 60.0
"""End of the color scale of its displacement."""
IN_BLENDER = (0, 80)
"""Frames of `bowel_lift` that Blender shows."""
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


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


def length(work: Path, data: Path) -> None:
    """A distance of two points of the tissue over time, with its range, beside three frames that show them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    run, measures, tracks = (work / f"length_{part}" for part in ("run", "measures", "tracks"))
    points = work / "length_points.csv"
    points.write_text("x,y,frame\n" + "".join(f"{x},{y},0\n" for x, y in LENGTH), encoding="utf-8")
    if not (run / "metrics.json").exists():
        endoprior("train", data / "bowel_lift", run, "--preset", "preview", "--no-networks")
    for out, name in ((measures, "measures"), (tracks, "tracks")):
        if not out.exists():
            endoprior("export", run, out, "--format", name, "--points", points)
    table = np.genfromtxt(measures / "measures.csv", delimiter=",", names=True)
    seconds, distance, half = (table[name] for name in ("seconds", "distance_mm", "distance_range95_mm"))
    pixels = np.load(tracks / "tracks.npz")["pixels"]
    figure = Figure(figsize=(12.8, 3.2), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    *shown, curve = figure.subplots(1, 4, width_ratios=[1, 1, 1, 1.5])
    images = sorted((data / "bowel_lift" / "images").iterdir())
    for axis, frame in zip(shown, LENGTH_FRAMES, strict=True):
        axis.imshow(cv2.imread(str(images[frame]))[..., ::-1])
        axis.plot(*pixels[frame].T, "o-", color="yellow", linewidth=1.5, markersize=4)
        axis.set_title(f"{seconds[frame]:.1f} s: {distance[frame]:.1f} ± {half[frame]:.1f} mm", fontsize=10)
        axis.set_axis_off()
        curve.axvline(seconds[frame], color="gray", linewidth=0.8, linestyle=":")
    curve.fill_between(seconds, distance - half, distance + half, color="C0", alpha=0.25, linewidth=0)
    curve.plot(seconds, distance, color="C0")
    curve.set(xlabel="s", ylabel="mm", title="distance, and where 95 % of the true ones lie")
    curve.title.set_fontsize(10)
    curve.grid(alpha=0.3)
    figure.savefig(work / "length.png")
    save("length.jpg", cv2.imread(str(work / "length.png")))


def moving_in_pyvista(work: Path) -> None:
    """How far the surface of `bowel_lift` has moved, over time, as PyVista shows `surface.pvd`."""
    try:
        import pyvista
    except ImportError:
        print("moving_pyvista.jpg: left as it is, because there is no PyVista")
        return
    from endoprior import load_scene

    camera, shown = load_scene(work / "length_run").cameras[0], []
    reader = pyvista.get_reader(str(work / "length_measures" / "surface.pvd"))
    for frame in LENGTH_FRAMES:
        plotter = pyvista.Plotter(off_screen=True, window_size=(640, 512))
        reader.set_active_time_value(reader.time_values[frame])
        bar = {"title": "displacement, mm", "color": "white", "fmt": "%.0f"}
        look = {"cmap": "turbo", "clim": (0, MAX_MOVED_MM), "ambient": 0.4, "scalar_bar_args": bar}
        plotter.add_mesh(reader.read()[0], scalars="displacement", **look)
        plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = (0, 0, 0), (0, 0, 1), (0, -1, 0)
        plotter.camera.view_angle = float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy)))
        shown.append(plotter.screenshot(return_img=True)[..., ::-1])
    save("moving_pyvista.jpg", np.hstack(shown))


def moving_in_blender(work: Path) -> None:
    """The surface of `bowel_lift` in the OpenUSD stage, as Blender renders it through the stage's camera."""
    from programs import blender, open_in_blender

    if not blender():
        print("moving_blender.jpg: left as it is, because there is no Blender")
        return
    stage, shown = work / "moving.usdz", []
    if not stage.exists():
        endoprior("export", work / "length_run", stage, "--mesh-step", 4)
    for frame in IN_BLENDER:
        picture = (work / f"blender_{frame}.png").absolute()
        open_in_blender(stage.absolute(), work.absolute(), [frame], str(picture))
        shown.append(cv2.imread(str(picture)))
    save("moving_blender.jpg", np.hstack(shown))


def pages(work: Path) -> None:
    """The player and the viewer in headless Chromium, both with the demo's scene."""
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
            address = next(found[0] for line in viewer.stdout if (found := re.search(r"http://\S+", line)))
            with open_page(address, width=1100, height=760) as page:
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
        length(work, Path(data))
        moving_in_pyvista(work)
        moving_in_blender(work)
    else:
        print("pictures of clips: left as they are, because ENDOPRIOR_DATA does not hold them")


if __name__ == "__main__":
    main()
