"""Scenes and configs from strangers: one line that names the file, and no kernel has seen an array."""

import dataclasses
import json
import math
import os
import random
import signal
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
import torch
from export_scenes import moving_scene
from state_files import StateFile, packed

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.config_io import from_dict, to_dict
from endoprior.export.html import write_html
from endoprior.model import hexplane
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.presets import preset
from endoprior.model.scene_file import load_scene
from endoprior.system.arrays_file import MAX_HEADER


@contextmanager
def seconds(most: int):
    """Fail where something waits for ever."""

    def ring(signum, frame):
        raise AssertionError(f"still at it after {most} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(most)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def complaint(path: Path, case: str = "") -> str:
    """The message about a scene that cannot be used: one line, no control characters, naming the file."""
    with seconds(20):
        try:
            load_scene(path)
        except InputError as error:
            text = str(error)
        else:
            pytest.fail(f"{case}: the scene was loaded")
    assert text.startswith(f"{path}: ") and any(word in text for word in ("expected", "must be", "no such field")), case
    assert text.isprintable() and len(text) < 1500, case
    return text


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory) -> StateFile:
    """A good scene with temporal coefficients, taken apart."""
    path = tmp_path_factory.mktemp("scene") / "scene.safetensors"
    moving_scene(moving_camera=True).save(path)
    return StateFile.read(path)


@pytest.fixture
def scene(scene_file) -> StateFile:
    """A copy to change."""
    return copy_of(scene_file)


def copy_of(file: StateFile) -> StateFile:
    """The same file, to change."""
    return StateFile(json.loads(json.dumps(file.about)), {name: values.copy() for name, values in file.arrays.items()})


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "scene.safetensors"


def test_the_good_file_is_good(scene, path):
    scene.write(path)
    assert load_scene(path).render(0.3).color.isfinite().all()


def test_every_flipped_bit_is_noticed_and_files_without_a_digest_are_read(scene, path):
    moving_scene(moving_camera=True).save(path)
    data, rng = path.read_bytes(), random.Random(0)
    arrays = 8 + int.from_bytes(data[:8], "little")
    for at in (*(rng.randrange(arrays, len(data)) for _ in range(50)), data.index(b"frames_per_second") + 22):
        path.write_bytes(data[:at] + bytes([data[at] ^ 1 << rng.randrange(3)]) + data[at + 1 :])
        assert "Fix: Train the scene again." in complaint(path, f"byte {at}")
    path.write_bytes(data)
    assert set(StateFile.read(path).about) == set(scene.about), "without the digest"
    color = load_scene(path).render(0.3).color
    scene.write(path)
    assert torch.equal(load_scene(path).render(0.3).color, color)


DEEP = "[" * 100_000 + "]" * 100_000
BYTES = {
    "empty": lambda header, data: b"",
    "seven bytes": lambda header, data: b"1234567",
    "header of 2^63 bytes": lambda header, data: packed(header, data, 2**63),
    "header beyond the end": lambda header, data: packed(header, data, len(header) + len(data) + 1),
    "header of 90 MB": lambda header, data: packed(header + b" " * 90_000_000, b""),
    "header too long by one": lambda header, data: packed(header.ljust(MAX_HEADER + 1), data),
    "header no JSON": lambda header, data: packed(b"\xff" * 100, data),
    "header nested": lambda header, data: packed(DEEP.encode(), data),
    "header twice": lambda header, data: packed(header + header, data),
    "cut": lambda header, data: packed(header, data[:-1]),
    "cut in the header": lambda header, data: packed(header, b"")[: len(header) // 2],
    "longer": lambda header, data: packed(header, data + b"\0"),
    "pickle": lambda header, data: b"\x80\x04\x95" + b"cposix\nsystem\n(S'touch pwned'\ntR." + data,
    "archive": lambda header, data: b"PK\x03\x04" + data,
}


def test_bytes_that_are_no_such_file(scene, path):
    for name, change in BYTES.items():
        path.write_bytes(change(json.dumps(scene.header()).encode(), scene.data()))
        complaint(path, name)


MEANS = "gaussians.means"
HEADERS = {
    "offsets beyond the end": lambda h: h[MEANS].update(data_offsets=[0, 2**50], shape=[2**48 // 3, 3]),
    "offsets backwards": lambda h: h[MEANS].update(data_offsets=h[MEANS]["data_offsets"][::-1]),
    "offsets shared": lambda h: h["gaussians.log_scales"].update(data_offsets=h[MEANS]["data_offsets"]),
    "shape larger than the data": lambda h: h[MEANS].update(shape=[2**40, 3]),
    "shape smaller": lambda h: h[MEANS].update(shape=[1, 3]),
    "shape overflows": lambda h: h[MEANS].update(shape=[2**62, 2**62, 0]),
    "shape negative": lambda h: h[MEANS].update(shape=[-1, 3]),
    "shape transposed": lambda h: h[MEANS].update(shape=h[MEANS]["shape"][::-1]),
    "type of the same size": lambda h: h[MEANS].update(dtype="I32"),
    "type of another size": lambda h: h[MEANS].update(dtype="F64"),
    "type unknown": lambda h: h[MEANS].update(dtype="PICKLE"),
    "no metadata": lambda h: h.pop("__metadata__"),
    "metadata of another program": lambda h: h.update(__metadata__={"format": "pt"}),
    "metadata no text": lambda h: h.update(__metadata__={"endoprior": 3}),
    "description nested": lambda h: h["__metadata__"].update(endoprior=DEEP),
    "description no object": lambda h: h["__metadata__"].update(endoprior="[1]"),
    "description with NaN": lambda h: h["__metadata__"].update(endoprior='{"format": "endoprior-scene-1", "a": NaN}'),
    "number of 5000 digits": lambda h: h["__metadata__"].update(endoprior='{"format": ' + "9" * 5000 + "}"),
    "format nested": lambda h: h["__metadata__"].update(endoprior='{"format": ' + "[" * 900 + "]" * 900 + "}"),
    "a name that colors the terminal": lambda h: h.update({"\x1b[31m\nroot": h.pop(MEANS)}),
}


def test_headers_that_lie(scene, path):
    for name, change in HEADERS.items():
        scene.write(path, change)
        complaint(path, name)


def config(**changes):
    """Change fields of the config: `optim__means_lr` is optim.means_lr."""

    def change(about):
        for name, value in changes.items():
            *path, last = name.split("__")
            reduce(dict.__getitem__, path, about["config"])[last] = value

    return change


HUGE = {"channels": 256, "multires": [100, 200]}
ABOUT = {
    "no config": lambda a: a.pop("config"),
    "config a list": lambda a: a.update(config=[]),
    "unknown field": lambda a: a.update(password=1),
    "field that colors the terminal": config(**{"\x1b[31m\n": 1}),
    "another format": lambda a: a.update(format="endoprior-scene-2"),
    "no width": lambda a: a.pop("width"),
    "width 0": lambda a: a.update(width=0),
    "width true": lambda a: a.update(width=True),
    "width a text": lambda a: a.update(width="64"),
    "width a fraction": lambda a: a.update(width=64.5),
    "width 1e9": lambda a: a.update(width=10**9),
    "a picture of 65536 x 1025": lambda a: a.update(width=65536, height=1025),
    "rate below a frame in a quarter of an hour": lambda a: a.update(frames_per_second=1e-6),
    "rate 0": lambda a: a.update(frames_per_second=0),
    "rate of 400 digits": lambda a: a.update(frames_per_second=10**400),
    "rate a list": lambda a: a.update(frames_per_second=[[25]]),
    "relative 1": lambda a: a.update(lengths_are_relative=1),
    "more harmonics than there are": config(schedule__sh_degree=3),
    "fewer bases than there are": config(deformation__basis__num_bases=2),
    "bases left open": config(deformation__basis__num_bases=0),
    "another deformation": config(deformation__kind="hexplane", init__motion="rest"),
    "gigabytes of planes": config(deformation__kind="hexplane", init__motion="rest", deformation__hexplane=HUGE),
    "planes of 10^9": config(deformation__hexplane={"time_resolution": 10**9}),
    "a thousand scales": config(deformation__hexplane={"multires": [1] * 1000}),
    "backend a path": config(render__backend="/tmp/evil.so"),
    "negative seed": config(seed=-1),
}


def test_descriptions_that_do_not_fit(scene_file, path, monkeypatch):
    monkeypatch.setattr(hexplane.PlaneGrid, "__init__", lambda *_: pytest.fail("planes made before they were seen"))
    for name, change in ABOUT.items():
        scene = copy_of(scene_file)
        change(scene.about)
        scene.write(path)
        complaint(path, name)


def test_a_scene_of_an_earlier_version_is_named_as_such(scene_file, path):
    scene = copy_of(scene_file)
    del scene.about["config"]["deformation"]["basis"]["num_frames"]
    scene.write(path)
    assert "radial basis functions, of an earlier version" in complaint(path, "earlier version")


def set_entry(name, index, value):
    """Change one number."""

    def change(arrays):
        arrays[name][index] = value

    return change


ARRAYS = {
    "nothing": lambda a: a.clear(),
    "one too many": lambda a: a.update(extra=np.zeros(3, np.float32)),
    "no cameras": lambda a: a.update({k: a[k][:0] for k in a if k.startswith("camera")}),
    "fewer poses than intrinsics": lambda a: a.update({"camera.world_to_camera": a["camera.world_to_camera"][:-1]}),
    "a quaternion of zeros": set_entry("gaussians.quats", 5, 0),
    "a quaternion that squares to zero": set_entry("gaussians.quats", 5, 1e-30),
    "a pose that scales": set_entry("camera.world_to_camera", (2, 0, 0), 1.1),
    "a pose that mirrors": set_entry("camera.world_to_camera", (2, 0, 0), -1),
    "a pose of zeros": set_entry("camera.world_to_camera", 2, 0),
    "a perspective pose": set_entry("camera.world_to_camera", (2, 3, 0), 1),
    "a pose far away": set_entry("camera.world_to_camera", (2, 0, 3), 1e30),
    "focal length 0": set_entry("camera.intrinsics", (1, 0), 0),
    "focal length negative": set_entry("camera.intrinsics", (1, 1), -80),
    "principal point far away": set_entry("camera.intrinsics", (1, 2), 1e12),
    "fewer projections than none": set_entry("num_valid", 3, -1),
}


def test_arrays_that_no_scene_has(scene_file, path):
    for name, change in ARRAYS.items():
        scene = copy_of(scene_file)
        change(scene.arrays)
        scene.write(path)
        complaint(path, name)


def test_each_array_must_be_there_of_its_type_and_shape_and_finite(scene_file, path):
    for name, values in scene_file.arrays.items():
        bad = {"missing": None, "another type": values.astype(np.float16), "integers": values.astype("<i8")}
        bad |= {"a row less": values[:-1], "an axis more": values[..., None], "flat": values.reshape(1, -1)}
        bad |= {"wider": np.concatenate([values, values], -1)}
        for number in (np.nan, np.inf, -np.inf):
            bad[str(number)] = values.copy()
            if values.size:
                bad[str(number)].flat[values.size // 2] = number
        for kind, changed in bad.items():
            if changed is not None and changed.dtype == values.dtype and np.array_equal(changed, values):
                continue  # nothing to spoil in an empty array
            if kind in ("flat", "wider") and values.size == 0 and values.shape[1:] == changed.shape[1:]:
                continue
            arrays = {k: v for k, v in scene_file.arrays.items() if k != name}
            arrays |= {} if changed is None else {name: changed}
            StateFile(scene_file.about, arrays).write(path)
            assert "expected" in complaint(path), (name, kind)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no named pipes in folders")
def test_files_that_are_no_files(tmp_path):
    (tmp_path / "folder.safetensors").mkdir()
    os.mkfifo(tmp_path / "pipe.safetensors")
    (tmp_path / "zeros.safetensors").symlink_to("/dev/zero")
    (tmp_path / "loop.safetensors").symlink_to(tmp_path / "loop.safetensors")
    (tmp_path / "run").mkdir()
    os.mkfifo(tmp_path / "run" / "scene.safetensors")
    for name in ("pipe.safetensors", "zeros.safetensors", "loop.safetensors", "run", "none", "a\0b", "x" * 300):
        with seconds(5), pytest.raises(InputError, match="expected a trained scene"):
            load_scene(tmp_path / name)
    with seconds(5), pytest.raises(InputError, match="expected a trained scene"):
        load_scene(tmp_path / "folder.safetensors")


def test_a_run_that_was_stopped_is_to_be_resumed(tmp_path):
    (tmp_path / "config.json").touch()
    with pytest.raises(InputError, match=r"expected a trained scene, got an unfinished run.*train --resume"):
        load_scene(tmp_path)


def test_a_file_of_holes_is_refused_by_its_size(scene, path):
    scene.write(path)
    os.truncate(path, 2**40)
    assert "68,719,476,736 bytes" in complaint(path)


def test_headers_with_flipped_bits_are_refused_or_drawn(scene, path):
    """What still loads has passed every check, so that drawing it is safe."""
    header, data, rng = bytearray(json.dumps(scene.header()).encode()), scene.data(), random.Random(0)
    drawn = 0
    for _ in range(1000):
        flipped = bytearray(header)
        for _ in range(rng.randint(1, 3)):
            flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
        path.write_bytes(packed(bytes(flipped), data))
        with seconds(20), suppress(InputError):
            loaded = load_scene(path)
            if loaded.cameras[0].width * loaded.cameras[0].height < 1e5:
                loaded.render(0.5)
                drawn += 1
    assert 0 < drawn < 1000  # about one in a hundred still loads


@pytest.mark.parametrize(
    "command", [["render", "RUN", "OUT"], ["export", "RUN", "OUT", "--format", "ply"], ["view", "RUN"]]
)
def test_commands_say_one_line_and_write_nothing(scene, tmp_path, capsys, command):
    (tmp_path / "run").mkdir()
    scene.arrays["gaussians.quats"][0] = 0
    scene.write(tmp_path / "run" / "scene.safetensors")
    names = {"RUN": str(tmp_path / "run"), "OUT": str(tmp_path / "out")}
    assert main([names.get(word, word) for word in command]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("endoprior: ") and "gaussians.quats" in said
    assert [p.name for p in tmp_path.rglob("*")] == ["run", "scene.safetensors"]


@pytest.mark.parametrize("deform_opacity", [False, True])
def test_the_shapes_of_a_field_are_known_before_it_is_made(deform_opacity):
    for name in ("paper", "released"):
        cfg = replace(preset(name).deformation, deform_opacity=deform_opacity)
        cfg = replace(cfg, hexplane=replace(cfg.hexplane, time_resolution=6, channels=7))
        field = HexPlaneField(torch.tensor([[1.0] * 3, [0.0] * 3]), cfg, torch.Generator())
        found = {name: tuple(value.shape) for name, value in field.state_arrays().items()}
        assert list(HexPlaneField.state_shapes(cfg).items()) == list(found.items())


def test_a_title_stays_text_in_the_page(tmp_path):
    title = "</title></h1><script>alert(1)</script>@@DATA@@<!--"
    page = write_html(moving_scene(), tmp_path / "scene.html", title=title).read_text()
    assert title not in page and "<script>alert" not in page and page.count("@@DATA@@") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["scene.html"]


def leaves(values, path=()):
    """Path and value of every number in nested dicts and lists."""
    for name, value in values.items() if isinstance(values, dict) else enumerate(values):
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, name))
        elif type(value) in (int, float):
            yield (*path, name), value


def test_every_number_of_a_config_has_bounds():
    found = list(leaves(to_dict(Config())))
    assert len(found) > 40
    for path, value in found:
        bad = [math.nan, math.inf, -math.inf, 10**400, -(10**400), "1", None, True]
        bad += [1e31, -1e31] if type(value) is float else [2**63, -1, 1.5]
        for number in bad:
            values = to_dict(Config())
            reduce(lambda v, k: v[k], path[:-1], values)[path[-1]] = number
            with pytest.raises(InputError) as caught:
                from_dict(Config, values)
            assert len(str(caught.value)) < 300 and "\n" not in str(caught.value), (path, number)


def test_rates_in_range_keep_parameters_finite():
    """The largest steps Adam can take, all in one direction, for all the iterations there can be."""
    names = [f.name for f in dataclasses.fields(Config().optim) if "_lr" in f.name]
    for name in names:
        for rate in (-1.0, 1.1e3):
            with pytest.raises(ValueError, match=name):
                replace(Config().optim, **{name: rate})
    longest_step = 0.1 / math.sqrt(0.001) / math.sqrt(1 - 0.81 / 0.999)  # of Adam, in rates: Cauchy and Schwarz
    assert longest_step * 1e3 * 1e6 * 2e7 < 1.5e17 < np.finfo(np.float32).max
