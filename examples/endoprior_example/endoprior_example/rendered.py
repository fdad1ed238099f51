"""Layout of what `endoprior render` writes: `rgb/*.png` and `depth/*.npy` (mm), without tools, a static camera."""

from pathlib import Path

import numpy as np

from endoprior.core.config import DataConfig
from endoprior.core.types import Camera
from endoprior.data import FrameSequence, read_depth_file
from endoprior.data.assemble import Pixels, assemble, kept_frames
from endoprior.data.files import list_files
from endoprior.data.formats import DatasetFormat
from endoprior.data.frame_files import files_of_images
from endoprior.data.images import read_color
from endoprior.data.poses import identity_poses

ASSUMED_FOCAL = 0.9
"""Focal length in image widths, which the folder does not say."""


def is_rendered(path: Path) -> bool:
    """Whether a folder has `rgb/` and `depth/`."""
    return (path / "rgb").is_dir() and (path / "depth").is_dir()


def load_rendered(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a folder."""
    images = list_files(path / "rgb", (".png",), "rendered")
    height, width = read_color(images[0]).shape[:2]
    remarks = [f"{path}: no focal length given, {ASSUMED_FOCAL:g} image widths are assumed"]
    depths = list_files(path / "depth", (".npy",), "rendered")
    depth_of = files_of_images(path / "depth", depths, "depth", images, remarks)
    kept = [i for i in kept_frames(len(images), cfg) if i in depth_of]
    images, depths = [images[i] for i in kept], [depth_of[i] for i in kept]
    focal = ASSUMED_FOCAL * width
    cameras = [Camera(width, height, focal, focal, width / 2, height / 2, pose) for pose in identity_poses(len(kept))]

    def decode(index: int) -> Pixels:
        """Color, tissue mask and depth (mm, 0 = missing) of a frame."""
        color = read_color(images[index], (width, height))
        return color, np.ones((height, width), bool), read_depth_file(depths[index], size=(width, height))

    return assemble(path, cfg, cameras, decode, images=images, files=depths, remarks=remarks, mask_folder="rgb")


FORMAT = DatasetFormat(is_rendered, load_rendered)
