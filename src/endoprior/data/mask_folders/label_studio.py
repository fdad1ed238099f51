"""Masks that Label Studio exports as *Brush labels to PNG* or *to NumPy*: a file per region, named by its task.

`task-TASK-annotation-ANNOTATION-by-USER-TAG-LABEL-NUMBER.png`, with 0 or 255. TAG is the name of the brush in the
labeling interface, which the names of all files share. The name of the image is not in the name of the file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ..files import files_with
from .frames import MaskFolder, MaskFrame, union_of_files
from .labels import tool_labels, words_about

NAME = re.compile(r"task-(\d+)-annotation-(\d+)-by-([^-]*)-(.*)-(\d+)")


@dataclass(frozen=True)
class _Region:
    task: int
    annotation: int
    label: str
    file: Path


def brush_export(folder: Path, asked: str) -> MaskFolder | None:
    """The regions of each task, in the order of the tasks; None for a folder with other files.

    Raises:
        InputError: labels that do not tell which are tools.
    """
    regions = _regions(folder)
    if not regions:
        return None
    labels = sorted({region.label for region in regions})
    tools = tool_labels(folder, labels, asked)
    tasks = sorted({region.task for region in regions})
    of_task = {task: [region for region in regions if region.task == task] for task in tasks}
    frames = [
        MaskFrame(f"task-{task}", union_of_files([region.file for region in of_task[task] if region.label in tools]))
        for task in tasks
    ]
    several = sum(len({region.annotation for region in of_task[task]}) > 1 for task in tasks)
    note = f"Label Studio brush labels; {words_about(labels, tools)}; tasks are matched to frames in order"
    note += f"; {several} tasks have several annotations, which are merged" if several else ""
    return MaskFolder(frames, note, True, in_order_only=True)


def _regions(folder: Path) -> list[_Region]:
    """The regions of all files; of a PNG and its NumPy twin, the PNG."""
    files = {file.stem: file for suffix in (".npy", ".png") for file in files_with(folder, (suffix,))}
    found = [(match, file) for stem, file in files.items() if (match := NAME.fullmatch(stem))]
    return [
        # Names of tags seldom have a dash, those of labels may.
        _Region(int(match[1]), int(match[2]), match[4].partition("-")[2] or match[4], file)
        for match, file in found
    ]
