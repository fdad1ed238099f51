"""Run folders, camera paths and benchmark specs."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

from corpus_case import Build, Case, Samples
from corpus_damage import NESTED, put
from corpus_prepare import BOMB

EVAL = ["eval", "run", "--no-networks"]
RENDER = ["render", "run", "out", "--times", "0"]
TRAINED = "--init-budget 200 --schedule.coarse-iterations 1 --schedule.fine-iterations 3 --no-networks"
"""Options of the sound run."""
RESUME = ["train", "data", "run", "--resume", *TRAINED.split()]
SCENE, CHECKPOINT = "run/scene.safetensors", "run/checkpoint.safetensors"


def damaged(damage: Callable[[Path], object], command: list[str]) -> Build:
    """A sound run in `run` and its sequence in `data`, damaged."""

    def build(folder: Path, samples: Samples) -> list[str]:
        samples.copy("sequence", folder / "data")
        samples.copy("run", folder / "run")
        damage(folder)
        return command

    return build


def cut(name: str, by: int) -> Callable[[Path], object]:
    """Takes bytes off the end of a file."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-by])


def config(change: Callable[[dict], object]) -> Callable[[Path], object]:
    """Changes the run's config.json."""

    def damage(folder: Path) -> None:
        facts = json.loads((folder / "run/config.json").read_text())
        change(facts)
        (folder / "run/config.json").write_text(json.dumps(facts))

    return damage


def header(text: bytes | str, length: int | None = None) -> bytes:
    """A safetensors file that is nothing but a header."""
    encoded = text if isinstance(text, bytes) else text.encode()
    return struct.pack("<Q", len(encoded) if length is None else length) + encoded


def about(text: str) -> bytes:
    """A safetensors file without arrays, described by this text."""
    return header(json.dumps({"__metadata__": {"endoprior": text}}))


def path_of(text: str) -> Build:
    """A camera path."""
    return damaged(put("path.json", text), ["render", "run", "out", "--camera-path", "path.json"])


TERABYTES = '{"a":{"dtype":"F32","shape":[1000000000,1000000],"data_offsets":[0,4000000000000000]}}'
RUNS = [
    Case("no run", lambda f, s: EVAL, ("run",)),
    Case("an empty run", lambda f, s: [(f / "run").mkdir(), EVAL][1], ("scene.safetensors",)),
    Case("a scene of nothing", damaged(put(SCENE, b""), RENDER), (SCENE,)),
    Case("a scene of noise", damaged(put(SCENE, bytes(range(256)) * 20), RENDER), (SCENE,)),
    Case("a scene cut short", damaged(cut(SCENE, 100), RENDER), (SCENE,)),
    Case("a scene with an endless header", damaged(put(SCENE, header("{}", 1 << 63)), RENDER), (SCENE,)),
    Case("a scene that promises terabytes", damaged(put(SCENE, header(TERABYTES)), RENDER), (SCENE,)),
    Case("a scene without a description", damaged(put(SCENE, header("{}")), RENDER), (SCENE,)),
    Case("a scene of another format", damaged(put(SCENE, about('{"format": "other"}')), RENDER), (SCENE, "other")),
    Case("a scene nested without end", damaged(put(SCENE, about(NESTED)), RENDER), (SCENE,)),
    Case(
        "a scene without arrays",
        damaged(put(SCENE, about('{"format": "endoprior-scene-1", "config": {}}')), RENDER),
        (SCENE,),
    ),
    Case("a folder for a scene", damaged(lambda f: [(f / SCENE).unlink(), (f / SCENE).mkdir()], RENDER), (SCENE,)),
    Case("a pipe for a scene", damaged(lambda f: [(f / SCENE).unlink(), os.mkfifo(f / SCENE)], RENDER), (SCENE,)),
    Case("a config that is not JSON", damaged(put("run/config.json", "{"), EVAL), ("config.json",)),
    Case("a config nested without end", damaged(put("run/config.json", NESTED), EVAL), ("config.json",)),
    Case("a config of bytes", damaged(put("run/config.json", bytes(range(256))), EVAL), ("config.json",)),
    Case("a config that is a list", damaged(put("run/config.json", "[]"), EVAL), ("config.json",)),
    Case("a config without data", damaged(config(lambda c: c.pop("data")), EVAL), ("config.json", "--data")),
    Case(
        "a config with a number for data", damaged(config(lambda c: c["data"].update(path=5)), EVAL), ("config.json",)
    ),
    Case(
        "a config with gone data", damaged(config(lambda c: c["data"].update(path="/gone")), EVAL), ("/gone", "--data")
    ),
    Case(
        "a config with an impossible path",
        damaged(config(lambda c: c["data"].update(path="\0" + "x" * 5000)), EVAL),
        ("xxx",),
    ),
    Case(
        "a pipe for a config",
        damaged(lambda f: [(f / "run/config.json").unlink(), os.mkfifo(f / "run/config.json")], EVAL),
        ("config.json",),
    ),
    Case(
        "other data",
        lambda f, s: [s.copy("run", f / "run"), put("other/images/a.png", "x")(f), [*EVAL, "--data", "other"]][2],
        ("other",),
    ),
    Case(
        "nothing to resume",
        damaged(lambda f: [(f / CHECKPOINT).unlink(), (f / "run/config.json").unlink()], RESUME),
        (CHECKPOINT,),
        ("run",),
    ),
    Case("a checkpoint cut short", damaged(cut(CHECKPOINT, 100), RESUME), (CHECKPOINT,), ("run",)),
    Case("a checkpoint of noise", damaged(put(CHECKPOINT, bytes(range(256)) * 20), RESUME), (CHECKPOINT,), ("run",)),
    Case(
        "a checkpoint that promises terabytes",
        damaged(put(CHECKPOINT, header(TERABYTES)), RESUME),
        (CHECKPOINT,),
        ("run",),
    ),
    Case("a checkpoint nested without end", damaged(put(CHECKPOINT, about(NESTED)), RESUME), (CHECKPOINT,), ("run",)),
    Case(
        "a checkpoint that is a scene",
        damaged(lambda f: (f / CHECKPOINT).write_bytes((f / SCENE).read_bytes()), RESUME),
        (CHECKPOINT, "endoprior-scene-1"),
        ("run",),
    ),
    Case("another config", damaged(lambda f: None, [*RESUME, "--seed", "7"]), (CHECKPOINT, "seed"), ("run",)),
    Case(
        "other data to resume",
        damaged(lambda f: (f / "data/sequence.json").unlink(), RESUME),
        (CHECKPOINT, "other data"),
        ("run",),
    ),
    Case(
        "a camera path that is nowhere",
        damaged(lambda f: None, [*RENDER[:3], "--camera-path", "path.json"]),
        ("path.json",),
    ),
    Case("a camera path of words", path_of("hello"), ("path.json",)),
    Case("a camera path of nothing", path_of("[]"), ("path.json",)),
    Case("a camera path nested without end", path_of(NESTED), ("path.json",)),
    Case("a camera path at NaN", path_of('[{"time": NaN}]'), ("path.json",)),
    Case(
        "a camera path of NaN",
        path_of(json.dumps([{"time": 0, "world_to_camera": [[float("nan")] * 4] * 4}])),
        ("path.json",),
    ),
    Case(
        "a camera path that scales",
        path_of('[{"time": 0, "world_to_camera": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]'),
        ("path.json",),
    ),
]
SOUND = """
title: t
sequences: {clip: {path: data}}
methods: {ours: {}}
seeds: [0]
"""


def spec(text: bytes | str, name: str = "spec.yaml", command: tuple[str, ...] = ()) -> Build:
    """A spec, reported on only, so that nothing is trained."""

    def build(folder: Path, samples: Samples) -> list[str]:
        put(name, text)(folder)
        return ["bench", name, "out", "--report-only", *command]

    return build


def changed(old: str, new: str) -> Build:
    """A sound spec with one thing changed."""
    assert old in SOUND
    return spec(SOUND.replace(old, new))


SPECS = [
    Case("no spec", lambda f, s: ["bench", "spec.yaml", "out"], ("spec.yaml", "o such file")),
    Case("a spec of another kind", spec("x", "spec.txt"), ("spec.txt", ".yaml")),
    Case(
        "a folder without specs", lambda f, s: [(f / "specs").mkdir(), ["bench", "specs", "out"]][1], ("specs", "none")
    ),
    Case("an empty spec", spec(""), ("spec.yaml",)),
    Case("a spec of bytes", spec(bytes(range(256))), ("spec.yaml",)),
    Case("a spec that is a list", spec("[1]"), ("spec.yaml",)),
    Case("a spec whose aliases explode", spec(SOUND + BOMB), ("spec.yaml", "aliases")),
    Case(
        "a spec that executes",
        spec("title: !!python/object/apply:os.system ['touch executed']"),
        ("spec.yaml", "python/object"),
    ),
    Case("a spec nested without end", spec(NESTED), ("spec.yaml", "nested")),
    Case("a spec that contains itself", spec("a: &a {b: *a}"), ("spec.yaml", "itself")),
    Case("a TOML spec nested without end", spec("a = " + NESTED, "spec.toml"), ("spec.toml",)),
    Case("a TOML spec with a number of 5000 digits", spec("a = " + "9" * 5000, "spec.toml"), ("spec.toml",)),
    Case("a date that does not exist", spec("title: 2001-99-99"), ("spec.yaml",)),
    Case("a method that leaves the folder", changed("{ours: {}}", '{"../../x": {}}'), ("spec.yaml", "../../x")),
    Case("a sequence that leaves the folder", changed("{clip:", '{"../x":'), ("spec.yaml", "../x")),
    Case("a name twice", changed("{ours: {}}", "{ours: {}, ours: {preset: paper}}"), ("spec.yaml", "ours")),
    Case("seeds of NaN", changed("[0]", "[.nan]"), ("spec.yaml", "seeds")),
    Case("seeds below 0", changed("[0]", "[-1]"), ("spec.yaml", "seed")),
    Case("seeds twice", changed("[0]", "[1, 1]"), ("spec.yaml", "seeds")),
    Case(
        "more cells than can be run",
        spec(SOUND.replace("[0]", str(list(range(400)))) + f"budgets: {list(range(1, 301))}"),
        ("spec.yaml", "120000"),
    ),
    Case("a budget below 0", spec(SOUND + "budgets: [-5]"), ("spec.yaml", "budget")),
    Case(
        "a claim by NaN",
        spec(SOUND + "claims: [{score: psnr, method: ours, than: ours, by: .nan}]"),
        ("spec.yaml", "by"),
    ),
    Case("a setting of NaN", spec(SOUND + "set: {temporal.weight: .nan}"), ("spec.yaml", "weight")),
    Case("a setting that is no field", spec(SOUND + "set: {os.system: 1}"), ("spec.yaml", "os.system")),
    Case(
        "a phantom beyond all bounds",
        changed("{path: data}", "{phantom: {frames: 1000000000}}"),
        ("spec.yaml", "frames"),
    ),
    Case("a preset nobody knows", changed("{ours: {}}", "{ours: {preset: best}}"), ("spec.yaml", "best")),
    Case("a spec that extends itself", spec(SOUND + "extends: [spec.yaml]"), ("spec.yaml", "extends itself")),
    Case("a spec that extends a device", spec(SOUND + "extends: [/dev/zero]"), ("/dev/zero",)),
    Case("a field nobody knows", spec(SOUND + "colour: red"), ("spec.yaml", "colour")),
    Case(
        "a pipe for a spec",
        lambda f, s: [os.mkfifo(f / "spec.yaml"), ["bench", "spec.yaml", "out"]][1],
        ("spec.yaml", "pipe"),
    ),
    Case("a variable that is not set", changed("path: data", "path: $NO_SUCH_VARIABLE/data"), leaves=("out",)),
]
CASES = [*RUNS, *SPECS]
