"""What the program knows about its own installation: packages of optional parts, commit, documentation."""

import re
import tomllib
from pathlib import Path

import pytest

from endoprior.core.shell import install_command, missing_package
from endoprior.system import installation

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("extra", sorted({*PROJECT["optional-dependencies"]} - {"test", "test-tools"}))
def test_the_packages_of_an_optional_part_are_those_of_pyproject(extra):
    names = [re.match(r"[\w-]+", line)[0] for line in PROJECT["optional-dependencies"][extra]]
    constraints = "" if extra == "cuda" else "-c constraints.txt "  # gsplat keeps whichever torch is there
    assert install_command(extra) == f"pip install {constraints}{' '.join(names)}"
    if extra in ("networks", "mono", "exr", "poses", "ray", "tools", "usd"):
        assert f"`{install_command(extra)}`" in (ROOT / "docs" / "install.md").read_text()


def test_packages_that_only_some_systems_need_are_no_optional_part(monkeypatch):
    lines = ['b>=1; sys_platform != "none"', 'c>=2; sys_platform != "none" and extra == "x"', 'd; extra == "y"', "a"]
    monkeypatch.setattr("endoprior.core.shell.requires", lambda name: lines)
    install_command.cache_clear()
    assert install_command("x") == "pip install -c constraints.txt c"
    install_command.cache_clear()


def test_a_missing_package_is_told_apart_from_one_that_fails():
    fix = "Fix: `pip install -c constraints.txt torchvision lpips`."
    absent = ModuleNotFoundError("No module named 'lpips'", name="lpips")
    assert missing_package("lpips", "networks", absent) == f"lpips is not installed. {fix}"
    said = missing_package("lpips", "networks", ModuleNotFoundError("No module named 'scipy'\nx", name="scipy"))
    assert said == f"lpips cannot be imported (No module named 'scipy'). {fix}"


def test_no_message_takes_the_program_for_one_on_a_package_index():
    for path in sorted([*ROOT.glob("src/**/*.py"), *ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]):
        assert not re.search(r"endoprior\[|pip install endoprior", path.read_text()), path


def test_a_page_is_a_file_of_this_machine_or_an_address(monkeypatch, tmp_path):
    assert Path(installation.page("scores.md")).samefile(ROOT / "docs/scores.md")
    monkeypatch.setattr(installation, "PACKAGE", tmp_path / "a/b")
    assert installation.page("scores.md") == PROJECT["urls"]["Paper"]


def test_pages_that_the_program_names_exist():
    folder = installation.docs_folder()
    for path in sorted((ROOT / "src").rglob("*.py")):
        for page in re.findall(r"docs/(\w+\.md)", path.read_text()):
            assert (folder / page).is_file(), f"{path}: docs/{page}"


def test_the_stamp_of_a_built_package_comes_before_git(tmp_path, monkeypatch):
    monkeypatch.setattr(installation, "STAMP", tmp_path / "commit.txt")
    assert installation.source_commit() != "0123456789ab"
    (tmp_path / "commit.txt").write_text("0123456789ab\n")
    assert installation.source_commit() == "0123456789ab"
