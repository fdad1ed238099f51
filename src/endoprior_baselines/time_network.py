"""A network of place and time: frequency encodings, eight layers of 256, and a head for center, rotation and scale.

The encoding enters again after the fifth layer. As in SurgicalGaussian
(Xie et al., MICCAI 2024) and in Yang et al., "Deformable 3D Gaussians", CVPR 2024.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from typing_extensions import override

from endoprior.compute.relu_network import relu_network
from endoprior.core.checks import InputError
from endoprior.model.motion import Field

from .radiance.layers import encoded, encoded_size

PLACE_BANDS, TIME_BANDS = 10, 4
WIDTH, DEPTH, SKIP_AFTER = 256, 8, 4
HEADS = {"means": 3, "quats": 4, "scales": 3}
INPUTS = encoded_size(3, PLACE_BANDS) + encoded_size(1, TIME_BANDS)


def layer_shapes() -> dict[str, tuple[int, int]]:
    """Outputs and inputs of each layer, by name."""
    shapes = {f"layer.{i}": (WIDTH, INPUTS if i == 0 else WIDTH + INPUTS * (i == SKIP_AFTER + 1)) for i in range(DEPTH)}
    return shapes | {name: (outputs, WIDTH) for name, outputs in HEADS.items()}


def state_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of `TimeNetwork.state_arrays`."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, size in layer_shapes().items():
        shapes |= {f"{name}.weight": size, f"{name}.bias": size[:1]}
    return shapes


class TimeNetwork(Field):
    """Weights by name; PyTorch's default start, the heads' too, so that it moves from the first iteration on."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        self._weights = {name: value.detach().clone().requires_grad_() for name, value in weights.items()}

    @classmethod
    def fresh(cls, generator: torch.Generator) -> TimeNetwork:
        """Uniform in +-1 / sqrt(inputs), weights and biases."""
        weights = {}
        for name, (outputs, inputs) in layer_shapes().items():
            bound = 1 / math.sqrt(inputs)
            for part, size in (("weight", (outputs, inputs)), ("bias", (outputs,))):
                weights[f"{name}.{part}"] = torch.empty(size).uniform_(-bound, bound, generator=generator)
        return cls(weights)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Tensor]) -> TimeNetwork:
        """The network whose `state_arrays` these are.

        Raises:
            InputError: an array is missing or has another shape.
        """
        for name, shape in state_shapes().items():
            if name not in arrays or tuple(arrays[name].shape) != shape:
                raise InputError(f"{name}: expected an array of shape {shape}; got another or none.")
        return cls({name: arrays[name] for name in state_shapes()})

    def __call__(self, places: Tensor, time: float) -> dict[str, Tensor]:
        """Offsets (N, outputs) of each head at places (N, 3) and a time."""
        at_time = encoded(places.new_full((len(places), 1), time), TIME_BANDS)
        inputs = torch.cat([encoded(places, PLACE_BANDS), at_time], -1)
        layers = [self._layer(f"layer.{i}") for i in range(DEPTH)]
        heads = [torch.cat(parts) for parts in zip(*(self._layer(name) for name in HEADS), strict=True)]
        offsets = relu_network(inputs, [*layers, (heads[0], heads[1])], skip=SKIP_AFTER + 1, repeated=INPUTS)
        return dict(zip(HEADS, offsets.split(list(HEADS.values()), -1), strict=True))

    def _layer(self, name: str) -> tuple[Tensor, Tensor]:
        return self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]

    @property
    @override
    def parameters(self) -> dict[str, Tensor]:
        return {f"network.{name}": value for name, value in self._weights.items()}

    @override
    def state_arrays(self) -> dict[str, Tensor]:
        return {name: value.detach() for name, value in self._weights.items()}

    @override
    def to(self, device: torch.device | str, *, fp16_planes: bool = False) -> TimeNetwork:
        device = torch.device(device)
        if next(iter(self._weights.values())).device.type == device.type:
            return self
        return TimeNetwork({name: value.to(device) for name, value in self._weights.items()})
