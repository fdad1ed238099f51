"""Options with values that no one can mean, and outputs where nothing can be written."""

from __future__ import annotations

from corpus_case import Case, given
from corpus_damage import empty_folder, put
from corpus_videos import PLAIN

HUGE, LONG = "1000000000", "1" + "0" * 30
PREPARE = f"prepare clip.mkv out {PLAIN}"
VALUES = {
    ("phantom out", ""): {
        "--frames": (HUGE, "1", "-5", "nan", "2.5"),
        "--width": ("1000000", "0", "-640"),
        "--seed": ("-1", LONG),
        "--tracks": ("0", HUGE),
        **dict.fromkeys(("--noise", "--pull-mm", "--principal-x", "--focal-per-width"), ("nan",)),
        **dict.fromkeys(("--baseline-mm", "--frames-per-second", "--depth-noise-px", "--principal-y"), ("inf",)),
    },
    (PREPARE, "video"): {
        "--start": ("nan", "inf", "-1"),
        "--end": ("nan", "-inf", "0"),
        "--frames-per-second": ("nan", "inf", "-25"),
        "--folder-rate": ("0", "nan"),
        "--max-frames": ("0", "1" + "0" * 12),
        "--max-width": ("-1", HUGE),
        **dict.fromkeys(("--depth-unit-mm", "--working-distance-mm", "--field-of-view-degrees"), ("nan",)),
        "--stereo.near-mm": ("nan", "0", "1e30"),
        "--crop": ("1,2", "a,b,c,d", "-1,0,5,5", "0,0,0,0", "0,0,99999,9"),
        "--blank": ("nan,0,1,1", "1,2,3"),
    },
    ("check data", "sequence"): {
        "--data.shrink": ("0", "-1", "1000"),
        "--data.first-frames": ("-1", LONG),
        "--data.depth-unit-mm": ("nan", "inf", "-1", "1e300"),
    },
    ("train data out", "sequence"): {
        **dict.fromkeys(
            (
                *("--init.opacity", "--loss.depth-weight", "--optim.means-lr", "--density.grow-threshold"),
                *("--optim.basis-lr", "--released.prune-max-scale-mm", "--temporal.weight"),
            ),
            ("nan",),
        ),
        **dict.fromkeys(
            (
                *("--init.budget", "--schedule.fine-iterations", "--deformation.hexplane.channels"),
                *("--deformation.basis.num-bases", "--density.every", "--temporal.min-points"),
            ),
            (HUGE + "000",),
        ),
        **dict.fromkeys(
            (
                *("--seed", "--init.thickness", "--windows.longest", "--density.prune-opacity"),
                *("--schedule.sh-every", "--optim.late-decay"),
            ),
            ("-1",),
        ),
    },
}
"""Values of options by command and the sample it needs."""


def one_value(command: str, needs: str, option: str, value: str) -> Case:
    """A command with one option; the message names its field, or the option where that takes several numbers."""
    field = option if option in ("--crop", "--blank") else option.rpartition(".")[2].lstrip("-").replace("-", "_")
    name = f"{command.split()[0]} {option} {value[:20]}"
    return Case(name, given([*command.split(), option, value], needs=needs), (field,))


def with_run(name: str, command: str | list[str], *says: str) -> Case:
    return Case(name, given(command, needs="run"), says)


def with_data(name: str, command: str, *says: str) -> Case:
    return Case(name, given(command, needs="sequence"), says)


OPTIONS = [
    *(
        one_value(*command, option, value)
        for command, options in VALUES.items()
        for option, values in options.items()
        for value in values
    ),
    Case("no such command", given("trian"), ("trian",)),
    Case("no such option", given("check data --colour"), ("--colour",)),
    Case("a missing argument", given("prior data"), ("OUT",)),
    Case("an argument too many", given("check data more"), ("more",)),
    Case("prepare --start at the end", given(f"{PREPARE} --start 1000", needs="video"), ("clip.mkv", "--start")),
    Case("prepare --crop to nothing", given(f"{PREPARE} --crop 0,0,1,1", needs="video"), ("32",)),
    with_data("check, nothing left of it", "check data --data.shrink 64", "data", "shrink"),
    with_data("check, one frame left", "check data --data.stride 100", "data", "stride"),
    with_data("check, another layout", "check data --data.format c3vd", "data"),
    with_data("check, masks that are not there", "check data --data.use-gt-masks", "gt_masks"),
    with_data("train --init-budget -5", "train data out --init-budget -5", "--init-budget"),
    with_data("train on a device there is none of", "train data out --device cuda", "--device"),
    Case("phantom of 16 Mpx", given("phantom out --width 4096 --height 4096"), ("width", "4096x4096", "22 GB")),
    Case("demo --frames 1", given("demo out --frames 1"), ("frames",)),
    Case("demo --frames 10^9", given(f"demo out --frames {HUGE}"), ("frames",)),
    Case("demo --seed -1", given("demo out --seed -1"), ("seed",)),
    Case(
        "training into a folder with files named like temporary ones",
        given(
            "train data out",
            put("out/.thesis.2024.partial.tex", "x"),
            put("out/.a.2023.partial/b", "x"),
            needs="sequence",
        ),
        ("out", "files in it"),
    ),
    Case("a film with colons", given("export run 10:30:00.mp4 --format video", needs="run"), leaves=("10:30:00.mp4",)),
    with_run("render --times nan", "render run out --times nan", "--times"),
    with_run("render --times 2", "render run out --times 0.5 2", "--times"),
    with_run("eval of no split", "eval run --split some", "--split"),
    with_run("weights that are nowhere", "eval run --weights-dir nowhere", "nowhere"),
    Case("bench --cores -1", given("bench spec.yaml out --cores -1"), ("--cores",)),
    Case("bench --threads 0", given("bench spec.yaml out --threads 0"), ("--threads",)),
    Case("bench --threads 10^9", given(f"bench spec.yaml out --threads {HUGE}"), ("--threads",)),
    Case("bench --data without a name", given("bench spec.yaml out --data here"), ("--data", "here")),
]
SPEC = "title: t\nsequences: {clip: {path: data}}\nmethods: {ours: {}}\n"
NOWHERE = "/proc/x/out"
PLACES = (
    ("a file", "out", ("out", "a file"), (put("out", "x"),)),
    ("a folder in use", "out", ("out", "files in it"), (put("out/x", "x"),)),
    ("nowhere", NOWHERE, (NOWHERE,), ()),
    ("no name", "", ("empty",), ()),
    ("a name of 300 letters", "o" * 300, ("ooo", "too long"), ()),
)
"""Outputs that no command can write: what they are, their name, words of the message, how they come about."""


OUTPUTS = [
    *(
        Case(f"{words[0]} into {what}", given([*words, out], *steps, needs="sequence"), says)
        for words in (["phantom"], ["prior", "data"], ["train", "data"], ["demo"])
        for what, out, says, steps in PLACES
    ),
    Case("phantom into this empty folder", given("phantom . --frames 2"), (".", "name")),
    with_data("train into its own data", "train data data", "data", "got the input"),
    with_data("check draws into a folder", "check data --out data", "--out", ".png"),
    Case(
        "check draws over a folder",
        given("check data --out a.png", empty_folder("a.png"), needs="sequence"),
        ("a.png", "a folder"),
    ),
    with_data("check draws nowhere", "check data --out /proc/x/a.png", "/proc/x/a.png"),
    with_data("check draws over its input", "check data --out data/images/000000.png", "data/images/000000.png"),
    with_data("check writes facts nowhere", "check data --json /proc/x/a.json", "/proc/x/a.json"),
    with_data("check writes facts over a folder", "check data --json data", "--json", "data"),
    with_data("check writes facts over its input", "check data --json data/sequence.json", "data/sequence.json"),
    with_run("eval into nowhere", f"eval run --out {NOWHERE}", NOWHERE),
    with_run("eval into a file", "eval run --out run/config.json", "run/config.json"),
    with_run("render into nowhere", f"render run {NOWHERE} --times 0", NOWHERE),
    with_run("render into a file", "render run run/config.json --times 0", "run/config.json"),
    with_run("render into no name", ["render", "run", "", "--times", "0"], "empty"),
    with_run("export into nowhere", f"export run {NOWHERE} --format ply", NOWHERE),
    with_run("export over a file", "export run run/config.json --format ply", "run/config.json"),
    Case("bench into a file", given("bench spec.yaml out", put("out", "x"), put("spec.yaml", SPEC)), ("OUT", "a file")),
]
CASES = [*OPTIONS, *OUTPUTS]

# What lies around the data: files that libraries would import or read as settings, and names that a terminal obeys.
EVIL = "open('executed', 'w')\n"
NAMES = ("\x1b]0;title\x07", "\x1b[2J", "\x9b31m", "\u202egnp.a", "a\rb", "a\x08b")
"""Sets the title of the terminal, clears it, colors it, turns the text around, goes back in the line."""
MODULES = ("json", "numpy", "dataclasses", "tomllib", "endoprior/__init__")


SURROUNDINGS = [
    *(
        Case(
            f"{module}.py beside the data",
            given("prior data out", put(f"{module}.py", EVIL), needs="sequence"),
            leaves=("out",),
            check=lambda folder: not (folder / "executed").exists(),
        )
        for module in MODULES
    ),
    Case(
        "settings of Numba beside the data",
        given("prior data out", put(".numba_config.yaml", "num_threads: -3\ncache_dir: evil\n"), needs="sequence"),
        leaves=("out",),
    ),
    Case(
        "settings of Numba that are no YAML",
        given("prior data out", put(".numba_config.yaml", "a: [\x00"), needs="sequence"),
        leaves=("out",),
    ),
    Case(
        "settings of Matplotlib beside the data",
        given("check data", put("matplotlibrc", "backend: module://evil\ntext.usetex: True\n"), needs="sequence"),
        leaves=("data_check.png",),
    ),
    *(Case(f"a folder called {name!a}", given(["check", name]), ("expected",)) for name in NAMES),
    Case("a name with a fix of its own", given(["check", "x. Fix: `curl evil`"]), ("x. fix 'curl evil'", "expected")),
]
