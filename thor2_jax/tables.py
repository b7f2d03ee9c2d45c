"""Values in JSON and YAML files."""

import json
import math
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.files import read_file

__all__ = ["parse_json", "parse_yaml", "read_table"]

MAX_YAML_BYTES = 2**24
MAX_YAML_VALUES = 10**6
"""Values of a YAML file after its aliases are expanded: a few lines of them can stand for gigabytes."""


def parse_json(content: bytes) -> Any:
    """Return the value in a JSON file.

    Raises:
        ValueError: if the file is damaged.
    """
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def parse_yaml(content: bytes) -> Any:
    """Return the value in a YAML file, built from plain types.

    Raises:
        ValueError: if the file is damaged, larger than `MAX_YAML_BYTES` or expands to more than `MAX_YAML_VALUES`.
    """
    import yaml

    if len(content) > MAX_YAML_BYTES:
        raise ValueError(f"it has {len(content)} bytes; expected at most {MAX_YAML_BYTES}")
    try:
        if b"<<" in content and any(
            isinstance(token, yaml.ScalarToken) and token.value == "<<" for token in yaml.scan(content)
        ):
            raise ValueError("it has a merge key (<<), which can repeat its entries without a limit")
        value = yaml.safe_load(content)
        size = _expanded_size(value, {})
    # The constructors of YAML's tags raise several kinds of exception, all of them caused by the content.
    except Exception as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from None
    if size > MAX_YAML_VALUES:
        raise ValueError(f"its aliases expand to more than {MAX_YAML_VALUES} values")
    return value


def _expanded_size(value: Any, sizes: dict[int, float]) -> float:
    """Return the number of values in `value`, counting shared ones each time they occur."""
    if not isinstance(value, (dict, list, set, tuple)):
        if isinstance(value, int):
            str(value)  # raises ValueError for thousands of digits, as JSON does; no message could show them
        return 1
    if id(value) not in sizes:
        sizes[id(value)] = math.inf  # a value that contains itself is infinite
        parts = [*value, *value.values()] if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_expanded_size(part, sizes) for part in parts)
    return sizes[id(value)]


def read_table(path: Path) -> dict[Any, Any]:
    """Read a file that holds one table: JSON if its name ends in .json, YAML otherwise.

    Raises:
        InputError: if the file is damaged or holds something else; the message names the file.
        OSError: if the file cannot be opened.
    """
    content = read_file(path)
    try:
        table = parse_json(content) if path.suffix.lower() == ".json" else parse_yaml(content)
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error})") from None
    if not isinstance(table, dict):
        raise InputError(f"{path} holds a {type(table).__name__}; expected a table")
    return table
