"""From a video to a scene, its scores, a video and a player: all steps of the program in one call."""

from .estimate import estimate
from .job import Job, make_job, open_folder
from .steps import STEPS, Step, problems, run_step

__all__ = ["STEPS", "Job", "Step", "estimate", "make_job", "open_folder", "problems", "run_step"]
