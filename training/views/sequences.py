"""Views for training one run per sequence of a dataset, on the sequence's objects only (the papers' OCID protocol)."""

from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.tables import read_table
from training.views.left_out import WithoutClasses
from training.views.normalized_views import ViewSource

__all__ = ["sequence_sources"]


def sequence_sources(source: ViewSource, table: Path) -> dict[str, ViewSource]:
    """Return the views for the training of each sequence.

    Args:
        source: views of the objects of all sequences.
        table: JSON or YAML file, sequence -> names of its objects, as for the OCID reader.

    Returns:
        Sequence -> views of its objects.

    Raises:
        InputError: The table is unreadable or empty, a sequence is not a relative path, or the source has no views of
            an object.
    """
    sources: dict[str, ViewSource] = {}
    for sequence, names in read_table(table).items():
        if not isinstance(sequence, str) or Path(sequence).is_absolute() or {"", ".", ".."} & set(sequence.split("/")):
            raise InputError(f"sequences: {table} has the sequence {sequence!r}; expected a relative path")
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"sequences: {table}: {sequence} is {names!r}; expected a list of names")
        missing = sorted(set(names) - set(source.classes))
        if missing:
            raise InputError(f"sequences: {table}: the views have no class {', '.join(missing)}, named by {sequence}")
        sources[sequence] = WithoutClasses(source, [name for name in source.classes if name not in names])
    if not sources:
        raise InputError(f"sequences: {table} has no sequence; expected a table of sequence -> object names")
    return sources
