"""Broken and hostile inputs for the command line: every case there is. `tests/test_bad_inputs.py` runs them.

A command rejects bad input with exit status 2 and one line on stderr that names the file or the option; it writes
nothing and changes nothing.
"""

from __future__ import annotations

import corpus_options
import corpus_prepare
import corpus_runs
import corpus_sequences
import corpus_videos
from corpus_case import Case

KINDS = {
    "sequences": corpus_sequences.CASES,
    "poses and facts": corpus_sequences.NUMBERS,
    "videos": corpus_videos.CASES,
    "beside a video": corpus_prepare.CASES,
    "options and outputs": corpus_options.CASES,
    "runs and specs": corpus_runs.CASES,
    "around the data": corpus_options.SURROUNDINGS,
}
CASES: list[Case] = [case for cases in KINDS.values() for case in cases]
