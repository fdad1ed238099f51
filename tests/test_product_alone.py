"""The product without the compared methods and the studies: it trains, scores and says what it does not know."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from plugin_packages import entry_points, write_package

import endoprior

ALONE = """
import sys
for name in ("baselines", "radiance", "studies"):
    sys.modules[f"endoprior_{name}"] = None
from endoprior.cli import main

sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def alone(tmp_path):
    """Runs a command where only the product is installed; returns what subprocess.run does."""
    source = Path(endoprior.__file__).parents[1]
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "endoprior").symlink_to(source / "endoprior", target_is_directory=True)
    own = {
        kind: {name: target for name, target in entries.items() if target.startswith("endoprior.")}
        for kind, entries in entry_points(source.parent).items()
    }
    write_package(tmp_path / "site", "endoprior", own)

    def run(*words: str | Path) -> subprocess.CompletedProcess:
        environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
        command = [sys.executable, "-c", ALONE, *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)

    return run


@pytest.mark.slow
def test_the_product_trains_and_scores_by_itself(alone, tiny_sequence, tmp_path):
    sizes = ("--iterations", "3", "--gaussians", "200", "--no-networks")
    done = alone("train", tiny_sequence, tmp_path / "run", *sizes)
    assert done.returncode == 0, done.stderr
    assert alone("eval", tmp_path / "run", "--no-networks").returncode == 0


@pytest.mark.slow
def test_what_is_not_installed_is_not_offered(alone, tiny_sequence, tmp_path):
    assert "bench" not in alone("--help").stdout
    done = alone("train", tiny_sequence, tmp_path / "run", "--preset", "endogs")
    assert done.returncode == 2 and "--preset: invalid choice: 'endogs'" in done.stderr
    assert done.stderr.count("\n") == 1
