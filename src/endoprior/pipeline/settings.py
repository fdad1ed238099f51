"""The settings of a job, in its folder: a job that is resumed must have the same ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..core.checks import input_error
from ..core.config_io import to_dict
from ..core.options import command_of
from ..data import load_sequence
from ..data.files import read_json
from ..prepare.first_pass import input_facts, source_facts
from ..system.atomic import reject_occupied, write_json
from .job import Job, SequenceJob

SETTINGS = "settings.json"
"""File in the output folder with everything that decides the results."""
MOST_NAMED = 4
"""Differences that a message names; more are counted."""


def open_folder(job: SequenceJob) -> bool:
    """Create the output folder, or accept that of an interrupted job with the same settings.

    Returns:
        Whether the folder was there before.
    Raises:
        InputError: the folder holds something else, or a job with other settings; it names them.
    """
    file, given = job.out / SETTINGS, json.loads(json.dumps(_settings(job)))
    if not file.is_file():
        reject_occupied(job.out)
        job.out.mkdir(parents=True, exist_ok=True)
        write_json(file, given)
        return False
    if found := differences(read_json(file), given):
        got = "; ".join(found[:MOST_NAMED]) + (f"; and {len(found) - MOST_NAMED} more" if found[MOST_NAMED:] else "")
        other = command_of("run" if isinstance(job, Job) else "train", (job.source, Path("OUT2")), job.options)
        fix = f"give the stored settings to resume, or choose another folder: `{other}`."
        raise input_error(job.out, "results of the same video and options", got, fix)
    return True


def differences(stored: dict[str, Any], given: dict[str, Any]) -> list[str]:
    """What differs between two settings, one text for each: `--end: stored 2.5, given 3`.

    Numbers that follow from the video and the options are named only if these are equal: after an update, for instance.
    """
    stored = {"inputs": given.get("inputs")} | stored  # older settings have none
    if stored.keys() != given.keys() or not all(isinstance(stored[part], dict) for part in given):
        return ["settings of another version"]
    named = []
    if stored["video"] != given["video"]:
        names = [facts.get("name") for facts in (stored["video"], given["video"])]
        changed = ", which has changed" if names[0] == names[1] else ""
        named.append(f"VIDEO: stored {names[0]}, given {names[1]}{changed}")
    before, now = stored["options"], given["options"]
    for name in {**before, **now}:
        if before.get(name) != now.get(name):
            texts = [_text(before.get(name), now.get(name)), _text(now.get(name), before.get(name))]
            named.append(f"{name}: stored {texts[0]}, given {texts[1]}")
        elif (facts := given["inputs"].get(name)) and facts != stored["inputs"].get(name):
            named.append(f"{name}: {facts['name']}, which has changed")
    before, now = _flat(stored["derived"]), _flat(given["derived"])
    changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return named or [f"{name}: stored {before.get(name)}, given {now.get(name)}" for name in changed]


def _settings(job: SequenceJob) -> dict[str, Any]:
    """Everything that decides the results of a job."""
    if not isinstance(job, Job):
        facts = {"name": job.source.name, "fingerprint": load_sequence(job.source, job.cfg.data).fingerprint()}
        return {"video": facts, "inputs": {}, "options": job.options, "derived": {"config": to_dict(job.cfg)}}
    prepare = {name: repr(value) for name, value in vars(job.prepare).items()}
    derived = {"prepare": prepare, "config": to_dict(job.cfg)}
    inputs = input_facts(job.prepare)
    return {"video": source_facts(job.source), "inputs": inputs, "options": job.options, "derived": derived}


def _text(words: Any, others: Any) -> str:
    """The words after an option; None if it was not given."""
    if words is None:
        return "no" if others == [] else "the default"
    return " ".join(map(str, words)) or "yes" if isinstance(words, list) else str(words)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The entries of a nested dict by their dotted names."""
    flat = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
