"""The weights of the network: a file in the package, checked against its digest. docs/tool_network.md: how made."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from ..core.checks import input_error
from .network import ToolNetwork

FILE = Path(__file__).with_name("tool_network.safetensors")
SHA256 = "c49c792f112e198d4a1d206bd207df48166d957f0cd12afebde312d891b96c9c"
"""Of the file; a test compares it with the file and with the model card."""


@cache
def shipped_network() -> ToolNetwork:
    """The network that comes with the program, for inference only.

    Raises:
        InputError: the file is missing or was changed.
    """
    fix = "install the program again."
    try:
        data = FILE.read_bytes()
    except OSError as error:
        raise input_error(FILE, "the weights of the tool network", f"{error.strerror}", fix) from None
    digest = hashlib.sha256(data).hexdigest()
    if digest != SHA256:
        raise input_error(FILE, f"a file with SHA-256 {SHA256[:12]}...", f"{digest[:12]}...", fix)
    return network_from(data)


def network_from_file(path: Path) -> ToolNetwork:
    """A network for inference from a weights file that a user names.

    Raises:
        InputError: it cannot be read, or holds something else.
    """
    fix = "Name a file that `endoprior bench masks --write-weights` wrote."
    try:
        return network_from(path.read_bytes())
    except OSError as error:
        raise input_error(path, "a weights file", f"{error.strerror}", fix) from None
    except (SafetensorError, RuntimeError, AttributeError) as error:
        raise input_error(path, "the weights of a tool network", f"{str(error).splitlines()[0]:.80}", fix) from None


def network_from(data: bytes) -> ToolNetwork:
    """A network for inference from the bytes of a weights file."""
    network = ToolNetwork()
    counters = {name: value for name, value in network.state_dict().items() if not value.is_floating_point()}
    network.load_state_dict(counters | {name: value.float() for name, value in load(data).items()})
    network.eval().requires_grad_(False)
    return network.to(memory_format=torch.channels_last)


def weights_of(network: ToolNetwork) -> bytes:
    """The bytes of a weights file: every weight in float16, without counters."""
    state = {
        name: value.half().contiguous() for name, value in network.state_dict().items() if value.is_floating_point()
    }
    return save(state)
