"""The architecture, checked: imports point one way, files stay short, heavy libraries have one owner."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import endoprior

ROOT = Path(__file__).parents[1]
SRC = ROOT / "src" / "endoprior"
ADDED = [ROOT / "src" / name for name in ("endoprior_baselines", "endoprior_radiance", "endoprior_studies")]
"""Packages that add to the product through entry points alone."""
FILES = sorted(SRC.rglob("*.py"))
ALL_FILES = sorted({*FILES, *(path for package in ADDED for path in package.rglob("*.py"))})

FLOORS = [
    {"core", "compute"},
    {"system", "render", "priors", "footage"},
    {"data", "model"},
    {"initialization", "evaluation", "visualization", "phantom", "tool_masks"},
    {"training", "prepare", "check", "export"},
    {"view"},
    {"runs"},
    {"pipeline"},
    {"cli"},
]
"""Packages, lowest first. A package imports from layers below its own, never from its own or from above."""
FLOOR_OF = {name: level for level, names in enumerate(FLOORS) for name in names}
ROOT_FILES = {"__init__.py", "__main__.py", "py.typed"}
CHECKED_PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")})
PRIVATE_WORDS = (
    "house", "storey", "desk", "mend", "crowd", "nobody", "dear", "bump", "refuse", "refusal", "judge", "half planes",
    "row form", "lacking",
)  # fmt: skip
"""Words that this project once used in place of the field's."""
PRIVATE_NAMES_ALLOWED = {"_C", "_hub_dir", "_asdict", "_fields", "_replace"}
"""What tests may use of gsplat, of torch.hub and of named tuples."""
NO_TORCH = ("priors", "data", "evaluation/scorers/depth.py", "phantom", "core", "footage", "check")


@cache
def tree(path: Path) -> ast.Module:
    """A file's syntax tree."""
    return ast.parse(path.read_text())


@cache
def nodes(path: Path) -> list[ast.AST]:
    """Every node of a file's syntax tree."""
    return list(ast.walk(tree(path)))


def imports(path: Path, types: bool = False) -> Iterator[tuple[str, ...]]:
    """Own modules that a file imports, as paths below the package; those for type checking only if `types` says so."""
    skipped = {
        id(child)
        for node in nodes(path)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for child in ast.walk(node)
    }
    parts = path.relative_to(SRC).parts
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and node.level and (types or id(node) not in skipped):
            base = parts[: len(parts) - node.level]
            if node.module:
                yield *base, *node.module.split(".")
            else:
                yield from ((*base, alias.name) for alias in node.names)


def test_the_root_holds_packages_only():
    assert {path.name for path in SRC.iterdir() if path.is_file()} <= ROOT_FILES
    packages = {path.name for path in SRC.iterdir() if any(path.glob("*.py"))}
    assert packages == FLOOR_OF.keys()


def test_imports_point_down():
    for path in FILES:
        here = path.relative_to(SRC).parts[0]
        if here not in FLOOR_OF:
            continue
        for target in imports(path):
            assert target[0] == here or FLOOR_OF[target[0]] < FLOOR_OF[here], f"{path} must not import {target[0]}"


def test_the_product_knows_nothing_of_what_is_added_to_it():
    for package in ADDED:
        others = sorted(path for other in ADDED if other != package for path in other.rglob("*.py"))
        assert not [path for path in FILES + others if package.name in path.read_text()]


def test_a_method_of_another_package_needs_public_names_only():
    """What the radiance fields import, docs/add_a_method.md or docs/api.md name, as it does for anybody's package."""
    public = set(endoprior.__all__)
    for page in ("add_a_method", "plugins", "api"):
        public |= set(re.findall(r"endoprior(?:\.\w+)+", (ROOT / "docs" / f"{page}.md").read_text()))
    for path in sorted(ADDED[1].glob("*.py")):
        for node in nodes(path):
            assert not isinstance(node, ast.Import) or "endoprior" not in ast.unparse(node), path
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "endoprior":
                for alias in node.names:
                    name = alias.name if node.module == "endoprior" else f"{node.module}.{alias.name}"
                    assert name in public, f"{path}:{node.lineno}: {name} stands on no page for plugins"


def test_modules_of_compute_serve_several_packages():
    """What one package uses belongs into that package."""
    users: dict[str, set[str]] = {path.stem: set() for path in (SRC / "compute").glob("[!_]*.py")}
    for path in ALL_FILES:
        parts = path.relative_to(ROOT / "src").parts
        package = parts[1] if parts[0] == "endoprior" else parts[0]
        for node in nodes(path):
            module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            if found := re.search(r"\bcompute\.(\w+)", module):
                users[found[1]].add(package)
    assert {name for name, packages in users.items() if len(packages) < 2} == set()


def circles(types: bool) -> list[set[str]]:
    """The modules that import one another in circles, by circle; with imports for type checking if `types` says so."""
    names = {path.relative_to(SRC).with_suffix("").parts: path for path in FILES}
    edges = {name: {target for target in imports(path, types) if target in names} for name, path in names.items()}

    @cache
    def reached(name: tuple[str, ...]) -> set[tuple[str, ...]]:
        found, waiting = set(), [name]
        while waiting:
            new = edges[waiting.pop()] - found
            found |= new
            waiting.extend(new)
        return found

    in_circles = {name for name in names if name in reached(name)}
    groups = {frozenset(other for other in in_circles if other in reached(name) and name in reached(other))
              for name in in_circles}  # fmt: skip
    return [{".".join(name) for name in group} for group in groups]


def test_no_module_imports_itself_in_a_circle():
    assert circles(types=False) == []


def test_no_module_names_types_in_a_circle():
    """Imports for type checking make circles for readers, too."""
    assert circles(types=True) == []


def test_files_are_short_and_say_what_they_are():
    for path in ALL_FILES:
        text = path.read_text()
        assert len(text.splitlines()) <= 600, path
        assert not text.strip() or ast.get_docstring(tree(path)), path


def test_public_functions_and_classes_have_docstrings():
    for path in ALL_FILES:
        for node in tree(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                if any("njit" in ast.unparse(decorator) for decorator in node.decorator_list):
                    continue  # kernels say their contract in a comment on the first line
                assert ast.get_docstring(node), f"{path}: {node.name}"


def test_numpy_only_parts_do_not_import_torch():
    for part in NO_TORCH:
        folder = SRC / part
        for path in [folder] if folder.suffix else sorted(folder.rglob("*.py")):
            is_imported = re.search(r"^\s*(?:from|import) torch\b", path.read_text(), re.MULTILINE)
            assert path.name == "types.py" or not is_imported, path  # it names tensors in annotations


def test_pickle_is_not_imported():
    for path in ALL_FILES:
        for node in nodes(path):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {getattr(node, "module", None), *(alias.name for alias in node.names)}
                # The exception is what torch raises on a file that it rejects.
                assert not names & {"pickle", "dill", "joblib"} or "UnpicklingError" in names, path


def test_the_source_keeps_the_rules_of_pyproject():
    """Among them: no `print`, `eval` or shell, text with its encoding, nothing that one system lacks."""
    words = [sys.executable, "-m", "ruff", "check", "--quiet", "src", "bench", "faults"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_relative_paths_become_text_with_slashes():
    for path in ALL_FILES:
        used = {id(node.value) for node in nodes(path) if isinstance(node, ast.Attribute)}
        for node in nodes(path):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "relative_to":
                assert id(node) in used, f"{path}:{node.lineno}: add .as_posix() or .parts"


def test_no_test_file_imports_another():
    for path in sorted((ROOT / "tests").rglob("*.py")):
        found = re.search(r"^\s*(?:from|import) test_", path.read_text(), re.MULTILINE)
        assert not found, f"{path}: move what both need into a helper module"


def taken_names(node: ast.AST) -> Iterator[str]:
    """Names that a node takes from modules and objects other than `self`, those in `setattr(x, "name")` too."""
    if isinstance(node, ast.Attribute) and ast.unparse(node.value) != "self":
        yield node.attr
    elif isinstance(node, ast.Import | ast.ImportFrom):
        for name in (getattr(node, "module", None) or "", *(alias.name for alias in node.names)):
            yield from name.split(".")
    elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("getattr", "setattr", "delattr")):
        for argument in node.args:
            if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                yield from argument.value.split(".")


def test_tests_use_public_names_only():
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in nodes(path):
            for name in set(taken_names(node)) - PRIVATE_NAMES_ALLOWED:
                is_private = name.startswith("_") and not name.startswith("__")
                assert not is_private, f"{path}:{node.lineno}: {name} is private: test what is public"


def test_lines_of_pages_are_at_most_100_characters_long():
    """Tables, code and the targets of links do not count."""
    for page in CHECKED_PAGES:
        is_code = False
        for number, line in enumerate(page.read_text().splitlines(), 1):
            is_code ^= line.startswith("```")
            if not is_code and not line.startswith(("|", "    ", "```")):
                length = len(re.sub(r"\]\([^)]*\)|https?://\S+", "", line))
                assert length <= 100, f"{page.name}:{number}: expected at most 100 characters, got {length}"


def test_the_source_has_no_private_vocabulary():
    words = "|".join(PRIVATE_WORDS).replace(" ", "[ _]")
    pattern = re.compile(rf"(?<![a-z])(?:{words})(?:s|ed|ing)?(?![a-z])", re.IGNORECASE)
    for path in sorted((ROOT / "src").rglob("*")):
        if path.suffix in (".py", ".js", ".html", ".css"):
            for number, line in enumerate(path.read_text().splitlines(), 1):
                assert not (word := pattern.search(line)), f"{path}:{number}: say {word[0]!r} in the field's words"


def test_help_and_import_are_light():
    code = (
        "import sys; from endoprior.cli import main; main(['--help']);"
        "print(sorted({'torch', 'numba', 'cv2', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")
