"""The built packages: what is in them, and that the program works where only the wheel is installed."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import cv2
import pytest
import yaml
from video_files import write_video

ROOT = Path(__file__).parents[1]
LEFT_OUT = {".git", ".venv", ".hypothesis", ".pytest_cache", ".ruff_cache", "build", "demo", "dist", "figures", "runs"}
"""What lies in the root of a checkout and is not part of it."""
ENVIRONMENT = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "PIP_", "GIT_"))}
SMALL_TRAINING = ("--init-budget", "300", "--schedule.fine-iterations", "20", "--no-networks")
SPEC = {
    "title": "Tiny",
    "sequences": {"phantom": {"phantom": {"frames": 9, "width": 64, "height": 48}}},
    "methods": {"default": {"set": {"init.budget": 300, "schedule.fine_iterations": 20}}},
    "figures": [],
}

pytestmark = pytest.mark.slow


def output(*words: str | Path, cwd: Path) -> str:
    """What a command prints; the test fails if the command does."""
    done = subprocess.run(words, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{words}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of the repository with one commit: building leaves files behind."""
    folder = tmp_path_factory.mktemp("release") / "checkout"

    def left_out(place: str, names: list[str]) -> set[str]:
        return {"__pycache__", "endoprior.egg-info"} | (LEFT_OUT if Path(place) == ROOT else set())

    shutil.copytree(ROOT, folder, ignore=left_out)
    for words in (["init", "--quiet"], ["add", "--all"], ["commit", "--quiet", "--message", "all"]):
        output("git", "-c", "user.name=test", "-c", "user.email=test@localhost", *words, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def commit(checkout):
    """The commit of the copy, as runs record it."""
    return output("git", "describe", "--always", "--abbrev=12", "--exclude=*", cwd=checkout).strip()


@pytest.fixture(scope="module")
def built(checkout):
    """The folder of the source package and of the wheel that was built from it."""
    output(sys.executable, "-m", "build", "--no-isolation", cwd=checkout)
    return checkout / "dist"


@pytest.fixture(scope="module")
def endoprior(built, tmp_path_factory):
    """The command of a new environment that holds the wheel, and our requirements but not our source."""
    folder = tmp_path_factory.mktemp("installed")
    output(sys.executable, "-m", "venv", "--without-pip", "venv", cwd=folder)
    python = folder / "venv" / "bin" / "python"
    wheel = next(built.glob("*.whl"))
    output(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    # The requirements are those of the tests: a line in a .pth file adds a folder, but not the .pth files inside of it,
    # one of which makes our source importable.
    packages = output(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    Path(packages, "requirements.pth").write_text(sysconfig.get_path("purelib"))
    place = output(python, "-c", "import endoprior; print(endoprior.__file__)", cwd=folder)
    assert place.startswith(packages), f"{place} is not the installed program"
    return python.with_name("endoprior")


def names(wheel: Path) -> list[str]:
    """Paths in a wheel, sorted."""
    with zipfile.ZipFile(wheel) as file:
        return sorted(file.namelist())


def test_the_wheel_holds_the_whole_package_and_its_documentation(checkout, built, commit):
    found = {name for name in names(next(built.glob("*.whl"))) if ".dist-info/" not in name}
    sources = ("endoprior", "endoprior_baselines", "endoprior_radiance", "endoprior_studies")
    files = (path for name in sources for path in (ROOT / "src" / name).rglob("*") if path.is_file())
    package = {path.relative_to(ROOT / "src") for path in files}
    pages = {Path("endoprior") / path.relative_to(ROOT) for path in (ROOT / "docs").rglob("*") if path.is_file()}
    wanted = {path.as_posix() for path in package | pages if not {"__pycache__", "log.md"} & {*path.parts}}
    assert found == wanted | {"endoprior/commit.txt"}
    assert {"endoprior/py.typed", "endoprior/export/player/player.html", "endoprior/docs/prepare.md"} <= found
    output(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", "direct", cwd=checkout)
    (direct,) = (checkout / "direct").glob("*.whl")
    assert names(direct) == names(next(built.glob("*.whl"))), "not what the source package gives"
    with zipfile.ZipFile(direct) as file:
        assert file.read("endoprior/commit.txt").decode().strip() == commit


def test_the_source_package_holds_what_the_repository_holds(checkout, built):
    with tarfile.open(next(built.glob("*.tar.gz"))) as file:
        found = {name.partition("/")[2] for name in file.getnames()}
    tracked = output("git", "ls-files", cwd=checkout).split()
    assert {*tracked} <= found
    assert {"Makefile", "constraints.txt", "docs/prepare.md", "tests/test_release.py"} <= found


def test_the_wheel_works_outside_of_the_repository(endoprior, commit, tmp_path):
    def run(*words: str) -> str:
        return output(endoprior, *words, cwd=tmp_path)

    # Every command that a new user starts with belongs here.
    assert run("--version").strip() == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    help_text, doctor = run("--help"), run("doctor")
    assert f"commit {commit};" in doctor
    (docs,) = {Path(text.split("in ")[-1].strip()) for text in help_text.splitlines() if text.endswith("docs")}
    assert docs.parts[-2:] == ("endoprior", "docs") and (docs / "datasets.md").is_file()
    run("phantom", "data", "--frames", "12", "--width", "128", "--height", "96")
    run("train", "data", "run", *SMALL_TRAINING)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["commit"] == commit
    run("export", "run", "player.html", "--format", "html")
    assert (tmp_path / "player.html").stat().st_size > 10_000
    assert "Quick look" in run("bench", "quick", "quick", "--report-only")
    images = [cv2.imread(str(file))[..., ::-1] for file in sorted((tmp_path / "data" / "images").glob("*.png"))]
    write_video(tmp_path / "clip.mp4", images)
    assert "Open first/player.html in a browser." in run("run", "clip.mp4", "first", "--preview", "--masks", "none")
    assert (tmp_path / "first" / "player.html").stat().st_size > 10_000
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(SPEC))
    run("bench", "tiny.yaml", "tiny", "--cores", "1")
    assert f"trained at commit {commit}." in (tmp_path / "tiny" / "results.md").read_text()
