"""SAM 2 (N. Ravi et al., 2024, Apache-2.0) as a segmenter that follows tools through a video. `H, W` image size.

The network runs on this machine through the transformers library, on the GPU if torch has one. Frames are given to it
one by one, so that it never holds the clip. The library's own preparation of images needs torchvision; ours does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .hub_model import load_network

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

SAM2 = "sam2"  # value of `--masks` and of `--with`
DEFAULT_MODEL = "facebook/sam2.1-hiera-tiny"  # name on the hub; 156 MB, Apache-2.0
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet statistics that normalize the input, colors in [0, 1]; the same for every SAM 2."""


def is_sam2(value: str) -> bool:
    """Whether a value of `--masks` or `--with` names this segmenter, rather than a folder."""
    return value.partition(":")[0] == SAM2


def open_sam2(value: str, option: str) -> Sam2:
    """The segmenter that a value of an option names: `sam2`, `sam2:FOLDER` or `sam2:NAME`.

    Args:
        option: `--masks` or `--with`, for error messages.
    Raises:
        InputError: another value; transformers is not installed; the files cannot be had, or hold another network.
    """
    method, _, name = value.partition(":")
    if method != SAM2:
        raise input_error(option, f"{SAM2}, or {SAM2}:FOLDER", value, f"`{option} {SAM2}`.")
    name, usage = name or DEFAULT_MODEL, f"{option} {SAM2}"
    network = load_network(name, DEFAULT_MODEL, "Sam2VideoModel", "a SAM 2 video model", option=usage, extra="tools")
    import torch

    # What `sequence.json` says of its masks holds no path, which may name a person.
    shown = "SAM 2" if Path(name).expanduser().is_dir() else f"SAM 2 ({name})"
    return Sam2(shown, network.to("cuda" if torch.cuda.is_available() else "cpu"))


class Sam2:
    """A SAM 2 network in memory, as a `VideoSegmenter`."""

    def __init__(self, name: str, network: Module) -> None:
        """Args: name: for the user. network: a `Sam2VideoModel` in evaluation mode."""
        self.name, self.network = name, network
        size = network.config.image_size
        self.side_px = int(size if isinstance(size, int) else size[0])  # the network sees square images of this side

    def begin(self) -> Sam2Chunk:
        """A new chunk that remembers nothing."""
        return Sam2Chunk(self)

    def pixels(self, rgb_u8: NDArray[np.uint8]) -> Tensor:
        """(1, 3, S, S) a frame (H, W, 3) as the network wants it."""
        import torch

        image = torch.from_numpy(np.ascontiguousarray(rgb_u8)).permute(2, 0, 1)[None].to(self.network.device)
        image = _resized(image.float() / 255, self.side_px)
        mean, std = (torch.tensor(each, device=self.network.device).view(1, 3, 1, 1) for each in (MEAN, STD))
        return (image - mean) / std

    def prompt(self, mask: NDArray[np.bool_]) -> Tensor:
        """(1, 1, S, S) 0 or 1: a mask (H, W) as the network wants it."""
        import torch

        given = torch.from_numpy(mask.astype(np.float32))[None, None].to(self.network.device)
        return (_resized(given, self.side_px) >= 0.5).float()


class Sam2Chunk:
    """What the network remembers of a few successive frames."""

    def __init__(self, sam2: Sam2) -> None:
        """Args: sam2: the network."""
        import torch
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        device = sam2.network.device
        self._sam2, self._count = sam2, 0
        self.scores: Tensor | None = None
        """(objects, 1, h, w) of the last frame, above 0 inside an object; h, w of the network."""
        self._session = Sam2VideoInferenceSession(
            inference_device=device,
            inference_state_device=device,
            video_storage_device=device,
            dtype=torch.float32,  # the default is its name, which newer versions of torch reject
        )

    def show(self, rgb_u8: NDArray[np.uint8], masks: Sequence[NDArray[np.bool_]]) -> None:
        """Give a frame (H, W, 3) whose objects are known: (H, W) each, empty for one that is out of view."""
        for each, mask in enumerate(masks):
            self._session.add_mask_inputs(self._session.obj_id_to_idx(each), self._count, self._sam2.prompt(mask))
        self._session.obj_with_new_inputs = list(range(len(masks)))
        self._run(rgb_u8)

    def follow(self, rgb_u8: NDArray[np.uint8]) -> list[NDArray[np.bool_]]:
        """The same objects in the next frame (H, W, 3): (H, W) each."""
        import torch.nn.functional as F

        self._run(rgb_u8)
        scores = F.interpolate(self.scores.float(), rgb_u8.shape[:2], mode="bilinear", align_corners=False)
        return list((scores[:, 0] > 0).cpu().numpy())

    def _run(self, rgb_u8: NDArray[np.uint8]) -> None:
        """Give the network the next frame."""
        done = self._sam2.network(inference_session=self._session, frame=self._sam2.pixels(rgb_u8))
        # The features of a frame are kept in the session's memory; its pixels are not used again.
        self._session.processed_frames[self._count] = None
        self._count += 1
        self.scores = done.pred_masks


def _resized(image: Tensor, side: int) -> Tensor:
    """(1, C, side, side): without aliasing, as in the training of the network."""
    import torch.nn.functional as F

    return F.interpolate(image, (side, side), mode="bilinear", align_corners=False, antialias=True)
