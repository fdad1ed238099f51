"""From a video to a scene, its scores, a video and a player: all steps of the program in one call, for one or many."""

from .batch import Entry, Outcome, run_here, run_on
from .estimate import estimate, seconds_if_moving
from .job import Job, SequenceJob, make_job
from .settings import open_folder
from .steps import STEPS, Step, notes_of, problems, run_step, steps_of
from .summary import SUMMARY, TABLE, write_summary

__all__ = [
    "STEPS",
    "SUMMARY",
    "TABLE",
    "Entry",
    "Job",
    "Outcome",
    "SequenceJob",
    "Step",
    "estimate",
    "make_job",
    "notes_of",
    "open_folder",
    "problems",
    "run_here",
    "run_on",
    "run_step",
    "seconds_if_moving",
    "steps_of",
    "write_summary",
]
