"""Tables in JSON and YAML files."""

import json
import math
from pathlib import Path
from typing import Any

import yaml

from thor2_jax.errors import InputError

__all__ = ["parse_json", "parse_yaml", "read_table"]

MOST_VALUES = 10**6
"""Of a YAML file with its aliases written out: a few lines of them can stand for gigabytes."""

MOST_NESTED = 100
"""Levels of a YAML file: the time to read one grows with their square."""


def parse_json(content: bytes) -> Any:
    """What a JSON file holds.

    Raises:
        ValueError: it is damaged.
    """
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


class _Loader(yaml.SafeLoader):
    level = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.level == MOST_NESTED:
            raise ValueError(f"it is nested more than {MOST_NESTED} levels deep")
        self.level += 1
        node = super().compose_node(parent, index)
        self.level -= 1
        return node


def parse_yaml(content: bytes) -> Any:
    """What a YAML file holds, of plain types.

    Raises:
        ValueError: it is damaged, nested more than `MOST_NESTED` levels deep, or stands for more than `MOST_VALUES`.
    """
    try:
        loader = _Loader(content)
        try:
            root = loader.get_single_node()
            if root is None:
                return None
            if _values_of(root, {}) > MOST_VALUES:
                raise ValueError(f"with its aliases it holds more than {MOST_VALUES} values")
            return loader.construct_document(root)
        finally:
            loader.dispose()
    # The constructors of YAML's tags raise several kinds of exception; only the content is at work here.
    except Exception as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from None


def _values_of(node: Any, known: dict[int, float]) -> float:
    if id(node) not in known:
        known[id(node)] = math.inf  # while it is counted: a node within itself has no end
        inner = [] if isinstance(node, yaml.ScalarNode) else node.value
        pairs = [part for entry in inner for part in (entry if isinstance(entry, tuple) else (entry,))]
        known[id(node)] = 1 + sum(_values_of(part, known) for part in pairs)
    return known[id(node)]


def read_table(path: Path) -> dict[Any, Any]:
    """Read a file that holds one table: JSON if its name ends in .json, YAML otherwise.

    Raises:
        InputError: damaged, or something else than a table; names the file.
        OSError: it cannot be opened.
    """
    content = path.read_bytes()
    try:
        table = parse_json(content) if path.suffix.lower() == ".json" else parse_yaml(content)
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error})") from None
    if not isinstance(table, dict):
        raise InputError(f"{path} holds a {type(table).__name__}; expected a table")
    return table
