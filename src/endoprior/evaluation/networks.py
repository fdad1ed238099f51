"""What scores by networks need: torchvision, and weights, which are read without executing anything they contain.

Weights are looked for in this order: the caller's folder, the folder in `ENDOPRIOR_WEIGHTS`, torch's cache,
torchvision's published file, which is downloaded into that cache. Nothing else is taken in their place.
"""

from __future__ import annotations

import importlib
import os
import re
import socket
import threading
import urllib.request
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ..core.checks import input_error
from ..core.shell import install_command, missing_package
from .score import ScoreUnavailable

if TYPE_CHECKING:
    from torch import Tensor

ENVIRONMENT_VARIABLE = "ENDOPRIOR_WEIGHTS"  # Environment variable that names a folder of weights
NETWORK_TIMEOUT_S = 4.0  # Timeout of the download server, s; short, because many machines have no network


class WeightsMissing(ScoreUnavailable):
    """The weights of a network are missing or cannot be read."""


@dataclass(frozen=True)
class WeightFiles:
    """The files any of which holds the weights of one network, under torchvision's keys."""

    network: str  # The network's name in messages
    names: tuple[str, ...]  # File names to look for: ours of safetensors, and torchvision's; the first match is used
    url: str  # Address at which torchvision publishes them; the file name ends in the start of its SHA-256


def _published(network: str, folder_name: str, url_name: str) -> WeightFiles:
    return WeightFiles(network, (folder_name, url_name), f"https://download.pytorch.org/models/{url_name}")


RAFT_LARGE = _published("RAFT-large", "raft_large.safetensors", "raft_large_C_T_SKHT_V2-ff5fadd5.pth")
RAFT_SMALL = _published("RAFT-small", "raft_small.safetensors", "raft_small_C_T_V2-01064c6d.pth")
ALEXNET = _published("AlexNet", "alexnet_features.safetensors", "alexnet-owt-7be5be79.pth")
VGG16 = _published("VGG16", "vgg16_features.safetensors", "vgg16-397923af.pth")
SQUEEZENET = _published("SqueezeNet 1.1", "squeezenet1_1_features.safetensors", "squeezenet1_1-b8a52dc0.pth")


def find_weights(files: WeightFiles, weights_dir: Path | None = None, *, download: bool = True) -> Path:
    """Find the weights of a network in the places that the module lists; `download=False` never touches the network.
    InputError for a named folder that is none; WeightsMissing says what was tried.
    """
    import torch

    cache = Path(torch.hub.get_dir()) / "checkpoints"  # where torch keeps downloaded weights
    named = {"--weights-dir": weights_dir, ENVIRONMENT_VARIABLE: os.environ.get(ENVIRONMENT_VARIABLE) or None}
    places = {source: Path(folder) for source, folder in named.items() if folder is not None}
    for source, folder in places.items():
        if not folder.is_dir():
            raise input_error(source, "a folder of network weights", f"{folder}, which is not one", "check the path.")
    places["torch cache"] = cache
    for file in (folder / name for folder in places.values() for name in files.names):
        if file.is_file():
            return file
    tried = "downloads are off"
    if download:
        target = cache / files.url.rsplit("/", 1)[-1]
        failure = _download(files.url, target)
        if failure is None:
            return target
        tried = f"the download of {files.url} failed ({failure})"
    searched = ", ".join(f"{source} {folder}" for source, folder in places.items())
    raise WeightsMissing(
        f"no weights for {files.network}: expected {' or '.join(files.names)} in {searched}; {tried}. "
        f"Fix: Put the file in a folder and name it with --weights-dir or {ENVIRONMENT_VARIABLE}."
    )


def load_weights(file: Path) -> Mapping[str, Tensor]:
    """Named tensors of a `.safetensors` or `.pth` file, which may contain data only; else WeightsMissing says why."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        with warnings.catch_warnings():
            # torch warns of pickles of other protocols, also of those it can read.
            warnings.filterwarnings("ignore", message="Detected pickle protocol", category=UserWarning)
            stored = torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, UnpicklingError, SafetensorError) as error:
        raise WeightsMissing(
            f"{file}: expected network weights, got an unreadable file ({_first_line(error)}). Fix: Replace it."
        ) from error
    if not (isinstance(stored, Mapping) and all(isinstance(value, torch.Tensor) for value in stored.values())):
        raise WeightsMissing(f"{file}: expected network weights, got no named tensors. Fix: Replace it.")
    return stored


def select_weights(file: Path, keys: Mapping[str, Tensor], origin: Mapping[str, str]) -> dict[str, Tensor]:
    """The tensors a network needs, from a weights file: `origin` gives the name in the file by the name in the network,
    `keys` a tensor of the right shape. WeightsMissing where one is not there.
    """
    stored = load_weights(file)
    selected = {}
    for name, stored_name in origin.items():
        tensor = stored.get(stored_name)
        if tensor is None or tensor.shape != keys[name].shape:
            got = "nothing" if tensor is None else f"shape {tuple(tensor.shape)}"
            raise WeightsMissing(
                f"{file}: expected {stored_name} of shape {tuple(keys[name].shape)}, got {got}. "
                "Replace the file with torchvision's weights of this network."
            )
        selected[name] = tensor
    return selected


def _download(url: str, target: Path) -> str | None:
    """Download a published file into torch's cache and check the hash in its name; None, or why it failed."""
    import torch

    if failure := _unreachable(url):
        return failure
    digest = re.search(r"-([0-9a-f]{8,})\.", target.name)
    before = socket.getdefaulttimeout()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        socket.setdefaulttimeout(NETWORK_TIMEOUT_S)  # torch's download has none of its own
        torch.hub.download_url_to_file(url, str(target), digest and digest.group(1), progress=False)
    except (OSError, RuntimeError) as error:
        return _first_line(error)
    finally:
        socket.setdefaulttimeout(before)
    return None


def _unreachable(url: str) -> str | None:
    """None when the server answers within `NETWORK_TIMEOUT_S`, else why not."""
    outcome: list[str | None] = []

    def ask() -> None:
        try:
            with urllib.request.urlopen(url, timeout=NETWORK_TIMEOUT_S):
                outcome.append(None)
        except (OSError, ValueError) as error:
            outcome.append(_first_line(error))

    # In a thread: looking up a host name ignores the timeout, and may take half a minute without a network.
    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(NETWORK_TIMEOUT_S)
    return outcome[0] if outcome else f"no answer within {NETWORK_TIMEOUT_S:g} s"


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__


MISSING_OPERATORS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
"""Schemas of the operators that torchvision describes while it is imported."""
_declared: list[Any] = []  # torch drops the declarations when the library object is garbage-collected


def import_torchvision() -> ModuleType:
    """The torchvision module; ScoreUnavailable without. Only this function and the lpips package import it.

    A CUDA build of torchvision with a CPU-only torch cannot load its compiled operators, and its import then fails with
    "operator torchvision::nms does not exist". RAFT and the classifiers use none of them: two names are declared, and
    it is imported again.
    """
    import torch

    try:
        try:
            importlib.import_module("torchvision.models.optical_flow")
        except RuntimeError as error:
            if "operator torchvision::" not in str(error):
                raise
            if not _declared:
                _declared.append(torch.library.Library("torchvision", "DEF"))
                for schema in MISSING_OPERATORS:
                    _declared[0].define(schema)
            importlib.import_module("torchvision.models.optical_flow")
        return importlib.import_module("torchvision")
    except ImportError as error:
        raise ScoreUnavailable(missing_package("torchvision", "networks", error)) from error
    except RuntimeError as error:
        fix = f"`{install_command('networks')}`."
        raise ScoreUnavailable(
            f"torchvision does not work beside torch {torch.__version__} ({_first_line(error)}). Fix: {fix}"
        ) from error
