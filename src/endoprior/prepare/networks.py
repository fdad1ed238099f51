"""Networks of the Hugging Face hub, which run on this machine: SAM 2 (Apache-2.0, N. Ravi et al., 2024) follows tools
through a video, Depth Anything (L. Yang et al., NeurIPS 2024) measures relative depth. `H, W` image size.

Their files come from a folder, from the library's cache, or, if the user names a model that is not there, by download;
it is said before. The library's own preparation of images needs torchvision; ours does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.shell import install_command
from ..system.console import say
from .config import SAM2

FILES = ("config.json", "model.safetensors")  # files of a model. Pickled weights are not read.
ANSWER_S = 10.0  # longest time to wait for the size and the license of a model
DEFAULT_SAM2 = "facebook/sam2.1-hiera-tiny"  # 156 MB, Apache-2.0
DEFAULT_DEPTH = "depth-anything/Depth-Anything-V2-Small-hf"  # about 100 MB, Apache-2.0
SHORT_SIDE_PX = 518  # the shorter side of the image, as in the training of the depth network
MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of ImageNet, for colors in [0, 1]
STD = np.array([0.229, 0.224, 0.225], np.float32)


def load_network(name: str, default: str, class_name: str, what: str, *, option: str, extra: str) -> Any:
    """A network of the transformers library, in evaluation mode, on the CPU.

    Args:
        name: a folder, or a name on the hub.
        default: the usual name on the hub, for error messages.
        what: the files must hold, such as `a SAM 2 video model`.
        option: with its value, that needs it.
        extra: the optional part that brings the library.
    Raises:
        InputError: the library or the files cannot be had, or the files hold another network.
    """
    network_class = _class_of_library(class_name, option, extra)
    fix = f"Download {' and '.join(FILES)} of {default} on another machine, then `{option}:FOLDER`."
    folder = _find_model(name, fix)
    try:
        network, report = network_class.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # the library raises many types for a wrong file
        raise input_error(name, what, _first_line(error), "Choose another model.") from None
    if missing := sorted(report["missing_keys"]):
        got = f"no weights for {missing[0]} and {len(missing) - 1} more"
        raise input_error(name, what, got, "Choose another model.")
    return network.eval()


def _class_of_library(class_name: str, option: str, extra: str) -> Any:
    if find_spec("transformers") is None:
        raise input_error(option, "the transformers package", "none", f"`{install_command(extra)}`.")
    if find_spec("torchvision") is not None:
        # transformers imports torchvision if it is installed, even one that does not fit the installed torch.
        from ..evaluation.networks import import_torchvision
        from ..evaluation.score import ScoreUnavailable

        with suppress(ScoreUnavailable):
            import_torchvision()
    try:
        import transformers

        return getattr(transformers, class_name)
    except Exception as error:  # the library raises what the packages that it imports raise, in sentences of its own
        while error.__cause__:
            error = error.__cause__  # an old or unfit torchvision is the usual reason
        fix = f"`{install_command(extra)} torchvision`."
        raise input_error(option, "transformers that can be imported", _first_line(error), fix) from None


def _find_model(name: str, fix: str) -> Path:
    """The folder with a model's files; downloads them if `name` is a hub model that is not cached."""
    folder, wanted = Path(name).expanduser(), f"a model's {' and '.join(FILES)}"
    if folder.is_dir():
        if missing := [file for file in FILES if not (folder / file).is_file()]:
            raise input_error(folder, wanted, f"no {missing[0]}", "Download the model again.")
        return folder
    if name.count("/") != 1 or name.startswith((".", "/", "~")):
        raise input_error(name, "a model folder or a name of the Hugging Face hub", "neither", fix)
    from huggingface_hub import snapshot_download

    # Request only the files that are needed; the loader of transformers requests more.
    with suppress(Exception):
        cached = Path(snapshot_download(name, allow_patterns=list(FILES), local_files_only=True))
        if all((cached / file).is_file() for file in FILES):
            return cached
    say(f"downloading {name}{_size_and_license(name)}")
    try:
        fetched = Path(snapshot_download(name, allow_patterns=list(FILES)))
    except Exception as error:  # the hub client's, its transport's and the system's errors share no other base
        reason = _first_line(error).removeprefix("Got: ")
        raise input_error(name, "a model in the cache or a download", reason, fix) from None
    if not all((fetched / file).is_file() for file in FILES):
        raise input_error(name, wanted, "other files", "Choose a model in this format.")
    return fetched


def _size_and_license(name: str) -> str:
    """`: 156 MB, license apache-2.0`, or empty if the hub does not tell."""
    with suppress(Exception):
        from huggingface_hub import HfApi

        facts = HfApi().model_info(name, files_metadata=True, timeout=ANSWER_S)
        size = sum(each.size or 0 for each in facts.siblings or [] if each.rfilename in FILES)
        licenses = [tag.partition(":")[2] for tag in facts.tags or [] if tag.startswith("license:")]
        return f": {size / 1e6:.0f} MB, license {', '.join(licenses) or 'unknown'}"
    return ""


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class DepthNetwork:
    """A Depth Anything network in memory."""

    def __init__(self, name_or_folder: str | Path = "") -> None:
        """Load it; raises InputError as `load_network`."""
        self._network = load_network(
            str(name_or_folder or DEFAULT_DEPTH), DEFAULT_DEPTH, "DepthAnythingForDepthEstimation",
            "a Depth Anything model", option="--depth depth-anything", extra="mono",
        )  # fmt: skip
        self._patch = int(self._network.config.patch_size)

    def inverse_depth(self, rgb_u8: NDArray[np.uint8]) -> NDArray:
        """(H, W) relative inverse depth, >= 0, of an image (H, W, 3): near is large, scale and shift are unknown."""
        height, width = rgb_u8.shape[:2]
        scale = SHORT_SIDE_PX / min(height, width)
        size = [max(round(side * scale / self._patch), 1) * self._patch for side in (width, height)]
        image = cv2.resize(rgb_u8.astype(np.float32) / np.float32(255), size, interpolation=cv2.INTER_CUBIC)
        pixels = np.ascontiguousarray(((image - MEAN) / STD).transpose(2, 0, 1)[None])
        with torch.inference_mode():
            inverse = self._network(pixel_values=torch.from_numpy(pixels)).predicted_depth[0].numpy()
        return cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)


def open_sam2(value: str, option: str) -> Sam2:
    """The segmenter that a value of an option names: `sam2`, `sam2:FOLDER` or `sam2:NAME`.

    Args:
        option: `--masks` or `--with`, for error messages.
    Raises:
        InputError: another value, or as `load_network`.
    """
    method, _, name = value.partition(":")
    if method != SAM2:
        raise input_error(option, f"{SAM2}, or {SAM2}:FOLDER", value, f"`{option} {SAM2}`.")
    name, usage = name or DEFAULT_SAM2, f"{option} {SAM2}"
    network = load_network(name, DEFAULT_SAM2, "Sam2VideoModel", "a SAM 2 video model", option=usage, extra="tools")
    # What `sequence.json` says of its masks holds no path, which may name a person.
    shown = "SAM 2" if Path(name).expanduser().is_dir() else f"SAM 2 ({name})"
    return Sam2(shown, network.to("cuda" if torch.cuda.is_available() else "cpu"))


class Sam2:
    """A SAM 2 network in memory, as a `VideoSegmenter`."""

    def __init__(self, name: str, network: Any) -> None:
        """Args: name: for the user. network: a `Sam2VideoModel` in evaluation mode."""
        self.name, self.network = name, network
        size = network.config.image_size
        self._side_px = int(size if isinstance(size, int) else size[0])  # the network sees square images

    def begin(self) -> Sam2Chunk:
        """A new chunk that remembers nothing."""
        return Sam2Chunk(self)

    def pixels(self, rgb_u8: NDArray[np.uint8]) -> torch.Tensor:
        """(1, 3, S, S) a frame (H, W, 3) as the network wants it."""
        image = torch.from_numpy(np.ascontiguousarray(rgb_u8)).permute(2, 0, 1)[None].to(self.network.device)
        image = self._resized(image.float() / 255)
        mean, std = (torch.tensor(each, device=self.network.device).view(1, 3, 1, 1) for each in (MEAN, STD))
        return (image - mean) / std

    def prompt(self, mask: NDArray[np.bool_]) -> torch.Tensor:
        """(1, 1, S, S) 0 or 1: a mask (H, W) as the network wants it."""
        given = torch.from_numpy(mask.astype(np.float32))[None, None].to(self.network.device)
        return (self._resized(given) >= 0.5).float()

    def _resized(self, image: torch.Tensor) -> torch.Tensor:
        """(1, C, S, S): without aliasing, as in the training of the network."""
        return F.interpolate(image, (self._side_px,) * 2, mode="bilinear", align_corners=False, antialias=True)


class Sam2Chunk:
    """What the network remembers of a few successive frames, which are given to it one by one."""

    def __init__(self, sam2: Sam2) -> None:
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        device = sam2.network.device
        self._sam2, self._count = sam2, 0
        self.scores = torch.zeros(0)  # (objects, 1, h, w) of the last frame, above 0 inside an object
        self._session: Any = Sam2VideoInferenceSession(
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
        self._run(rgb_u8)
        scores = F.interpolate(self.scores.float(), rgb_u8.shape[:2], mode="bilinear", align_corners=False)
        return list((scores[:, 0] > 0).cpu().numpy())

    def _run(self, rgb_u8: NDArray[np.uint8]) -> None:
        done = self._sam2.network(inference_session=self._session, frame=self._sam2.pixels(rgb_u8))
        # The features of a frame are kept in the session's memory; its pixels are not used again.
        self._session.processed_frames[self._count] = None
        self._count += 1
        self.scores = done.pred_masks
