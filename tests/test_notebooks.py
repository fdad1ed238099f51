"""The notebooks of the documentation run from top to bottom, and hold the pictures that the site shows."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="notebooks need the packages nbclient and ipykernel")
start_new_kernel = pytest.importorskip("jupyter_client.manager").start_new_kernel
NotebookClient = pytest.importorskip("nbclient").NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
MAX_BYTES = 300_000
TRAINING = """
import endoprior, signal
from pathlib import Path
handler = signal.getsignal(signal.SIGINT)
sequence = endoprior.load_sequence({data!r})
config = endoprior.preset("preview", iterations={iterations}, gaussians=200)
scene = endoprior.train(sequence, config, out={run!r}, resume={resume})
"""
AFTER = """
assert signal.getsignal(signal.SIGINT) is handler
assert Path({run!r}, "checkpoint.safetensors").is_file()
stopped = endoprior.train(out={run!r}, resume=True, on_step=lambda report, trainer: 1 / 0)
"""
SECONDS = 900
"""Longest time of a cell; the first run compiles the kernels."""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_output_is_there_and_small(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/jpeg" in output.get("data", {}) for output in outputs)
    assert not any(output.output_type == "error" or output.get("name") == "stderr" for output in outputs)
    assert path.stat().st_size < MAX_BYTES
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore")  # those of the notebook server's libraries
def test_runs_from_top_to_bottom(path):
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=SECONDS, resources={"metadata": {"path": str(path.parent)}}).execute()


def told(message, cell):
    """What a message of the kernel adds to the output of a cell."""
    cell.append((message["msg_type"], message["content"]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # those of the notebook server's libraries
def test_interrupt_ends_a_training_with_a_checkpoint_and_the_notebook_goes_on(tiny_sequence, tmp_path):
    names = {"data": str(tiny_sequence), "run": str(tmp_path / "run")}
    manager, client = start_new_kernel()
    pressed = False

    def listen(message, cell):
        nonlocal pressed
        told(message, cell)
        shown = message["content"].get("text", "")
        if not pressed and "it/s" in shown:
            pressed = True
            manager.interrupt_kernel()

    def run(code, hook):
        cell = []
        reply = client.execute_interactive(code, timeout=SECONDS, output_hook=lambda message: hook(message, cell))
        lines = "".join(content["text"] for kind, content in cell if kind == "stream")
        return reply["content"], lines

    try:
        reply, lines = run(TRAINING.format(**names, iterations=100_000, resume=False), listen)
        assert (reply["status"], reply["ename"]) == ("error", "KeyboardInterrupt") and pressed
        assert lines.count("\r") >= 1 and lines.endswith("\n") and "\x1b" not in lines
        reply, _ = run(AFTER.format(**names), told)
        assert reply["ename"] == "ZeroDivisionError"  # an iteration was made after the checkpoint
        reply, lines = run(
            TRAINING.format(**(names | {"run": str(tmp_path / "other")}), iterations=3, resume=False), told
        )
        assert reply["status"] == "ok" and "3/3" in lines
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
