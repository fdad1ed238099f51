"""The depth network: a tiny one with random weights stands for the real one; nothing is downloaded."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.evaluation.networks import import_torchvision
from endoprior.prepare import networks
from endoprior.prepare.networks import FILES, DepthNetwork

needs_transformers = pytest.mark.skipif(find_spec("transformers") is None, reason="transformers is not installed")
# The library's own warnings are not ours to fix.
pytestmark = pytest.mark.filterwarnings("default")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Depth Anything model of 40 thousand random weights, as the library saves it."""
    import torch

    if find_spec("torchvision") is not None:
        import_torchvision()
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False,
    )  # fmt: skip
    sizes = {"neck_hidden_sizes": [8, 8, 8, 8], "fusion_hidden_size": 8, "head_hidden_size": 8}
    config = DepthAnythingConfig(backbone_config=backbone, patch_size=14, reassemble_hidden_size=16, **sizes)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = DepthAnythingForDepthEstimation(config)
        for weights in network.parameters():  # the library's own start is so small that nothing comes out
            torch.nn.init.normal_(weights, std=0.2)
    out = tmp_path_factory.mktemp("tiny_depth_anything")
    network.save_pretrained(out)
    return out


@needs_transformers
def test_a_model_folder_runs_on_any_image_size(folder, monkeypatch):
    monkeypatch.setattr(networks, "SHORT_SIDE_PX", 56)
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: pytest.fail("asked the net"))
    network = DepthNetwork(folder)
    image = np.random.default_rng(0).integers(0, 256, (45, 71, 3), np.uint8)
    inverse = network.inverse_depth(image)
    assert inverse.shape == (45, 71) and inverse.dtype == np.float32
    assert np.isfinite(inverse).all() and inverse.min() >= 0 and inverse.std() > 0
    assert (network.inverse_depth(image) == inverse).all()
    assert not np.array_equal(network.inverse_depth(image[..., ::-1].copy()), inverse)


@needs_transformers
@pytest.mark.parametrize("missing", FILES)
def test_a_folder_without_a_file_is_an_error(missing, tmp_path):
    for file in set(FILES) - {missing}:
        (tmp_path / file).write_bytes(b"{}")
    with pytest.raises(InputError, match=f"{tmp_path}: expected .*no {missing}"):
        DepthNetwork(tmp_path)


@needs_transformers
@pytest.mark.parametrize("name", ["/nowhere/at-all", "some_folder", "./a/b"])
def test_a_wrong_name_makes_no_network_request(name, monkeypatch):
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: pytest.fail("asked the net"))
    with pytest.raises(InputError, match="model folder") as caught:
        DepthNetwork(name)
    assert name in str(caught.value) and "Download" in str(caught.value)


@needs_transformers
def test_a_hub_name_is_searched_in_the_cache_first(folder, monkeypatch):
    asked = []

    def fetch(name, allow_patterns, local_files_only=False):
        asked.append(local_files_only)
        assert name == "someone/model" and set(allow_patterns) == set(FILES)
        if local_files_only and len(asked) == 1:
            return str(folder)
        raise ConnectionError("no network\nsecond line")

    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    monkeypatch.setattr("huggingface_hub.HfApi.model_info", fetch)
    DepthNetwork("someone/model")
    assert asked == [True]
    with pytest.raises(InputError, match=r"someone/model.*no network") as caught:
        DepthNetwork("someone/model")
    assert asked == [True, True, False] and "\n" not in str(caught.value)


@needs_transformers
def test_a_package_that_transformers_lacks_is_one_line(folder, monkeypatch):
    import transformers

    def broken(name):
        try:
            raise ImportError("No module named 'torchvision'\nmore")
        except ImportError as error:
            raise RuntimeError("Failed to import transformers because of the following error (look up)") from error

    monkeypatch.delitem(vars(transformers), "DepthAnythingForDepthEstimation", raising=False)
    monkeypatch.setattr(type(transformers), "__getattr__", lambda module, name: broken(name))
    with pytest.raises(InputError) as caught:
        DepthNetwork(folder)
    assert str(caught.value) == (
        "--depth depth-anything: expected transformers that can be imported, got No module named 'torchvision'. "
        "Fix: `pip install -c constraints.txt transformers torchvision`."
    )


def test_importing_the_module_loads_neither_torch_nor_transformers():
    code = (
        "import sys, endoprior.prepare.pipeline; "
        "assert not {'torch', 'transformers', 'huggingface_hub'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
