"""Sphinx extension: a directive that writes the reference of commands, config fields and scores from the code."""

import contextlib
import io
import os
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_args

import docstring_parser
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from endoprior.cli import descriptions, main
from endoprior.core.config import Config
from endoprior.evaluation.registry import all_scores
from endoprior.model.presets import PresetName, preset

COLUMNS = 88
CONFIG_GROUP = re.compile(r"^\S+ options:$", re.MULTILINE)
"""Heading of a group of config fields in the help of `train`."""


def help_text(command: str) -> str:
    """What `endoprior COMMAND --help-all` prints, without the fields of the config, which have a page of their own."""
    os.environ["COLUMNS"] = str(COLUMNS)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main([command, "--help-all"])
    text = printed.getvalue()
    if command == "train":
        text = text[: CONFIG_GROUP.search(text).start()]
    return "\n".join(map(str.rstrip, text.splitlines())).strip()


def commands_page() -> Iterator[str]:
    """Markdown: every command with all its options and their defaults."""
    for name, about in descriptions().items():
        yield f"## {name}\n\n`endoprior {name}`: {about}.\n\n```text\n{help_text(name)}\n```\n"


def config_fields(cls: type, values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Dotted name, docstring and value by preset of each field of a config, depth first.

    Args:
        cls: the config's class.
        values: the config of each preset by the preset's name.
    """
    about = {meta.arg_name: meta.description for meta in docstring_parser.parse_from_object(cls).params}
    for field in fields(cls):
        parts = {name: getattr(value, field.name) for name, value in values.items()}
        first = next(iter(parts.values()))
        if is_dataclass(first):
            yield from config_fields(type(first), parts, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", about.get(field.name) or "", parts


def config_page() -> Iterator[str]:
    """Markdown: a table of fields for each group of the config."""
    group = None
    for name, about, values in config_fields(Config, {name: preset(name) for name in get_args(PresetName)}):
        if name.rpartition(".")[0] != group:
            group = name.rpartition(".")[0]
            title = f"`{group}`" if group else "Top level"
            yield f"\n## {title}\n\n| field | `default` | other presets | meaning |\n|---|---|---|---|"
        own = values.pop("default")
        others = ", ".join(f"`{preset}` {_text(value)}" for preset, value in values.items() if value != own)
        meaning = " ".join(about.split()).replace("|", r"\|").replace("*", r"\*")
        yield f"| `{name}` | {_text(own)} | {others} | {meaning} |"


def scores_page() -> Iterator[str]:
    """Markdown: a table of the scores that are not printed, but those of references for tracks."""
    yield "| name | in tables | unit | meaning |\n|---|---|---|---|"
    arrows = {True: " \u2191", False: " \u2193", None: ""}
    for name, score in all_scores().items():
        if not score.in_summary and not (name.startswith("track_") and name.endswith(("_dis", "_still"))):
            unit = (score.unit + arrows[score.higher_is_better]).strip() or "-"
            yield f"| `{name}` | {score.label} | {unit} | {score.description} |"


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


class Generated(SphinxDirective):
    """Puts generated Markdown in place of itself: `{generated} commands`, `config` or `scores`."""

    required_arguments = 1
    has_content = True  # for readers of the file: where the generated text is

    def run(self) -> list[nodes.Node]:
        """The nodes of the page."""
        lines = {"commands": commands_page, "config": config_page, "scores": scores_page}[self.arguments[0]]()
        return self.parse_text_to_nodes("\n".join(lines), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("generated", Generated)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
