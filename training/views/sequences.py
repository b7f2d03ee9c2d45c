"""Training for each sequence of a dataset apart, on the objects that are in it alone (as in the papers, for OCID)."""

from pathlib import Path

from thor2_jax.errors import InputError
from training.storage.tables import read_table
from training.views.left_out import WithoutClasses
from training.views.normalized_views import ViewSource

__all__ = ["sequence_sources"]


def sequence_sources(source: ViewSource, table: Path) -> dict[str, ViewSource]:
    """The views that each sequence's training needs.

    Args:
        source: views of the objects of all sequences.
        table: JSON or YAML file, sequence -> names of its objects, as the reader of OCID takes it.

    Returns:
        Sequence -> views of its objects.

    Raises:
        InputError: the table cannot be read, is empty, has a sequence that is no relative path, or names an object of
            which there are no views.
    """
    found: dict[str, ViewSource] = {}
    for sequence, names in read_table(table).items():
        if not isinstance(sequence, str) or Path(sequence).is_absolute() or {"", ".", ".."} & set(sequence.split("/")):
            raise InputError(f"sequences: {table} has the sequence {sequence!r}; expected a relative path")
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"sequences: {table}: {sequence} is {names!r}; expected a list of names")
        missing = sorted(set(names) - set(source.classes))
        if missing:
            raise InputError(f"sequences: {table}: the views have no class {', '.join(missing)}, named by {sequence}")
        found[sequence] = WithoutClasses(source, [name for name in source.classes if name not in names])
    if not found:
        raise InputError(f"sequences: {table} has no sequence")
    return found
