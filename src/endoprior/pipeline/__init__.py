"""From a video to a scene, its scores, a video and a player: all steps of the program in one call, for one or many."""

from .batch import SUMMARY, TABLE, Entry, Outcome, run_here, run_on, write_summary
from .forecast import COMPILE, Forecast, parts_of
from .job import Job, SequenceJob, make_job, open_folder, removed_if_rejected
from .steps import STEPS, HandedOn, Step, notes_of, problems, run_step, steps_of, verdict_of

__all__ = [
    "COMPILE",
    "STEPS",
    "SUMMARY",
    "TABLE",
    "Entry",
    "Forecast",
    "HandedOn",
    "Job",
    "Outcome",
    "SequenceJob",
    "Step",
    "make_job",
    "notes_of",
    "open_folder",
    "parts_of",
    "problems",
    "removed_if_rejected",
    "run_here",
    "run_on",
    "run_step",
    "steps_of",
    "verdict_of",
    "write_summary",
]
