"""Relative inverse depth of one image by a Depth Anything network (L. Yang et al., NeurIPS 2024). `H, W` image size.

The network runs on this machine through the transformers library. This module uses the internet only if the user names
a model of the Hugging Face hub that is not in the library's cache: it then downloads two files.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape, input_error
from ..core.shell import install_command
from .hub_model import FILES, find_model, first_line, import_transformers

if TYPE_CHECKING:
    from torch.nn import Module

DEFAULT_MODEL = "depth-anything/Depth-Anything-V2-Small-hf"
"""Name on the hub; about 100 MB, Apache-2.0."""
SHORT_SIDE_PX = 518
"""The image is resized so that its shorter side has this length, as in the training of the network."""
MEAN, STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
"""ImageNet statistics that normalize the input, colors in [0, 1]."""


class DepthNetwork:
    """A Depth Anything network in memory."""

    def __init__(self, name_or_folder: str | Path = DEFAULT_MODEL) -> None:
        """Load it from a folder, from the library's cache, or from the hub.

        Raises:
            InputError: transformers is not installed, the files cannot be had, or they hold another network.
        """
        if find_spec("transformers") is None:
            fix = f"`{install_command('mono')}`."
            raise input_error("--depth depth-anything", "the transformers package", "none", fix)
        self._network = _load(name_or_folder)
        self._patch = int(self._network.config.patch_size)

    def inverse_depth(self, rgb_u8: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Relative inverse depth: near is large, scale and shift are unknown (`relative_depth` sets them).

        Args:
            rgb_u8: (H, W, 3) 0..255.
        Returns:
            (H, W), >= 0.
        Raises:
            ValueError: another shape or type.
        """
        import torch

        check_shape("rgb_u8:H,W,3", rgb_u8=rgb_u8)
        if rgb_u8.dtype != np.uint8:
            raise ValueError(f"rgb_u8 must be 8-bit, got {rgb_u8.dtype}")
        height, width = rgb_u8.shape[:2]
        scale = SHORT_SIDE_PX / min(height, width)
        size = [max(round(side * scale / self._patch), 1) * self._patch for side in (width, height)]
        image = cv2.resize(rgb_u8.astype(np.float32) / np.float32(255), size, interpolation=cv2.INTER_CUBIC)
        pixels = np.ascontiguousarray(((image - MEAN) / STD).transpose(2, 0, 1)[None])
        with torch.inference_mode():
            inverse = self._network(pixel_values=torch.from_numpy(pixels)).predicted_depth[0].numpy()
        return cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)


def _load(name: str | Path) -> Module:
    """The network in evaluation mode."""
    hint = (
        f"Download {' and '.join(FILES)} of {DEFAULT_MODEL} on another machine, then `--depth depth-anything:FOLDER`."
    )
    folder = find_model(str(name), hint)
    transformers = import_transformers("--depth depth-anything", "mono", "DepthAnythingForDepthEstimation")
    try:
        network, report = transformers.DepthAnythingForDepthEstimation.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # the library raises many types for a wrong file
        raise input_error(name, "a Depth Anything model", first_line(error), "Choose another model.") from None
    if report["missing_keys"]:
        got = f"no weights for {sorted(report['missing_keys'])[0]} and {len(report['missing_keys']) - 1} more"
        raise input_error(name, "a Depth Anything model", got, "Choose another model.")
    return network.eval()
