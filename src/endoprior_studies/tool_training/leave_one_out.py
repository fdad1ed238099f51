"""Train one network without each set, and one with all; score each on what it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from endoprior.system.atomic import whole_file
from endoprior.tool_masks import ToolFinder
from endoprior.tool_masks.network import ToolNetwork, network_from, weights_of

from .benchmark import SetScore, TestFrame, score_set
from .fit import fit
from .footage import SETS, TRAINED, test_frames, training_frames
from .phantoms import phantom_frames, phantom_sets

ALL = "all"
SPLIT = {"vocalfolds": ("seq2", "seq4", "seq5")}
"""Sets of several operations are scored by operation too."""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    network: str
    """Which set the network has not seen; `all` for sets that are never trained on."""
    score: SetScore
    is_part: bool = False
    """Whether its frames are in another line too; such a line does not count in the mean."""


def weights_file(out: Path, left_out: str) -> Path:
    """Where the weights of a network are: `OUT/networks/without_SET.safetensors` or `all.safetensors`."""
    return out / "networks" / f"{left_out if left_out == ALL else f'without_{left_out}'}.safetensors"


@dataclass(frozen=True)
class Training:
    """How each network is trained."""

    steps: int
    seed: int
    start: ToolNetwork | None = None
    """Where the network that sees all sets starts. The others start from nothing: it may know their set."""


def network_without(out: Path, root: Path, left_out: str, how: Training, say: Callable[[str], None]) -> ToolNetwork:
    """The network that has not seen a set; trained if its weights are not in `out` yet, resumed if interrupted."""
    file = weights_file(out, left_out)
    if not file.exists():
        names = [name for name in TRAINED if name != left_out]
        file.parent.mkdir(parents=True, exist_ok=True)
        checkpoint = file.with_suffix(".checkpoint")
        network = fit(
            training_frames(root, names),
            how.steps,
            how.seed,
            start=how.start if left_out == ALL else None,
            checkpoint=checkpoint,
            report=lambda step, loss: say(f"{file.stem}: step {step} of {how.steps}, loss {loss:.3f}"),
        )
        with whole_file(file) as temporary:
            temporary.write_bytes(weights_of(network))
        checkpoint.unlink(missing_ok=True)
    return network_from(file.read_bytes())


def rows(out: Path, root: Path, how: Training, say: Callable[[str], None]) -> Iterator[Row]:
    """Every line of the table, in its order: the sets, then the families of the phantom."""
    for name in SETS:
        left_out = name if name in TRAINED else ALL
        finder = ToolFinder(network_without(out, root, left_out, how, say))
        frames = list(test_frames(root, name))
        yield Row(name, left_out, score_set(finder, frames))
        for part in SPLIT.get(name, ()):
            yield Row(f"{name}: {part}", left_out, score_set(finder, _of(frames, part)), is_part=True)
    finder = ToolFinder(network_without(out, root, ALL, how, say))
    for name, phantom in phantom_sets().items():
        yield Row(name, ALL, score_set(finder, phantom_frames(out / "phantoms", phantom)))


def _of(frames: list[TestFrame], part: str) -> list[TestFrame]:
    return [frame for frame in frames if frame.name.startswith(part)]
