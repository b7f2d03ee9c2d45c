"""Distractors: objects that are none of the classes of a run, and their samples in the user's cache.

Distractors are procedural objects, or meshes of other objects. They teach an embedding what is unknown; a tenth of them
is held out, so that the confidence is calibrated on unknown objects that no network was fitted on.

Their samples are kept in the user's cache: all runs use the same ones, and rendering them takes minutes. Each file
holds the samples of one record of everything that determines them, and is named by the record's digest.
"""

import contextlib
import dataclasses
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.files import json_digest
from thor2_jax.types import Cloud
from training.embedding.samples import ObjectSource, Samples, build_samples, render_clouds, samples_record
from training.storage.jobs import cache_directory, load_arrays, load_metadata, locked, save_arrays
from training.storage.workers import local_workers

__all__ = [
    "Distractors",
    "distractor_samples",
    "held_out_clouds",
    "stored_samples",
    "with_fitted_distractors",
]

ONE_HELD_OUT_OF = 10
"""One of so many distractors is held out."""


@dataclasses.dataclass(frozen=True)
class Distractors:
    """Objects that are none of the classes, and how the embedding is fitted on them and the classes.

    Attributes:
        procedural: number of procedural objects.
        meshes: name -> file of other objects.
        views: views of each distractor.
        epochs: passes over the samples.
        networks: number of networks in the embedding; docs/decisions.md says why there are several.
        workers: rendering processes; they do not affect the result.

    Raises:
        InputError: there are fewer than ten distractors.
    """

    procedural: int = 1500
    meshes: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    views: int = 8
    epochs: int = 8
    networks: int = 5
    workers: int = 1

    def __post_init__(self) -> None:
        count = self.procedural + len(self.meshes)
        if count < ONE_HELD_OUT_OF:
            raise InputError(f"distractors: there are {count} objects; expected at least {ONE_HELD_OUT_OF}; give more")

    @property
    def sources(self) -> list[ObjectSource]:
        """The meshes and the procedural objects in a random order, always the same, so that both kinds are held out."""
        mixed: list[ObjectSource] = [*self.meshes.values(), *range(self.procedural)]
        return [mixed[k] for k in np.random.default_rng(0).permutation(len(mixed))]

    def check(self, classes: Sequence[str]) -> None:
        """Raise InputError if a distractor has the name of a class."""
        shared = sorted(set(self.meshes) & set(classes))
        if shared:
            raise InputError(
                f"distractors: {shared[0]!r} is also a class; expected other objects; remove its mesh from one of the "
                "two directories"
            )

    @property
    def record(self) -> dict[str, Any]:
        """All that determines the embedding, as JSON holds it."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "workers"}
        return named | {"meshes": sorted(self.meshes)}


def distractor_samples(
    distractors: Distractors,
    directory: Path,
    network: ColorNetwork,
    config: DescriptorConfig,
    progress: Callable[[int, int], object],
) -> Samples:
    """Return the samples of all distractors: render them, unless the user's cache or a directory has their samples.

    Args:
        distractors: the distractors; labels are indices into `sources`.
        directory: directory of the training, for the samples so far: an interrupted training resumes.
        network: colour network.
        config: descriptor. Static.
        progress: called with (distractors done, number of distractors).

    Raises:
        InputError: a mesh is unreadable or visible in none of its views.
        OSError: the directory cannot be written.
    """
    sources = distractors.sources
    arguments = sources, network, config, distractors.views
    name = f"distractors-{json_digest(samples_record(*arguments))}"

    def build() -> Samples:
        return build_samples(*arguments, local_workers(distractors.workers), progress, directory=directory / name)

    samples = stored_samples(f"{name}.safetensors", build)
    progress(len(sources), len(sources))
    return samples


def with_fitted_distractors(samples: Samples, distractors: Samples, n_classes: int) -> Samples:
    """Return samples of classes, and then those of the distractors that are not held out.

    The labels of the distractors follow those of the classes without gaps.
    """
    fitted = distractors.select(np.flatnonzero(distractors.label % ONE_HELD_OUT_OF))
    label = n_classes + fitted.label - fitted.label // ONE_HELD_OUT_OF - 1
    return Samples.concatenated([samples, dataclasses.replace(fitted, label=label.astype(np.int32))])


def held_out_clouds(distractors: Distractors, first: int) -> list[tuple[int, Cloud]]:
    """Return label, from `first` on, and cloud, in metres, of each view of the distractors that are held out.

    They are rendered again: samples are strips in random orientations, without the points that the looks need.
    """
    objects = dict(list(enumerate(distractors.sources))[::ONE_HELD_OUT_OF])
    return [(first + index, cloud) for index, cloud in render_clouds(objects, distractors.views)]


MAX_FILES = 3
"""Number of files that are kept; the ones that were used last."""

FORMAT = "thor2 samples of distractors"
NAME = re.compile(r"distractors-[0-9a-f]{64}\.safetensors")

log = logging.getLogger(__name__)


def stored_samples(name: str, build: Callable[[], Samples]) -> Samples:
    """Return the samples of a file in the user's cache, if there is one, or build them and store them in it.

    A cache that cannot be used is logged as a warning.

    Args:
        name: name of the file, which has the digest of the samples' record.
        build: returns the samples.

    Raises:
        InputError: as `build`.
        OSError: as `build`.
    """
    cache = cache_directory("distractors")
    if cache is None:
        return build()
    file = cache / name
    try:
        if file.is_file():
            samples = Samples(**load_arrays(file))
            with contextlib.suppress(OSError):  # a read-only cache is used as it is
                os.utime(file)
            return samples
    except (OSError, ValueError, TypeError) as error:
        log.warning("%s cannot be used (%s)%s", file, error, "" if _is_own(file) else "; delete this file")
    samples = build()
    _store(samples, file)
    return samples


def _store(samples: Samples, file: Path) -> None:
    """Store samples unless the file is a user's, or another process is writing."""
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with locked(file.parent):
            if file.exists() and not _is_own(file):
                return
            save_arrays(file, samples.arrays(), {"format": FORMAT})
            own = [path for path in file.parent.iterdir() if _is_own(path)]
            for path in sorted(own, key=lambda path: path.stat().st_mtime, reverse=True)[MAX_FILES:]:
                path.unlink(missing_ok=True)
    except InputError:
        return  # another process is writing, usually the same file
    except OSError as error:
        log.warning("the distractors cannot be kept for the next training: %s", error)


def _is_own(path: Path) -> bool:
    """Return whether a file is one of these, also of an earlier version, and may be replaced or removed."""
    try:
        return bool(NAME.fullmatch(path.name)) and load_metadata(path)["format"].startswith(FORMAT)
    except (ValueError, KeyError, AttributeError):
        return False
