"""Each plugin of this package, as EndoPrior-GS finds and uses it. Needs `endoprior` and this package installed."""

import json

import numpy as np
import pytest

from endoprior import evaluate, load_sequence
from endoprior.cli import main
from endoprior.data.images import save_png
from endoprior.export.formats import load_format
from endoprior_studies.method import method_named

WIDTH, HEIGHT, FRAMES = 32, 24, 10


@pytest.fixture
def folder(tmp_path):
    """A folder as `endoprior render` writes it: a gray image that gets brighter by 10 levels a frame."""
    for name in ("rgb", "depth"):
        (tmp_path / "data" / name).mkdir(parents=True)
    for i in range(FRAMES):
        save_png(tmp_path / "data" / "rgb" / f"{i:06d}.png", np.full((HEIGHT, WIDTH, 3), 10 * i, np.uint8))
        np.save(tmp_path / "data" / "depth" / f"{i:06d}.npy", np.full((HEIGHT, WIDTH), 50 + i, np.float32))
    return tmp_path / "data"


def test_the_four_plugins_are_listed(capsys):
    assert main(["plugins"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    found = {(kind, name) for kind, name, *package in lines if package[:1] == ["endoprior-example"]}
    plugins = {("datasets", "rendered"), ("methods", "nearest-frame"), ("scores", "mae"), ("exporters", "transforms")}
    assert found == plugins


def test_the_layout_is_recognized(folder):
    sequence = load_sequence(folder)
    assert len(sequence) == FRAMES and sequence.frame(3).rgb_u8[0, 0, 0] == 30
    assert sequence.frame(3).depth[0, 0] == 53


@pytest.mark.parametrize(("num_frames", "errors"), [(1, (10, 10)), (2, (0, 15)), (100, (34, 46))])
def test_the_method_and_the_score(folder, tmp_path, num_frames, errors):
    """Frames 1 and 9 are scored. The nearest are 0 and 8, then 2 and 7; the mean of all training frames is 44."""
    sequence, method = load_sequence(folder), method_named("nearest-frame")
    options = type(method.options)(num_frames=num_frames)
    found = method.train(sequence.training_view(), options, seed=0, out=tmp_path / "out")
    result = evaluate(found, sequence, networks=False)
    assert "psnr" in result.scores and "num_gaussians" in result.skipped
    assert result.scores["mae"] == pytest.approx(100 * np.mean(errors) / 255)


def test_the_export_format(tmp_path):
    class Camera:
        fx = fy = 50.0
        cx, cy, width, height = 16.0, 12.0, WIDTH, HEIGHT
        world_to_camera = np.eye(4)

    class Scene:
        cameras = (Camera(), Camera())

    load_format("transforms").write(Scene(), tmp_path / "transforms.json", None, lambda done, total: None)
    first, second = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert second["time"] == 0.5 and first["fl_x"] == 50
    assert np.diag(first["transform_matrix"]).tolist() == [1, -1, -1, 1]
