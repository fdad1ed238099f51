"""YAML from untrusted files: plain data only, of bounded size.

A few lines of nested anchors can stand for billions of entries, and nesting can exhaust the stack.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import yaml

MOST_NODES = 100_000
"""Largest number of entries, each alias counted as often as it is used."""
MOST_NESTED = 50


class BoundedLoader(yaml.SafeLoader):
    """Safe YAML of bounded nesting and size."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One node of the text; an error if it is nested too deeply, before the parser's own stack overflows."""
        self._depth += 1
        if self._depth > MOST_NESTED:
            raise yaml.YAMLError(f"entries nested more than {MOST_NESTED} deep")
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def get_single_node(self) -> Any:
        """The whole text; an error if it has too many entries, or one name twice."""
        node = super().get_single_node()
        if node is not None and (size := _unfolded(node, {}, 0)) > MOST_NODES:
            raise yaml.YAMLError(f"{size:.0e} entries, aliases counted as often as used; at most {MOST_NODES} are read")
        return node


def load_yaml(text: str, loader: type[BoundedLoader] = BoundedLoader) -> Any:
    """The data in a YAML text.

    Raises:
        yaml.YAMLError, ValueError: not YAML, tags of objects, too deep, or too many entries.
    """
    try:
        return yaml.load(text, loader)  # a safe loader, see above
    except RecursionError:
        raise yaml.YAMLError("entries nested too deeply") from None


def _unfolded(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """Entries that a node stands for; ValueError if it contains itself or if aliases nest too deeply."""
    if id(node) in known:
        if not known[id(node)]:
            raise yaml.YAMLError("an entry that contains itself")
        return known[id(node)]
    if depth > MOST_NESTED:
        raise yaml.YAMLError(f"entries nested more than {MOST_NESTED} deep")
    known[id(node)] = 0  # not known yet
    parts = node.value if isinstance(node, yaml.CollectionNode) else []
    if isinstance(node, yaml.MappingNode):
        names = Counter(key.value for key, _ in parts if isinstance(key, yaml.ScalarNode) and key.value != "<<")
        if twice := [name for name, count in names.items() if count > 1]:
            raise yaml.YAMLError(f"the name {twice[0]!r} twice in one place")
    flat = [part for pair in parts for part in pair] if isinstance(node, yaml.MappingNode) else parts
    known[id(node)] = 1 + sum(_unfolded(part, known, depth + 1) for part in flat)
    return known[id(node)]
