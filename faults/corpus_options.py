"""Options with values that no one can mean, and outputs where nothing can be written."""

from __future__ import annotations

from pathlib import Path

from corpus_case import Build, Case, Samples
from corpus_damage import put
from corpus_videos import PLAIN

HUGE = "1000000000"


def given(*words: str, sample: str = "") -> Build:
    """A command as it stands; a copy of a sample is `data`."""

    def build(folder: Path, samples: Samples) -> list[str]:
        if sample:
            samples.copy(sample, folder / "data")
        return list(words)

    return build


def phantom(option: str, value: str) -> Case:
    """A phantom with one option."""
    name = option.removeprefix("--").replace("-", "_")
    return Case(f"phantom {option} {value[:20]}", given("phantom", "out", option, value), (name,))


def prepare(option: str, value: str, says: str = "") -> Case:
    """A film with one option."""
    words = ("prepare", "data", "out", *PLAIN, option, value)
    name = says or option.removeprefix("--").replace("-", "_").rpartition(".")[2]
    return Case(f"prepare {option} {value[:20]}", given(*words, sample="video"), (name,))


def reading(command: str, option: str, value: str, out: tuple[str, ...] = ()) -> Case:
    """A sequence with one option."""
    name = option.rpartition(".")[2].removeprefix("--").replace("-", "_")
    return Case(
        f"{command} {option} {value[:20]}", given(command, "data", *out, option, value, sample="sequence"), (name,)
    )


def with_run(name: str, *words: str, says: tuple[str, ...], leaves: tuple[str, ...] = ()) -> Case:
    """A command on a run; `run` stands for its folder."""

    def build(folder: Path, samples: Samples) -> list[str]:
        samples.copy("run", folder / "run")
        return list(words)

    return Case(name, build, says, leaves)


OPTIONS = [
    Case("no such command", given("trian"), ("trian",)),
    Case("no such option", given("check", "data", "--colour"), ("--colour",)),
    Case("a missing argument", given("prior", "data"), ("OUT",)),
    Case("an argument too many", given("check", "data", "more"), ("more",)),
    *(phantom("--frames", value) for value in (HUGE, "1", "-5", "nan", "2.5")),
    *(phantom("--width", value) for value in ("1000000", "0", "-640")),
    *(phantom("--seed", value) for value in ("-1", "1" + "0" * 30)),
    *(phantom("--tracks", value) for value in ("0", HUGE)),
    *(phantom(option, "nan") for option in ("--noise", "--pull-mm", "--principal-x", "--focal-per-width")),
    *(
        phantom(option, "inf")
        for option in ("--baseline-mm", "--frames-per-second", "--depth-noise-px", "--principal-y")
    ),
    *(prepare("--start", value) for value in ("nan", "inf", "-1")),
    *(prepare("--end", value) for value in ("nan", "-inf", "0")),
    *(prepare("--frames-per-second", value) for value in ("nan", "inf", "-25")),
    *(prepare("--folder-rate", value) for value in ("0", "nan")),
    *(prepare("--max-frames", value) for value in ("0", "1" + "0" * 12)),
    *(prepare("--max-width", value) for value in ("-1", HUGE)),
    *(prepare(option, "nan") for option in ("--depth-unit-mm", "--working-distance-mm", "--field-of-view-degrees")),
    *(prepare("--stereo.near-mm", value) for value in ("nan", "0", "1e30")),
    *(prepare("--stereo.block-px", value) for value in ("4", HUGE)),
    *(prepare("--crop", value, "--crop") for value in ("1,2", "a,b,c,d", "-1,0,5,5", "0,0,0,0", "0,0,99999,9")),
    *(prepare("--blank", value, "--blank") for value in ("nan,0,1,1", "1,2,3")),
    Case(
        "prepare --start at the end",
        given("prepare", "data", "out", *PLAIN, "--start", "1000", sample="video"),
        ("data", "--start"),
    ),
    Case(
        "prepare --crop to nothing",
        given("prepare", "data", "out", *PLAIN, "--crop", "0,0,1,1", sample="video"),
        ("32",),
    ),
    *(reading("check", "--data.shrink", value) for value in ("0", "-1", "1000")),
    *(reading("check", "--data.first-frames", value) for value in ("-1", "1" + "0" * 30)),
    *(reading("check", "--data.depth-unit-mm", value) for value in ("nan", "inf", "-1", "1e300")),
    *(reading("check", "--data.depth-clip-low-percentile", value) for value in ("nan", "101")),
    Case(
        "check, nothing left of it",
        given("check", "data", "--data.shrink", "64", sample="sequence"),
        ("data", "shrink"),
    ),
    Case(
        "check, one frame left", given("check", "data", "--data.stride", "100", sample="sequence"), ("data", "stride")
    ),
    Case("check, another layout", given("check", "data", "--data.format", "c3vd", sample="sequence"), ("data",)),
    Case(
        "check, masks that are not there",
        given("check", "data", "--data.use-gt-masks", sample="sequence"),
        ("gt_masks",),
    ),
    *(
        reading("prior", f"--specular.{name}", value, ("out",))
        for name in ("value-threshold", "value-temperature")
        for value in ("nan", "inf")
    ),
    *(reading("prior", "--salience.percentile", value, ("out",)) for value in ("nan", "101")),
    *(
        reading("train", option, "nan", ("out",))
        for option in (
            "--init.opacity",
            "--loss.depth-weight",
            "--optim.means-lr",
            "--density.grow-threshold",
            "--temporal.huber-delta",
            "--deformation.basis.relative-width",
            "--temporal.weight",
        )
    ),
    *(
        reading("train", option, HUGE + "000", ("out",))
        for option in (
            "--init.budget",
            "--init.voxel-divisions",
            "--deformation.hexplane.channels",
            "--deformation.basis.num-bases",
            "--density.max-gaussians",
            "--temporal.num-neighbors",
        )
    ),
    *(
        reading("train", option, "-1", ("out",))
        for option in (
            "--seed",
            "--init.erosion-px",
            "--init.outlier-neighbors",
            "--optim.epsilon",
            "--schedule.sh-every",
            "--density.split-shrink",
        )
    ),
    Case(
        "train --init-budget -5",
        given("train", "data", "out", "--init-budget", "-5", sample="sequence"),
        ("--init-budget",),
    ),
    Case(
        "train on a device there is none of",
        given("train", "data", "out", "--device", "cuda", sample="sequence"),
        ("--device",),
    ),
    Case(
        "phantom of 16 Mpx",
        given("phantom", "out", "--width", "4096", "--height", "4096"),
        ("`width`", "4096x4096", "22 GB"),
    ),
    Case("demo --frames 1", given("demo", "out", "--frames", "1"), ("frames",)),
    Case("demo --frames 10^9", given("demo", "out", "--frames", HUGE), ("frames",)),
    Case("demo --seed -1", given("demo", "out", "--seed", "-1"), ("seed",)),
    with_run("render --times nan", "render", "run", "out", "--times", "nan", says=("--times",)),
    with_run("render --times 2", "render", "run", "out", "--times", "0.5", "2", says=("--times",)),
    with_run("eval of no split", "eval", "run", "--split", "some", says=("--split",)),
    with_run("weights that are nowhere", "eval", "run", "--weights-dir", "nowhere", says=("nowhere",)),
    Case("bench --cores -1", given("bench", "spec.yaml", "out", "--cores", "-1"), ("--cores",)),
    Case("bench --threads 0", given("bench", "spec.yaml", "out", "--threads", "0"), ("--threads",)),
    Case("bench --threads 10^9", given("bench", "spec.yaml", "out", "--threads", HUGE), ("--threads",)),
    Case("bench --data without a name", given("bench", "spec.yaml", "out", "--data", "here"), ("--data", "here")),
]
SPEC = "title: t\nsequences: {clip: {path: data}}\nmethods: {ours: {}}\n"
NOWHERE = "/proc/x/out"
OUTPUTS = [
    *(
        Case(f"{command} into {what}", build, words)
        for command, arguments in (("phantom", ()), ("prior", ("data",)), ("train", ("data",)), ("demo", ()))
        for what, build, words in (
            (
                "a file",
                lambda f, s, c=command, a=arguments: [
                    s.copy("sequence", f / "data"),
                    put("out", "x")(f),
                    [c, *a, "out"],
                ][2],
                ("out", "a file"),
            ),
            (
                "a folder in use",
                lambda f, s, c=command, a=arguments: [
                    s.copy("sequence", f / "data"),
                    put("out/x", "x")(f),
                    [c, *a, "out"],
                ][2],
                ("out", "files in it"),
            ),
            (
                "nowhere",
                lambda f, s, c=command, a=arguments: [s.copy("sequence", f / "data"), [c, *a, NOWHERE]][1],
                (NOWHERE,),
            ),
            (
                "no name",
                lambda f, s, c=command, a=arguments: [s.copy("sequence", f / "data"), [c, *a, ""]][1],
                ("empty",),
            ),
            (
                "a name of 300 letters",
                lambda f, s, c=command, a=arguments: [s.copy("sequence", f / "data"), [c, *a, "o" * 300]][1],
                ("ooo", "too long"),
            ),
        )
    ),
    Case("phantom into this empty folder", given("phantom", ".", "--frames", "2"), (".", "name")),
    Case("train into its own data", given("train", "data", "data", sample="sequence"), ("data", "files in it")),
    Case("check draws into a folder", given("check", "data", "--out", "data", sample="sequence"), ("--out", ".png")),
    Case(
        "check draws over a folder",
        lambda f, s: [s.copy("sequence", f / "data"), (f / "a.png").mkdir(), ["check", "data", "--out", "a.png"]][2],
        ("a.png", "a folder"),
    ),
    Case(
        "check draws nowhere", given("check", "data", "--out", "/proc/x/a.png", sample="sequence"), ("/proc/x/a.png",)
    ),
    Case(
        "check draws over its input",
        given("check", "data", "--out", "data/images/000000.png", sample="sequence"),
        ("data/images/000000.png", "data"),
    ),
    Case(
        "check writes facts nowhere",
        given("check", "data", "--json", "/proc/x/a.json", sample="sequence"),
        ("/proc/x/a.json",),
    ),
    Case(
        "check writes facts over a folder",
        given("check", "data", "--json", "data", sample="sequence"),
        ("--json", "data"),
    ),
    Case(
        "check writes facts over a file of its input",
        given("check", "data", "--json", "data/sequence.json", sample="sequence"),
        ("data/sequence.json",),
    ),
    with_run("eval into nowhere", "eval", "run", "--out", NOWHERE, says=(NOWHERE,)),
    with_run("eval into a file", "eval", "run", "--out", "run/config.json", says=("run/config.json",)),
    with_run("render into nowhere", "render", "run", NOWHERE, "--times", "0", says=(NOWHERE,)),
    with_run("render into a file", "render", "run", "run/config.json", "--times", "0", says=("run/config.json",)),
    with_run("render into no name", "render", "run", "", "--times", "0", says=("empty",)),
    with_run("export into nowhere", "export", "run", NOWHERE, "--format", "ply", says=(NOWHERE,)),
    with_run("export over a file", "export", "run", "run/config.json", "--format", "ply", says=("run/config.json",)),
    Case(
        "bench into a file",
        lambda f, s: [put("out", "x")(f), put("spec.yaml", SPEC)(f), ["bench", "spec.yaml", "out"]][2],
        ("OUT out", "a file"),
    ),
]
CASES = [*OPTIONS, *OUTPUTS]
