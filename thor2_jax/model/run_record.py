"""Values that a training, or a later step such as adaptation, stores in the record of a run."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from thor2_jax.errors import InputError

__all__ = ["stored_value"]

T = TypeVar("T")


def stored_value(kind: type[T], name: str, record: Mapping[str, Any], remedy: str) -> T | None:
    """Return a dataclass instance from the record of a run; None if the record does not have it.

    Args:
        kind: the dataclass; its own checks apply.
        name: name of the value in the record.
        record: the record, as JSON holds it; the value is a mapping of field names to values.
        remedy: advice of the error message.

    Raises:
        InputError: the value is damaged.
    """
    stored = record.get(name)
    if stored is None:
        return None
    try:
        return kind(**stored)
    except TypeError:
        fields = ", ".join(field.name for field in dataclasses.fields(kind))  # type: ignore[arg-type]
        raise InputError(f"{name} is {stored!r}; expected {fields}; {remedy}") from None
