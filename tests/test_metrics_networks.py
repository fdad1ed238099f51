"""RAFT and LPIPS with real weights where they are at hand, and the reasons given where they are not.

Weights are taken from `ENDOPRIOR_WEIGHTS` or from `../shared/weights` beside the checkout; nothing is downloaded.
"""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from endoprior.evaluation.networks import (
    ALEXNET,
    RAFT_LARGE,
    RAFT_SMALL,
    SQUEEZENET,
    VGG16,
    WeightsMissing,
    find_weights,
    import_torchvision,
)
from endoprior.evaluation.score import ScoreUnavailable
from endoprior.evaluation.scorers.lpips import lpips_distance
from endoprior.evaluation.scorers.motion import flow_error, raft_flow

pytestmark = pytest.mark.skipif(
    not all(find_spec(package) for package in ("lpips", "torchvision")),
    reason="NETWORK SCORES ARE NOT TESTED: pip install -c constraints.txt torchvision lpips",
)

WEIGHTS = Path(os.environ.get("ENDOPRIOR_WEIGHTS", Path(__file__).parents[2] / "shared" / "weights"))


def need_weights(files):
    """The folder of weights, or a skip that says what is not tested."""
    try:
        find_weights(files, WEIGHTS if WEIGHTS.is_dir() else None, download=False)
    except WeightsMissing as reason:
        pytest.skip(f"{files.network} IS NOT TESTED: {reason}")
    return WEIGHTS if WEIGHTS.is_dir() else None


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small images gain nothing from threads, and waiting for threads is slow where other programs use the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def constant_weights(build, prefix: str = "") -> dict[str, torch.Tensor]:
    """Weights of the right names and shapes, all 0.01, for the part of a network whose names start with `prefix`."""
    with torch.device("meta"):  # shapes alone: no time is spent on random weights
        state = build().state_dict()
    return {name: torch.full(value.shape, 0.01) for name, value in state.items() if name.startswith(prefix)}


@pytest.fixture(scope="module")
def raft_small():
    return raft_flow("small", need_weights(RAFT_SMALL), download=False)


@pytest.fixture(scope="module")
def lpips_squeeze():
    return lpips_distance("squeeze", need_weights(SQUEEZENET), download=False)


@pytest.fixture
def no_weights(tmp_path, monkeypatch):
    """Places without any weights."""
    monkeypatch.delenv("ENDOPRIOR_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    return tmp_path


def texture(height: int, width: int, shift: tuple[int, int] = (0, 0)) -> np.ndarray:
    """(H, W, 3) uint8 crop of a smooth random texture whose content is moved by `shift` (x, y) px."""
    noise = np.random.default_rng(0).normal(size=(height + 20, width + 20, 3))
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    x, y = 10 - shift[0], 10 - shift[1]
    return np.ascontiguousarray(smooth[y : y + height, x : x + width])


# 131 x 163 is no multiple of 8: the images are padded and the flow is cut back.
@pytest.mark.parametrize(("height", "width"), [(128, 160), (131, 163)])
def test_raft_small_recovers_a_shift(raft_small, height, width):
    flow = raft_small(texture(height, width), texture(height, width, (3, 2)))
    assert flow.shape == (height, width, 2)
    # 0.3 px: so small an image is little more than border for RAFT (0.05 px is measured at 640x512); a swapped axis,
    # a wrong sign or a wrong input scale misses by more than 1 px.
    assert np.abs(np.median(flow, (0, 1)) - (3, 2)).max() < 0.3


def test_raft_input_is_scaled_as_torchvisions_preset_does(raft_small):
    a, b = texture(128, 160), texture(128, 160, (3, 2))
    preset = import_torchvision().models.optical_flow.Raft_Small_Weights.DEFAULT.transforms()
    tensors = preset(*(torch.from_numpy(image).permute(2, 0, 1)[None] for image in (a, b)))
    with torch.inference_mode():
        want = raft_small.network(*tensors)[-1][0].permute(1, 2, 0).numpy()
    # 0.01 px: the scaling differs in its last float32 bit, which twelve recurrent updates amplify.
    np.testing.assert_allclose(raft_small(a, b), want, atol=0.01)


def test_raft_error_of_the_target_against_itself_is_zero(raft_small):
    images, masks = [texture(128, 160), texture(128, 160, (3, 2))], [np.ones((128, 160), bool)] * 2
    assert flow_error(images, images, masks, raft_small) == 0


def test_raft_names_bad_images(raft_small):
    with pytest.raises(ScoreUnavailable, match="at least 128 px a side; got 160x127"):
        raft_small(texture(127, 160), texture(127, 160))
    with pytest.raises(ValueError, match="second must have shape"):
        raft_small(texture(128, 160), texture(128, 168))


def test_lpips_squeeze_is_zero_for_equal_images_and_grows_with_blur(lpips_squeeze):
    image, mask = texture(96, 96).astype(np.float32) / 255, np.ones((96, 96), bool)
    blurred = [cv2.GaussianBlur(image, (0, 0), sigma) for sigma in (1, 2, 4, 8)]
    distances = [lpips_squeeze(x, image, mask) for x in (image, *blurred)]
    assert distances[0] == 0
    assert all(a < b for a, b in pairwise(distances))
    assert distances[-1] > 0.1


def test_lpips_equals_the_packages_own_call(lpips_squeeze):
    image, target = (texture(96, 96, shift).astype(np.float32) / 255 for shift in ((0, 0), (5, 3)))
    tensors = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (image, target)]
    with torch.inference_mode():
        want = float(lpips_squeeze.network(*tensors, normalize=True))  # takes [0, 1] and scales to [-1, 1] itself
    assert lpips_squeeze(image, target, np.ones((96, 96), bool)) == pytest.approx(want, rel=1e-5)  # float32


def test_lpips_ignores_what_is_outside_the_mask(lpips_squeeze):
    image, target, mask = texture(64, 64) / 255, texture(64, 64, (5, 3)) / 255, np.ones((64, 64), bool)
    mask[:, 40:] = False
    want = lpips_squeeze(image, target, mask)
    image[:, 40:], target[:, 40:] = 0.9, 0.1
    assert lpips_squeeze(image, target, mask) == want
    assert np.isnan(lpips_squeeze(image, target, ~np.ones((64, 64), bool)))


def test_lpips_names_bad_images(lpips_squeeze):
    image, mask = texture(64, 64) / 255, np.ones((64, 64), bool)
    with pytest.raises(ValueError, match="image must be finite"):
        lpips_squeeze(image * np.nan, image, mask)
    with pytest.raises(ValueError, match="target must be floating point"):
        lpips_squeeze(image, texture(64, 64), mask)
    with pytest.raises(ValueError, match="mask must be bool"):
        lpips_squeeze(image, image, mask.astype(int))
    with pytest.raises(ScoreUnavailable, match="at least 32 px"):
        lpips_squeeze(image[:31], image[:31], mask[:31])


def test_published_networks_load_the_published_weights(no_weights):
    """Weights of the right shape stand in for files that are not at hand here."""
    models = import_torchvision().models
    save_file(constant_weights(models.optical_flow.raft_large), no_weights / RAFT_LARGE.names[0])
    torch.save(constant_weights(models.AlexNet, "features."), no_weights / ALEXNET.names[1])
    save_file(constant_weights(models.vgg16, "features."), no_weights / VGG16.names[0])
    raft = raft_flow("large", no_weights, download=False)
    assert all((value == 0.01).all() for value in raft.network.parameters())
    image = texture(64, 64) / 255
    for backbone in ("alex", "vgg"):
        distance = lpips_distance(backbone, no_weights, download=False)
        assert distance(image, image, np.ones((64, 64), bool)) == 0


def test_missing_weights_and_those_of_another_network_give_a_reason(no_weights):
    with pytest.raises(WeightsMissing, match="no weights for RAFT-large"):
        raft_flow("large", no_weights, download=False)
    with pytest.raises(WeightsMissing, match="no weights for AlexNet"):
        lpips_distance("alex", no_weights, download=False)
    save_file(constant_weights(import_torchvision().models.optical_flow.raft_small), no_weights / RAFT_LARGE.names[0])
    with pytest.raises(WeightsMissing, match=r"raft_large.safetensors: expected .* of shape"):
        raft_flow("large", no_weights, download=False)


def test_file_names_are_those_torchvision_publishes():
    models = import_torchvision().models
    for files, published in (
        (RAFT_LARGE, models.optical_flow.Raft_Large_Weights.DEFAULT),
        (RAFT_SMALL, models.optical_flow.Raft_Small_Weights.DEFAULT),
        (ALEXNET, models.AlexNet_Weights.DEFAULT),
        (VGG16, models.VGG16_Weights.DEFAULT),
        (SQUEEZENET, models.SqueezeNet1_1_Weights.DEFAULT),
    ):
        assert files.url == published.url


def test_loading_a_network_leaves_the_random_numbers_alone(no_weights):
    save_file(constant_weights(import_torchvision().models.optical_flow.raft_small), no_weights / RAFT_SMALL.names[0])
    before = torch.random.get_rng_state()
    raft_flow("small", no_weights, download=False)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("package", ["torchvision", "lpips"])
def test_a_package_that_is_not_installed_is_a_reason(no_weights, monkeypatch, package):
    (no_weights / ALEXNET.names[1]).touch()
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        ScoreUnavailable,
        match=rf"^{package} is not installed\. Fix: `pip install -c constraints.txt torchvision lpips`\.$",
    ):
        lpips_distance("alex", no_weights, download=False)


@pytest.mark.slow
def test_torchvision_imports_beside_this_torch_without_a_warning():
    """In a new process, where nothing has declared an operator or imported torchvision before."""
    code = (
        "from endoprior.evaluation import networks as compat\n"
        "import torch, sys\n"
        "torchvision = compat.import_torchvision()\n"
        "assert compat.import_torchvision() is torchvision is sys.modules['torchvision']\n"
        "assert torch.ops.torchvision.nms is not None\n"
        "torchvision.models.optical_flow.raft_small(weights=None)\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_torchvision_that_fails_otherwise_is_a_reason(monkeypatch):
    tried = []

    def fail(name):
        tried.append(name)
        raise RuntimeError("undefined symbol\nmore")

    monkeypatch.setattr("endoprior.evaluation.networks.importlib.import_module", fail)
    with pytest.raises(ScoreUnavailable, match=r"torchvision does not work beside torch .* \(undefined symbol\)"):
        import_torchvision()
    assert len(tried) == 1  # declaring operators would not help, so nothing is declared and tried again
