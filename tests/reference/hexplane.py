"""HexPlane features and the network behind them by the formulas of the published code."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from endoprior.model.hexplane import PLANE_NAMES
from endoprior.model.hexplane_field import HexPlaneField


def features(planes: list[list[Tensor]], unit: Tensor, coordinate: float) -> Tensor:
    """(N, S * C) features; `coordinate` is time as `grid_sample` takes it, planes (rows, columns, C) by scale."""
    where = torch.cat([unit * 2 - 1, torch.full_like(unit[:, :1], coordinate)], -1)
    features = []
    for scale in planes:
        product = 1.0
        for name, plane in zip(PLANE_NAMES, scale, strict=True):
            axes = where[:, ["xyzt".index(axis) for axis in name]][None, None]
            image = plane.permute(2, 0, 1)[None]
            sample = grid_sample(image, axes, mode="bilinear", padding_mode="border", align_corners=True)
            product = product * sample[0, :, 0].T
        features.append(product)
    return torch.cat(features, -1)


def displacement(model: HexPlaneField, means: Tensor, box: Tensor, time: float) -> Tensor:
    """(N, 3) displacement, float64: u = (x - max) * 2 / (min - max) - 1, features, trunk, head."""
    unit = ((means - box[0]) * 2 / (box[1] - box[0]) - 1 + 1) / 2
    planes = [[model.grid.plane(s, name).double() for name in PLANE_NAMES] for s in range(model.grid.num_scales)]
    hidden = features(planes, unit, time)
    layers = {name: value.detach().double() for name, value in model.heads.parameters.items()}
    for layer in ("trunk", "means.hidden", "means.output"):
        if layer != "trunk":
            hidden = hidden.clamp(min=0)
        hidden = hidden @ layers[f"{layer}.weight"].T + layers[f"{layer}.bias"]
    return hidden
