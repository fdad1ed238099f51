"""SAM 2: a tiny one with random weights stands for the real one; nothing is downloaded."""

import json
import shutil
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from tiny_sam2 import SIDE, ColorSegmenter, write_tiny_sam2
from video_files import write_video

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.images import read_tool_mask
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.prepare import PrepareConfig, networks, prepare
from endoprior.prepare.config import is_sam2, names_path
from endoprior.prepare.frames import WORK
from endoprior.prepare.networks import DEFAULT_SAM2, FILES, open_sam2
from endoprior.tool_masks.video_segmenter import carry

needs_transformers = pytest.mark.skipif(find_spec("transformers") is None, reason="transformers is not installed")
# The library's own warnings are not ours to fix.
pytestmark = pytest.mark.filterwarnings("default")
FRAMES, WIDTH, HEIGHT = 6, 128, 96


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """The folder of a tiny SAM 2."""
    return write_tiny_sam2(tmp_path_factory.mktemp("tiny_sam2"), processor=find_spec("torchvision") is not None)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """A short phantom with a tool; left as it is."""
    out = tmp_path_factory.mktemp("phantom") / "DATA"
    write_phantom(out, PhantomConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, seed=4))
    return out


def images_of(folder):
    return [cv2.imread(str(file))[..., ::-1] for file in sorted((folder / "images").glob("*.png"))]


def masks_of(folder):
    return [read_tool_mask(file) for file in sorted((folder / "masks").glob("*.png"))]


@pytest.mark.slow
@needs_transformers
def test_a_model_folder_follows_objects_in_both_directions(model, monkeypatch):
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: pytest.fail("asked the net"))
    segmenter = open_sam2(f"sam2:{model}", "--masks")
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (30, 48, 72, 3), np.uint8)
    regions = np.zeros((2, 48, 72), bool)
    regions[0, :20, :20], regions[1, 30:, 40:] = True, True
    for order in (range(30), range(29, -1, -1)):
        found = dict(carry(segmenter, images.__getitem__, order, regions))
        assert list(found) == list(order[1:])
        assert all(mask.shape == (48, 72) and mask.dtype == bool for mask in found.values())
        assert len({int(mask.sum()) for mask in found.values()}) > 9, "it looks at the frames"
        again = dict(carry(segmenter, images.__getitem__, order, regions))
        assert all((again[i] == found[i]).all() for i in found), "the same again"
    assert segmenter.name == "SAM 2", "the folder may name a person, and the name is written to sequence.json"


@needs_transformers
def test_a_shown_frame_has_the_masks_that_it_was_shown_with(model):
    """What a chunk remembers of a prompted frame is the prompt, at the network's resolution; an empty one is empty."""
    segmenter = open_sam2(f"sam2:{model}", "--masks")
    chunk = segmenter.begin()
    image = np.random.default_rng(0).integers(0, 256, (48, 72, 3), np.uint8)
    regions = np.zeros((2, 48, 72), bool)
    regions[0, 10:40, 10:40] = True
    chunk.show(image, regions)
    shown, empty = chunk.scores
    enlarged = cv2.resize(shown[0].numpy(), (72, 48)) > 0
    assert (enlarged ^ regions[0]).mean() < 0.05 and not (empty > 0).any()


@needs_transformers
@pytest.mark.skipif(find_spec("torchvision") is None, reason="the library's processor needs torchvision")
def test_images_and_prompts_are_prepared_as_by_the_library(model):
    from transformers import Sam2VideoProcessor

    segmenter, processor = open_sam2(f"sam2:{model}", "--masks"), Sam2VideoProcessor.from_pretrained(model)
    smooth = cv2.resize(np.random.default_rng(0).integers(0, 256, (6, 9, 3), np.uint8), (320, 200))
    theirs = processor(images=smooth, return_tensors="pt").pixel_values[0]
    ours = segmenter.pixels(smooth)[0]
    assert ours.shape == theirs.shape == (3, SIDE, SIDE)
    assert (ours - theirs).abs().max() < 0.03, "theirs is rounded to 8 bits on the way: 1/255, in units of 0.225"
    mask = np.zeros((200, 320), bool)
    mask[13:99, 101:230] = True
    session = processor.init_video_session(dtype=__import__("torch").float32)
    processor.add_inputs_to_inference_session(session, frame_idx=0, obj_ids=[0], input_masks=[mask])
    assert (session.mask_inputs_per_obj[0][0] == segmenter.prompt(mask)).all()


@pytest.mark.slow
@needs_transformers
def test_the_command_replaces_masks(model, phantom, tmp_path, capsys):
    folder = shutil.copytree(phantom, tmp_path / "DATA")
    before = masks_of(folder)
    assert main(["masks", str(folder), "--with", f"sam2:{model}"]) == 0
    kept = [read_tool_mask(file) for file in sorted((folder / "masks_before").glob("*.png"))]
    assert all((a == b).all() for a, b in zip(kept, before, strict=True))
    assert len(json.loads((folder / "tool_masks.json").read_text())) == FRAMES
    assert "following tools" in capsys.readouterr().out
    assert load_sequence(folder).masks_are_found
    assert load_sequence(folder).sources["masks"].endswith("of the frames, followed by SAM 2")


@pytest.mark.parametrize("value", ["sam3", "./masks", "sam"])
def test_another_value_of_with_is_an_error(value, phantom, capsys):
    assert main(["masks", str(phantom), "--with", value]) == 2
    assert f"--with: expected sam2, or sam2:FOLDER, got {value}. Fix: `--with sam2`." in capsys.readouterr().err


class Repainting(ColorSegmenter):
    """Marks a fixed square, so that a test sees whose masks were written."""

    def begin(self):
        chunk = super().begin()
        chunk.follow = lambda rgb_u8: [SQUARE]
        return chunk


SQUARE = np.zeros((HEIGHT, WIDTH), bool)
SQUARE[60:80, 30:60] = True


@pytest.fixture
def segmenter(monkeypatch):
    """In place of SAM 2."""
    stand_in = Repainting()
    monkeypatch.setattr(networks, "open_sam2", lambda value, option: stand_in)
    return stand_in


def video(phantom, folder):
    return write_video(folder / "v.mkv", images_of(phantom))


OPTIONS = PrepareConfig(masks="sam2", depth="shading", poses="still", border="keep")


@pytest.mark.slow
def test_prepare_writes_the_segmenters_masks_and_depth_made_with_them(phantom, tmp_path, segmenter):
    done = prepare(video(phantom, tmp_path), tmp_path / "out", OPTIONS)
    masks = masks_of(done.out)
    assert len(masks) == FRAMES
    carried = [mask for mask in masks if (mask >= SQUARE).all()]
    assert len(carried) >= FRAMES - 1, "all frames but the prompted one"
    assert load_sequence(done.out).sources["masks"].endswith("followed by a stand-in")
    assert load_sequence(done.out).masks_are_found
    assert any("followed by a stand-in" in note for note in done.notes)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "v.mkv"]
    assert not (done.out / WORK).exists()
    # The same masks, given by a user, give the same depth.
    from_folder = replace(OPTIONS, masks=str(done.out / "masks"), mask_tool_value="high")
    given = prepare(tmp_path / "v.mkv", tmp_path / "given", from_folder)
    own = prepare(tmp_path / "v.mkv", tmp_path / "own", replace(OPTIONS, masks="auto"))
    depths = [[cv2.imread(str(f), -1) for f in sorted((d.out / "depth").glob("*.png"))] for d in (done, given, own)]
    near = [np.abs(a.astype(float) - b).mean() for a, b in zip(depths[0], depths[1], strict=True)]
    far = [np.abs(a.astype(float) - b).mean() for a, b in zip(depths[0], depths[2], strict=True)]
    assert max(near) < max(far), "nearer to depth made with these masks than with our own"


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", ["following tools, round 1", "following the camera", "writing frames"])
def test_prepare_resumes_after_an_interruption(phantom, tmp_path, segmenter, stop_at):
    source = video(phantom, tmp_path)
    whole = prepare(source, tmp_path / "whole", OPTIONS)
    followed = sum(len(chunk.shown) for chunk in segmenter.chunks)

    def stop(what, done, total):
        if (what == stop_at and done >= 2) or what == stop_at == "following the camera":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(source, tmp_path / "out", OPTIONS, stop)
    assert not (tmp_path / "out").exists(), "nothing is there before it is complete"
    segmenter.chunks.clear()
    done = prepare(source, tmp_path / "out", OPTIONS)
    if stop_at == "following the camera":
        assert not segmenter.chunks, "what was carried is not carried again"
    else:
        assert 0 < sum(len(chunk.shown) for chunk in segmenter.chunks) <= followed
    for part in ("images", "masks", "depth"):
        files = [sorted((each.out / part).glob("*.png")) for each in (whole, done)]
        assert len(files[0]) == FRAMES
        assert all(a.read_bytes() == b.read_bytes() for a, b in zip(*files, strict=True)), part


@needs_transformers
def test_a_missing_model_stops_prepare_before_it_starts(phantom, tmp_path, monkeypatch, capsys):
    def fetch(name, allow_patterns, local_files_only=False):
        raise ConnectionError("no network\nsecond line")

    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    monkeypatch.setattr("huggingface_hub.HfApi.model_info", fetch)
    source = video(phantom, tmp_path)
    assert main(["prepare", str(source), str(tmp_path / "out"), "--masks", "sam2"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{DEFAULT_SAM2}: expected a model in the cache or a download" in error
    assert "no network" in error and "`--masks sam2:FOLDER`" in error
    assert [path.name for path in tmp_path.iterdir()] == ["v.mkv"]


@needs_transformers
def test_a_download_says_its_size_and_license_first(model, monkeypatch, capsys):
    asked = []

    def fetch(name, allow_patterns, local_files_only=False):
        asked.append(local_files_only)
        assert name == "someone/sam" and set(allow_patterns) == set(FILES)
        if local_files_only:
            raise FileNotFoundError
        assert "downloading someone/sam: 156 MB, license apache-2.0" in capsys.readouterr().out
        return str(model)

    def facts(self, name, **_):
        files = [("config.json", 2_000), ("model.safetensors", 155_998_000), ("model.pt", 9_000_000)]
        return SimpleNamespace(
            siblings=[SimpleNamespace(rfilename=file, size=size) for file, size in files],
            tags=["transformers", "license:apache-2.0"],
        )

    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    monkeypatch.setattr("huggingface_hub.HfApi.model_info", facts)
    assert open_sam2("sam2:someone/sam", "--with").name == "SAM 2 (someone/sam)"
    assert asked == [True, False]


@needs_transformers
def test_other_files_are_an_error(model, tmp_path):
    from safetensors.numpy import save_file

    with pytest.raises(InputError, match=f"{tmp_path}: expected .*no config.json"):
        open_sam2(f"sam2:{tmp_path}", "--masks")
    (tmp_path / "config.json").write_bytes((model / "config.json").read_bytes())
    (tmp_path / "model.safetensors").write_bytes(b"broken")
    with pytest.raises(InputError, match="a SAM 2 video model") as caught:
        open_sam2(f"sam2:{tmp_path}", "--masks")
    assert "\n" not in str(caught.value)
    save_file({"other": np.zeros(3, np.float32)}, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match="no weights for"):
        open_sam2(f"sam2:{tmp_path}", "--masks")


@pytest.mark.parametrize("option", ["--masks", "--with"])
def test_without_the_package_its_name_is_said(monkeypatch, option):
    monkeypatch.setattr(networks, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=rf"{option} sam2: expected the transformers package, got none. Fix: `pip"):
        open_sam2("sam2", option)


def test_a_value_is_a_method_or_a_folder():
    assert is_sam2("sam2") and is_sam2("sam2:a/b") and not is_sam2("./sam2") and not is_sam2("auto")
    assert not names_path("sam2") and not names_path("sam2:a/b") and names_path("./sam2")
