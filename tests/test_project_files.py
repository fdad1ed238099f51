"""Files beside the source: citation and container image agree with the project."""

import re
import runpy
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "abstract", "authors", "version"} <= citation.keys()
    assert (citation["cff-version"], str(citation["version"])) == ("1.2.0", PROJECT["version"])
    assert (citation["title"], citation["license"]) == (PROJECT["name"], PROJECT["license"])
    assert citation["authors"] == PROJECT["authors"] and citation["keywords"] == PROJECT["keywords"]
    (paper,) = citation["references"]
    readme = (ROOT / "README.md").read_text()
    assert f"version = {{{PROJECT['version']}}}" in readme
    assert " and ".join(f"{each['family-names']}, {each['given-names']}" for each in paper["authors"]) in readme
    assert paper["url"] == PROJECT["urls"]["Paper"] and paper["url"] in readme


def test_the_image_is_small_and_copies_what_exists():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert len(lines) <= 25
    copied = {source for line in lines if line.startswith("COPY ") for source in line.split()[1:-1]}
    assert copied == allowed and all((ROOT / source).exists() for source in copied)
    (user,) = re.findall(r"^USER (\S+)$", "\n".join(lines), re.MULTILINE)
    assert user not in ("root", "0")


TOOL = runpy.run_path(str(ROOT / "tools" / "third_party_notices.py"))


def test_the_third_party_notices_are_of_the_pinned_versions():
    rows = [line.strip("| ").split(" | ") for line in (ROOT / "THIRD_PARTY_NOTICES.md").read_text().splitlines()]
    named = {(row[0], row[1]) for row in rows if len(row) > 3 and row[1][0].isdigit()}
    pins = TOOL["pinned"]()
    assert named == {pins[name] for name in TOOL["parts"]()}
    if all(metadata.version(name).partition("+")[0] == pins[name][1] for name in TOOL["parts"]()):
        assert (ROOT / "THIRD_PARTY_NOTICES.md").read_text() == TOOL["notices"](), "run tools/third_party_notices.py"


def test_least_versions_are_safe_ones_and_the_pinned_ones_are_newer():
    """Those that SECURITY.md names, with what was wrong before."""
    project = PROJECT["dependencies"] + [line for lines in PROJECT["optional-dependencies"].values() for line in lines]
    least = {each.name: each.specifier for each in map(Requirement, project)}
    table = re.findall(r"^\| `([a-z]+)` \| ([0-9.]+) \|", (ROOT / "SECURITY.md").read_text(), re.MULTILINE)
    assert {name for name, _ in table} == {"torch", "matplotlib", "ray"}
    for name, version in table:
        assert str(least[name]) == f">={version}"
    for name, specifier in least.items():
        if pin := TOOL["pinned"]().get(name.lower()):
            assert pin[1] in specifier, name


def test_the_changelog_has_a_section_for_the_release():
    notes = runpy.run_path(str(ROOT / "tools" / "release_notes.py"))["notes"]
    assert notes(f"v{PROJECT['version']}").startswith("### ")
    with pytest.raises(SystemExit, match="expected the tag v"):
        notes("v0.0.1")


def test_the_changelog_sorts_what_changed_by_kind():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    assert [part.split("\n")[0] for part in versions[:1]] == ["Unreleased"]
    for part in versions:
        kinds = re.findall(r"^#+ (.*)$", part, re.MULTILINE)
        assert kinds == [kind for kind in ("Added", "Changed", "Removed", "Fixed") if kind in kinds], part[:40]
        assert not re.search(r"^- ", part.partition("\n###")[0], re.MULTILINE), "expected a kind above each line"


SUBJECTS = runpy.run_path(str(ROOT / "tools" / "check_subjects.py"))


def test_one_rule_for_first_lines_serves_hook_and_workflow(tmp_path):
    problem = SUBJECTS["problem"]
    assert problem("a" * 72) is None
    assert problem("a" * 73).endswith("expected at most 72 characters, got 73")
    assert problem(" ") == "expected a first line, got none"
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    workflow = (ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8")
    (hook,) = (hook for hook in hooks if hook.get("stages") == ["commit-msg"])
    assert hook["entry"] == "python tools/check_subjects.py" and f"{hook['entry']} --commits" in workflow
    message = tmp_path / "message"
    for subject, status in (("Short", 0), ("a" * 80, 1)):
        message.write_text(f"{subject}\n\n{'b' * 90}\n")
        assert subprocess.run([sys.executable, ROOT / "tools" / "check_subjects.py", message]).returncode == status


def test_subjects_of_a_range_of_commits_are_checked(tmp_path):
    git = ["git", "-c", "user.name=test", "-c", "user.email=test@localhost"]
    subprocess.run([*git, "init", "--quiet"], cwd=tmp_path, check=True)
    for subject in ("first", "second " + "x" * 70):
        subprocess.run([*git, "commit", "--quiet", "--allow-empty", "-m", subject], cwd=tmp_path, check=True)
    words = [sys.executable, ROOT / "tools" / "check_subjects.py", "--commits"]
    done = [subprocess.run([*words, commits], cwd=tmp_path, capture_output=True) for commits in ("HEAD~1", "HEAD")]
    assert [each.returncode for each in done] == [0, 1] and b"got 77" in done[1].stderr


def test_workflows_run_actions_of_one_commit_only():
    """A tag of an action can be moved to other code, a commit cannot."""
    files = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    used = [line for file in files for line in file.read_text().splitlines() if "uses:" in line]
    assert len(files) == 2 and used
    for line in used:
        assert re.search(r"uses: [\w./-]+@[0-9a-f]{40} # v[0-9.]+$", line), line


def test_every_yaml_file_of_the_project_can_be_read():
    hidden = [ROOT / ".pre-commit-config.yaml", *(ROOT / ".github").rglob("*.yml")]
    assert all(yaml.safe_load(file.read_text()) for file in hidden)


def test_the_workflow_runs_what_it_names():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))
    job = workflow["jobs"]["test"]
    assert {name.split("-")[0] for name in job["strategy"]["matrix"]["os"]} == {"ubuntu", "macos", "windows"}
    oldest = re.search(r'requires-python = ">=([\d.]+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))[1]
    assert oldest in job["strategy"]["matrix"]["python"]
    steps = "\n".join(step.get("run", "") for step in job["steps"])
    assert "make" not in steps  # Windows has none
    for word in ("-c constraints.txt", "pytest -n 2 --dist loadfile"):
        assert word in steps
    assert workflow["jobs"]["lint"]["steps"][-1]["run"] == "make lint"
    for name, words in {"lowest": "--resolution lowest-direct -e", "minimal": "-c constraints.txt -e"}.items():
        job = workflow["jobs"][name]
        assert job["steps"][1]["with"]["python-version"] == oldest
        steps = "\n".join(step.get("run", "") for step in job["steps"])
        assert f'{words} ".[test-tools]"' in steps and "pytest -n 2 --dist loadfile" in steps, name


def test_updates_are_proposed_for_actions_and_packages():
    updates = yaml.safe_load((ROOT / ".github" / "dependabot.yml").read_text())["updates"]
    assert {each["package-ecosystem"] for each in updates} == {"github-actions", "pip"}


def test_no_install_command_asks_the_index_of_small_torch_for_every_package():
    """Behind a firewall pip tries it five times for each package."""
    pages = [ROOT / name for name in ("README.md", "Dockerfile", "docs/install.md", ".github/workflows/release.yml")]
    lines = [line for page in pages for line in page.read_text().splitlines() if re.search("pip (install|wheel)", line)]
    of_torch = [line for line in lines if "whl/cpu" in line]
    assert len(of_torch) == 5 and all(" torch --no-deps --index-url " in line for line in of_torch)
    readme = (ROOT / "README.md").read_text()
    first, *_ = re.findall(r"^pip install .*", readme, re.MULTILINE)
    assert first == "pip install -c constraints.txt ." and readme.index(first) < readme.index("whl/cpu")
