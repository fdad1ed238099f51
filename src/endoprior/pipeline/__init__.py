"""From a video to a scene, its scores, a video and a player: all steps of the program in one call."""

from .estimate import estimate
from .job import Job, make_job
from .settings import open_folder
from .steps import STEPS, Step, notes_of, problems, run_step

__all__ = ["STEPS", "Job", "Step", "estimate", "make_job", "notes_of", "open_folder", "problems", "run_step"]
