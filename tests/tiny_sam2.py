"""A tiny SAM 2 video network of random weights, and a segmenter that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

SIDE = 64
"""Side of the square images that the tiny network sees, px."""


def write_tiny_sam2(folder: Path, *, processor: bool = False) -> Path:
    """Save a model of 1.3 million random weights as the library does; with its processor, which needs torchvision."""
    import torch

    if find_spec("torchvision") is not None:
        from endoprior.evaluation.networks import import_torchvision

        import_torchvision()
    from transformers import (
        Sam2HieraDetConfig,
        Sam2VideoConfig,
        Sam2VideoMaskDecoderConfig,
        Sam2VideoModel,
        Sam2VideoPromptEncoderConfig,
        Sam2VisionConfig,
    )

    grids = [[SIDE // shrink] * 2 for shrink in (4, 8, 16)]
    backbone = Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[SIDE, SIDE],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2],
        blocks_per_stage=[1, 1, 2, 1],
        global_attention_blocks=[3],
        window_size_per_stage=[8, 4, 4, 4],
        window_positional_embedding_background_size=[4, 4],
    )
    vision = Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=grids,
        fpn_hidden_size=128,
    )
    config = Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config=Sam2VideoPromptEncoderConfig(hidden_size=128, image_size=SIDE),
        mask_decoder_config=Sam2VideoMaskDecoderConfig(
            hidden_size=128, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=16
        ),
        image_size=SIDE,
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=grids[2],
        memory_encoder_hidden_size=128,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
        memory_fuser_num_layers=1,
    )
    with torch.random.fork_rng():
        torch.manual_seed(8)  # of those tried, one with masks that are neither empty nor full
        network = Sam2VideoModel(config)
        for name, weights in network.named_parameters():
            if "mask_decoder" in name:  # the library's own start is so small that hardly anything comes out
                torch.nn.init.normal_(weights, std=0.2)
        torch.nn.init.constant_(network.mask_decoder.pred_obj_score_head.proj_out.bias, 100.0)  # always in view
        network.save_pretrained(folder)
    if processor:
        from transformers import Sam2ImageProcessor, Sam2VideoProcessor, Sam2VideoVideoProcessor

        size = {"height": SIDE, "width": SIDE}
        Sam2VideoProcessor(Sam2ImageProcessor(size=size), Sam2VideoVideoProcessor(size=size)).save_pretrained(folder)
    return folder


class ColorSegmenter:
    """Follows objects by their color: an object of the first frame is all pixels of its mean color, in every frame."""

    name = "a stand-in"

    def __init__(self) -> None:
        self.chunks: list[ColorChunk] = []

    def begin(self) -> ColorChunk:
        """A new chunk."""
        self.chunks.append(ColorChunk())
        return self.chunks[-1]


class ColorChunk:
    """What it was shown, and how many frames it followed."""

    def __init__(self) -> None:
        self.shown: list[tuple[int, list[int]]] = []
        self.followed: list[int] = []
        self._colors: list[np.ndarray | None] = []

    def show(self, rgb_u8: np.ndarray, masks: Sequence[np.ndarray]) -> None:
        """Keep the color of each object. The red channel of the first pixel numbers the frame."""
        self.shown.append((int(rgb_u8[0, 0, 0]), [int(mask.sum()) for mask in masks]))
        if not self._colors:
            self._colors = [np.median(rgb_u8[mask], 0) for mask in masks]

    def follow(self, rgb_u8: np.ndarray) -> list[np.ndarray]:
        """All pixels of the color of each object."""
        self.followed.append(int(rgb_u8[0, 0, 0]))
        return [(np.abs(rgb_u8.astype(float) - color) < 20).all(-1) for color in self._colors]
