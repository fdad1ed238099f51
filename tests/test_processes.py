"""Forks, spawned processes and threads after a rendering: a result or an exception, never a wait without end."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import write_tiny_sequence
from tiny_training import tiny_config

from endoprior import load_sequence, train

PAGE = Path(__file__).parents[1] / "docs" / "processes.md"


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_tiny_sequence(tmp_path_factory.mktemp("processes") / "data")


@pytest.fixture(scope="module")
def run(data) -> Path:
    train(load_sequence(data), tiny_config("basis", 0, 1), data.with_name("run"))
    return data.with_name("run")


def printed(script: str, folder: Path, *words: object, layer: str = "omp", threads: int = 2) -> str:
    """What a script prints in a process of its own; it must end by itself."""
    (folder / "script.py").write_text(script)
    environment = os.environ | {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": str(threads)}
    line = [sys.executable, str(folder / "script.py"), *map(str, words)]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


TWICE = """import sys
from pathlib import Path
import torch
import endoprior

sys.path.insert(0, sys.argv[2])
from tiny_training import tiny_config

torch.set_num_threads(2)  # Numba will have one, and so will torch, from the moment when Numba starts it
for name in ("first", "second"):
    endoprior.train(endoprior.load_sequence(sys.argv[1]), tiny_config("hexplane", 2, 10), name)
print(Path("first/scene.safetensors").read_bytes() == Path("second/scene.safetensors").read_bytes())
"""


def test_the_first_training_of_a_process_gives_the_bits_of_the_second(data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert printed(TWICE, tmp_path, data, Path(__file__).parent, threads=1).split() == ["True"]


FORK = """import multiprocessing, sys
import endoprior

run, data = sys.argv[1:]
scene, sequence = endoprior.load_scene(run), endoprior.load_sequence(data)
TASKS = {
    "render": lambda: scene.render(0.5),
    "at": lambda: scene.at(0.5),
    "load": lambda: endoprior.load_scene(run),
    "score": lambda: endoprior.evaluate(scene, sequence, networks=False),
    "train": lambda: endoprior.train(sequence, scene.config),
}


def task(name):
    try:
        TASKS[name]()
        return "done"
    except RuntimeError as error:
        return str(error)


if __name__ == "__main__":
    with multiprocessing.get_context("fork").Pool(1) as pool:
        print(pool.map_async(task, ["render"]).get(60)[0])
    scene.render(0.5)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        for said in pool.map_async(task, TASKS).get(60):
            print(said)
"""
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="GNU OpenMP is that of Linux")


@on_linux
def test_a_fork_after_a_rendering_is_an_exception_that_names_spawn(run, data, tmp_path):
    before, *after = printed(FORK, tmp_path, run, data).splitlines()
    assert before == "done" and len(after) == 5
    for said in after:
        assert said.startswith("expected a process of its own, got a fork of one that has computed with OpenMP")
        assert '`multiprocessing.get_context("spawn")`' in said


@on_linux
@pytest.mark.slow
def test_threads_that_survive_a_fork_may_be_used(run, data, tmp_path):
    assert printed(FORK, tmp_path, run, data, layer="workqueue").split() == ["done"] * 6


@pytest.mark.slow
def test_the_example_of_the_page(run, tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert printed(code.replace('"RUN"', repr(str(run))), tmp_path).startswith("[0.")


THREADS = """import sys, threading
import endoprior

scene = endoprior.load_scene(sys.argv[1])
first = scene.render(0.25).color


def work():
    for _ in range(40):
        assert (scene.render(0.25).color == first).all()
    print("done", flush=True)


threads = [threading.Thread(target=work) for _ in range(4)]
[each.start() for each in threads]
[each.join() for each in threads]
"""


@pytest.mark.parametrize("layer", ["workqueue", pytest.param("omp", marks=pytest.mark.slow)])
def test_several_threads_render(run, tmp_path, layer):
    assert printed(THREADS, tmp_path, run, layer=layer).split() == ["done"] * 4
