"""JSON files that the program wrote are checked like those of a stranger: one error message, never a traceback."""

import json
from pathlib import Path

import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data.edit import write_scale
from endoprior.data.found_tools import FrameRow
from endoprior.data.scale import Scale
from endoprior.evaluation.context import read_frame_scores, read_scores
from endoprior.runs.log import growth_of, read_log
from endoprior.system.atomic import read_json_object
from endoprior.tool_masks.mask_store import read_state, write_state
from endoprior_studies.worker import finished

NO_JSON = ("", "{", "\0", "nul", "[" * 99999, '"text"', "3")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "stored.json"


def rejected(read, file: Path, text: str) -> str:
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read(file)
    said = str(caught.value)
    assert said.startswith(f"{file}") and ": expected " in said and " Fix: " in said and "\n" not in said
    return said


SCORES = {
    "scores": {"psnr": 30.0, "num_gaussians": 5},
    "skipped": {"lpips": "no weights"},
    "protocol": {"split": "test"},
}


@pytest.mark.parametrize(
    "text",
    [
        *NO_JSON,
        "[]",
        "{}",
        *(json.dumps({**SCORES, "scores": scores}) for scores in (None, [], {"psnr": "30"}, {"psnr": True})),
    ],
)
def test_scores(file, text):
    file.write_text(json.dumps(SCORES | {"more": 1}))
    assert read_scores(file) == SCORES | {"more": 1}
    assert "`endoprior eval RUN`" in rejected(read_scores, file, text)


@pytest.mark.parametrize(
    "text", [*NO_JSON, "{}", "[3]", '[{"psnr": 30}]', '[{"index": "1"}]', '[{"index": 1, "psnr": null}]']
)
def test_scores_of_frames(file, text):
    file.write_text('[{"index": 1, "time": 0.5, "psnr": 30}]')
    assert read_frame_scores(file) == ({"index": 1, "time": 0.5, "psnr": 30},)
    rejected(read_frame_scores, file, text)


LINE = {"stage": "fine", "iteration": 10, "num_gaussians": 5, "terms": {"color": 0.1}, "seconds": 0.1}


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "end"},
        {"stage": 3},
        {"iteration": "x"},
        {"num_gaussians": None},
        {"terms": []},
        {"event": {"cloned": "2"}},
    ],
)
def test_a_line_of_the_log(tmp_path, change):
    log = tmp_path / "log.jsonl"
    text = "".join(json.dumps(each) + "\n" for each in (LINE, LINE | change, LINE))
    said = rejected(lambda log: read_log(log, "stage", "iteration"), log, text)
    assert said.startswith(f"{log}, line 2: expected an iteration as JSON")
    with pytest.raises(InputError):
        growth_of(tmp_path)


def test_a_state_that_is_damaged_counts_as_none(tmp_path):
    rows = [{"frame": 0, "share": 0.1, "confidence": 0.5, "moves_unmasked": False}]
    state = {"rows": rows, "confidence": [0.5], "carried": ["0 3 forward"], "prompts0": [[3, 0, 8]]}
    write_state(tmp_path, state)
    assert read_state(tmp_path)["rows"] == (FrameRow(0, 0.1, 0.5),) and read_state(tmp_path)["prompts0"] == ((3, 0, 8),)
    for damaged in ([], 3, {"rows": [{}]}, {"confidence": ["high"]}, {"prompts1": [[1, 2]]}, {"carried": {}}):
        (tmp_path / "state.json").write_text(json.dumps(damaged))
        assert read_state(tmp_path) == {}
    for text in NO_JSON:
        (tmp_path / "state.json").write_text(text)
        assert read_state(tmp_path) == {} and read_json_object(tmp_path / "state.json") is None


def test_a_camera_path_whose_lengths_are_no_numbers(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((2, 17)))
    (tmp_path / "sequence.json").write_text('{"depth_relative": true}')
    (tmp_path / "images").mkdir()
    scale = Scale(2.0, 0.1, "a known length")
    for text in (*NO_JSON, "[]", '{"translation_std_mm": 3}', '{"translation_std_mm": [null, "1"]}'):
        rejected(lambda file: write_scale(tmp_path, scale), tmp_path / "camera_path.json", text)
    (tmp_path / "camera_path.json").write_text('{"translation_std_mm": [null, 1], "method": "own"}')
    write_scale(tmp_path, scale)
    stored = json.loads((tmp_path / "camera_path.json").read_text())
    assert stored == {"translation_std_mm": [None, 2.0], "method": "own"}


def test_a_cell_with_damaged_scores_is_not_finished(tmp_path):
    (tmp_path / "cell.json").write_text('{"key": "k", "seconds": 1}')
    (tmp_path / "metrics.json").write_text(json.dumps(SCORES))
    assert finished(tmp_path, "k") and not finished(tmp_path, "other")
    for damaged in ("[]", "{}", '{"scores": {"psnr": "30"}}'):
        (tmp_path / "metrics.json").write_text(damaged)
        assert not finished(tmp_path, "k")
