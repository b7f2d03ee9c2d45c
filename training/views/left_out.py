"""Views without some of the classes, to evaluate the recognition of unknown objects, or to train one run per sequence.

One run per sequence of a dataset, on the sequence's objects only, is the papers' OCID protocol.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.tables import read_table
from training.views.crops import ViewCrops
from training.views.normalized_views import NormalizedViews, SourceShard, ViewSource

__all__ = ["WithoutClasses", "sequence_sources"]


class WithoutClasses:
    """A source of views that omits some classes."""

    def __init__(self, source: ViewSource, names: Sequence[str]) -> None:
        """Omit the classes `names`, which are classes of the source."""
        self.classes = tuple(name for name in source.classes if name not in names)
        new = {source.classes.index(name): label for label, name in enumerate(self.classes)}
        self._kept = [index for index, shard in enumerate(source.shards) if shard.label in new]
        kept = (source.shards[index] for index in self._kept)
        self.shards = tuple(SourceShard(new[shard.label], shard.views) for shard in kept)
        self._source, self._names = source, sorted(set(names))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the source's digest and the omitted names."""
        return hashlib.sha256(repr((self._source.digest, self._names)).encode()).hexdigest()

    @property
    def record(self) -> Mapping[str, Any]:
        """Record of the source and the omitted classes."""
        views = sum(shard.views for shard in self.shards)
        return {**self._source.record, "digest": self.digest, "views": views, "classes_left_out": self._names}

    def read(self, index: int) -> NormalizedViews:
        """Read the views of a shard; raises what the source raises."""
        return dataclasses.replace(self._source.read(self._kept[index]), label=self.shards[index].label)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of a shard; raises what the source raises."""
        return self._source.read_crops(self._kept[index], size)


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
