"""Run folders, camera paths and benchmark specs."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

from corpus_case import Build, Case, Step, given
from corpus_damage import NESTED, empty_folder, instead, pipe, put, without
from corpus_prepare import BOMB

EVAL = "eval run --no-networks"
RENDER = "render run out --times 0"
TRAINED = "--init-budget 200 --schedule.coarse-iterations 1 --schedule.fine-iterations 3 --no-networks"
"""Options of the sound run."""
RESUME = f"train data run --resume {TRAINED}"
SCENE, CHECKPOINT, CONFIG = "run/scene.safetensors", "run/checkpoint.safetensors", "run/config.json"
LOG = "run/log.jsonl"


def damaged(command: str, *steps: Step) -> Build:
    """A sound run in `run` and its sequence in `data`, damaged."""
    return given(command, *steps, needs="sequence run")


def cut(name: str, by: int) -> Step:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-by])


def flipped(name: str) -> Step:
    """Changes one bit near the end of a file: the last digit of a number."""

    def flip(folder: Path) -> None:
        content = bytearray((folder / name).read_bytes())
        content[-4] ^= 1
        (folder / name).write_bytes(content)

    return flip


def added(name: str, text: str) -> Step:
    return lambda folder: (folder / name).write_text(
        (folder / name).read_text(encoding="utf-8") + text, encoding="utf-8"
    )


def header(text: bytes | str, length: int | None = None) -> bytes:
    encoded = text if isinstance(text, bytes) else text.encode()
    return struct.pack("<Q", len(encoded) if length is None else length) + encoded


def about(text: str) -> bytes:
    """A safetensors file without arrays, described by this text."""
    return header(json.dumps({"__metadata__": {"endoprior": text}}))


def path_of(text: str) -> Build:
    return damaged("render run out --camera-path path.json", put("path.json", text))


def scene(name: str, *steps: Step, says: tuple[str, ...] = ()) -> Case:
    return Case(name, damaged(RENDER, *steps), (SCENE, *says))


def config(name: str, content: bytes | str | Callable[[dict], object], *says: str) -> Case:
    def damage(folder: Path) -> None:
        facts = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
        content(facts)
        (folder / CONFIG).write_text(json.dumps(facts), encoding="utf-8")

    return Case(name, damaged(EVAL, damage if callable(content) else put(CONFIG, content)), says or ("config.json",))


def resumed(name: str, *steps: Step, says: tuple[str, ...] = (), options: str = "") -> Case:
    return Case(name, damaged(f"{RESUME} {options}", *steps), (CHECKPOINT, *says), ("run",))


TERABYTES = '{"a":{"dtype":"F32","shape":[1000000000,1000000],"data_offsets":[0,4000000000000000]}}'
BYTES = bytes(range(256))
EMPTY = '{"format": "endoprior-scene-1", "config": {}}'
POSE = [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
RUNS = [
    Case("no run", given(EVAL), ("run",)),
    Case("an empty run", given(EVAL, empty_folder("run")), ("scene.safetensors",)),
    scene("a scene of nothing", put(SCENE, b"")),
    scene("a scene of noise", put(SCENE, BYTES * 20)),
    scene("a scene cut short", cut(SCENE, 100)),
    scene("a scene with one bit flipped", flipped(SCENE), says=("the bits that were written",)),
    scene("a scene with an endless header", put(SCENE, header("{}", 1 << 63))),
    scene("a scene that promises terabytes", put(SCENE, header(TERABYTES))),
    scene("a scene without a description", put(SCENE, header("{}"))),
    scene("a scene of another format", put(SCENE, about('{"format": "other"}')), says=("other",)),
    scene("a scene nested without end", put(SCENE, about(NESTED))),
    scene("a scene without arrays", put(SCENE, about(EMPTY))),
    scene("a folder for a scene", instead(SCENE)),
    scene("a pipe for a scene", pipe(SCENE)),
    config("a config that is not JSON", "{"),
    config("a config nested without end", NESTED),
    config("a config of bytes", BYTES),
    config("a config that is a list", "[]"),
    config("a config without data", lambda c: c.pop("data"), "config.json", "--data"),
    config("a config with a number for data", lambda c: c["data"].update(path=5)),
    config("a config with gone data", lambda c: c["data"].update(path="/gone"), "/gone", "--data"),
    config("a config with an impossible path", lambda c: c["data"].update(path="\0" + "x" * 5000), "xxx"),
    Case("a pipe for a config", damaged(EVAL, pipe(CONFIG)), ("config.json",)),
    Case("other data", given(f"{EVAL} --data other", put("other/images/a.png", "x"), needs="run"), ("other",)),
    Case("nothing to resume", damaged(RESUME, without(CHECKPOINT), without(CONFIG)), (CONFIG, "a run"), ("run",)),
    resumed("a checkpoint cut short", cut(CHECKPOINT, 100)),
    resumed("a checkpoint with one bit flipped", flipped(CHECKPOINT), says=("the bits that were written",)),
    resumed("a checkpoint of noise", put(CHECKPOINT, BYTES * 20)),
    resumed("a checkpoint that promises terabytes", put(CHECKPOINT, header(TERABYTES))),
    resumed("a checkpoint nested without end", put(CHECKPOINT, about(NESTED))),
    resumed(
        "a checkpoint that is a scene",
        lambda f: (f / CHECKPOINT).write_bytes((f / SCENE).read_bytes()),
        says=("endoprior-scene-1",),
    ),
    Case("a log cut short", damaged(RESUME, added(LOG, '{"stage": "fi')), leaves=("run",)),
    Case("a log broken inside", damaged(RESUME, added(LOG, "{\n{}\n")), ("log.jsonl, line", "'{'"), ("run",)),
    resumed("another config", options="--seed 7", says=("seed",)),
    resumed("other data to resume", without("data/sequence.json"), says=("other data",)),
    Case("a camera path that is nowhere", given("render run out --camera-path path.json", needs="run"), ("path.json",)),
    *(
        Case(f"a camera path {what}", path_of(text), ("path.json",))
        for what, text in {
            "of words": "hello",
            "of nothing": "[]",
            "nested without end": NESTED,
            "at NaN": '[{"time": NaN}]',
            "of NaN": json.dumps([{"time": 0, "world_to_camera": [[float("nan")] * 4] * 4}]),
            "that scales": json.dumps([{"time": 0, "world_to_camera": POSE}]),
        }.items()
    ),
]
SOUND = """
title: t
sequences: {clip: {path: data}}
methods: {ours: {}}
seeds: [0]
"""
CLAIM, TAG = "{score: psnr, method: ours, than: ours, by: .nan}", "!!python/object/apply:os.system ['touch executed']"
MANY = SOUND.replace("[0]", str(list(range(400)))) + f"budgets: {list(range(1, 301))}"


def spec(text: bytes | str, name: str = "spec.yaml") -> Build:
    return given(f"bench {name} out --report-only", put(name, text))


def changed(old: str, new: str) -> Build:
    assert old in SOUND
    return spec(SOUND.replace(old, new))


SPECS = [
    Case("no spec", given("bench spec.yaml out"), ("spec.yaml", "a file, a folder or one of")),
    Case("a spec of another kind", spec("x", "spec.txt"), ("spec.txt", ".yaml")),
    Case("a folder without specs", given("bench specs out", empty_folder("specs")), ("specs", "none")),
    Case("an empty spec", spec(""), ("spec.yaml",)),
    Case("a spec of bytes", spec(bytes(range(256))), ("spec.yaml",)),
    Case("a spec that is a list", spec("[1]"), ("spec.yaml",)),
    Case("a spec whose aliases explode", spec(SOUND + BOMB), ("spec.yaml", "aliases")),
    Case("a spec that executes", spec(f"title: {TAG}"), ("spec.yaml", "python/object")),
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
    Case("more cells than can be run", spec(MANY), ("spec.yaml", "120000")),
    Case("a budget below 0", spec(SOUND + "budgets: [-5]"), ("spec.yaml", "budget")),
    Case("a claim by NaN", spec(f"{SOUND}claims: [{CLAIM}]"), ("spec.yaml", "by")),
    Case("a setting of NaN", spec(SOUND + "set: {temporal.weight: .nan}"), ("spec.yaml", "weight")),
    Case("a setting that is no field", spec(SOUND + "set: {os.system: 1}"), ("spec.yaml", "os.system")),
    Case(
        "a phantom beyond all bounds", changed("path: data", "phantom: {frames: 1000000000}"), ("spec.yaml", "frames")
    ),
    Case("a preset nobody knows", changed("{ours: {}}", "{ours: {preset: finest}}"), ("spec.yaml", "finest")),
    Case("a spec that extends itself", spec(SOUND + "extends: [spec.yaml]"), ("spec.yaml", "extend itself")),
    Case("a spec that extends a device", spec(SOUND + "extends: [/dev/zero]"), ("/dev/zero",)),
    Case("a field nobody knows", spec(SOUND + "colour: red"), ("spec.yaml", "colour")),
    Case("a pipe for a spec", given("bench spec.yaml out", pipe("spec.yaml")), ("spec.yaml", "pipe")),
    Case("a variable that is not set", changed("path: data", "path: $NO_SUCH_VARIABLE/data"), leaves=("out",)),
]
CASES = [*RUNS, *SPECS]
