"""The architecture, checked: imports point one way, files stay short, heavy libraries have one owner."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src" / "endoprior"
FILES = sorted(SRC.rglob("*.py"))

LAYERS = [
    {"checks", "types", "lane_types", "morton", "compiled", "density_kernels"},
    {"simd", "float64_lanes", "memory"},
    {"config", "atomic", "adam_kernels", "neighbor_kernels", "temporal_kernels"},
    {"config_io", "presets", "arrays_file", "geometry", "divergence"},
    {"losses"},
    {"data", "priors", "render", "loss_kernels", "temporal", "metrics", "footage"},
    {"phantom", "model", "density", "doctor"},
    {"device"},
    {"adam"},
    {"optim", "training_frames", "truth_scores"},
    {"train_state", "evaluate", "show"},
    {"inspector"},
    {"iteration"},
    {"recorded"},
    {"trainer", "training_memory", "export", "kernel_cache"},
    {"warm_up"},
    {"run_identity"},
    {"checkpoint"},
    {"run_folder"},
    {"train"},
    {"benchmark", "check", "prepare", "view"},
    {"cli"},
    {"__init__", "__main__"},
]
ORDER = {name: level for level, names in enumerate(LAYERS) for name in names}
NO_TORCH = ("priors", "data", "metrics/stability.py", "phantom", "geometry.py", "footage", "check")


def unit(path: Path) -> str:
    """First part of the module's path below the package."""
    return path.relative_to(SRC).parts[0].removesuffix(".py")


def imported_units(path: Path) -> set[str]:
    """Own units that a file imports, those for type checking only left out."""
    tree = ast.parse(path.read_text())
    skipped = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for child in ast.walk(node)
    }
    depth = len(path.relative_to(SRC).parts)
    found = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or id(node) in skipped or node.level != depth:
            continue
        names = [node.module.split(".")[0]] if node.module else [alias.name for alias in node.names]
        found |= set(names)
    return found - {unit(path)}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SRC)))
def test_imports_point_one_way(path):
    here = unit(path)
    assert here in ORDER, f"{here} has no layer: add it to LAYERS"
    for name in imported_units(path):
        assert ORDER[name] < ORDER[here], f"{here} must not import {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SRC)))
def test_files_are_short_and_say_what_they_are(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 400
    assert not text.strip() or ast.get_docstring(ast.parse(text))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SRC)))
def test_public_functions_and_classes_have_docstrings(path):
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if any("njit" in ast.unparse(decorator) for decorator in node.decorator_list):
                continue  # kernels say their contract in a comment on the first line
            assert ast.get_docstring(node), f"{path.name}: {node.name}"


@pytest.mark.parametrize("part", NO_TORCH)
def test_numpy_only_parts_do_not_import_torch(part):
    folder = SRC / part
    for path in [folder] if folder.suffix else sorted(folder.rglob("*.py")):
        modules = {
            alias.name if isinstance(node, ast.Import) else node.module or ""
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
        }
        assert not any(name.split(".")[0] == "torch" for name in modules), path


def test_no_pickle_and_no_eval_anywhere():
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names}
                if getattr(node, "module", None) in ("pickle", "dill", "joblib"):
                    assert names == {"UnpicklingError"}, path  # what torch raises on a file it refuses
                assert not names & {"pickle", "dill", "joblib"}, path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec"), path


def test_help_and_import_are_light():
    code = (
        "import sys; from endoprior.cli import main; main(['--help']);"
        "print(sorted({'torch', 'numba', 'cv2', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")
