"""Distractors: objects outside the classes of a run, and their samples in the user's cache.

Distractors are procedural objects, or meshes of other objects. An embedding is fitted on them, too, so that it rejects
unknown objects. A tenth of them is held out, to calibrate the confidence on unknown objects that no network has seen.

Their samples are stored in the user's cache, since all runs use the same samples and rendering takes minutes. A file
holds the samples for one record of everything that determines them, and its name contains the digest of the record.
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
    "with_fitted_distractors",
]

ONE_HELD_OUT_OF = 10
"""One in this many distractors is held out."""


@dataclasses.dataclass(frozen=True)
class Distractors:
    """Distractors, and the settings for fitting the embedding on distractors and classes.

    Attributes:
        procedural: number of procedural objects.
        meshes: name -> file of other objects.
        views: views of each distractor.
        epochs: passes over the samples.
        networks: number of networks in the embedding; docs/decisions.md explains why there are several.
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
        """The meshes and the procedural objects in a fixed random order, so that both kinds are held out."""
        mixed: list[ObjectSource] = [*self.meshes.values(), *range(self.procedural)]
        return [mixed[k] for k in np.random.default_rng(0).permutation(len(mixed))]

    def check(self, classes: Sequence[str]) -> None:
        """Raise InputError if a distractor has the name of a class."""
        shared = sorted(set(self.meshes) & set(classes))
        if shared:
            raise InputError(
                f"distractors: {shared[0]!r} is also a class; expected other objects; remove its mesh from one of the "
                "two folders"
            )

    @property
    def record(self) -> dict[str, Any]:
        """Everything about the distractors that determines the embedding, in JSON types."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "workers"}
        return named | {"meshes": sorted(self.meshes)}


def distractor_samples(
    distractors: Distractors,
    directory: Path,
    network: ColorNetwork,
    config: DescriptorConfig,
    progress: Callable[[int, int], object],
) -> Samples:
    """Return the samples of all distractors; render them unless they are in the user's cache or in `directory`.

    A warning is logged if the cache cannot be used.

    Args:
        distractors: the distractors; labels are indices into `sources`.
        directory: directory of the training for finished samples, so that an interrupted training resumes.
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
    cache = cache_directory("distractors")
    file = None if cache is None else cache / f"{name}.safetensors"
    samples = None if file is None else _read_stored(file)
    if samples is None:
        pool = local_workers(distractors.workers)
        samples = build_samples(*arguments, pool, progress, directory=directory / name)
        if file is not None:
            _store(samples, file)
    progress(len(sources), len(sources))
    return samples


def with_fitted_distractors(samples: Samples, distractors: Samples, n_classes: int) -> Samples:
    """Return the samples of the classes, followed by the samples of the distractors that are not held out.

    The labels of the distractors follow the labels of the classes without gaps.
    """
    fitted = distractors.select(np.flatnonzero(distractors.label % ONE_HELD_OUT_OF))
    label = n_classes + fitted.label - fitted.label // ONE_HELD_OUT_OF - 1
    return Samples.concatenated([samples, dataclasses.replace(fitted, label=label.astype(np.int32))])


def held_out_clouds(distractors: Distractors, first: int) -> list[tuple[int, Cloud]]:
    """Return the label (from `first` on) and the cloud (in metres) of each view of the held-out distractors.

    The views are rendered again, since samples are strips in random orientations, and the looks need the points.
    """
    objects = dict(list(enumerate(distractors.sources))[::ONE_HELD_OUT_OF])
    return [(first + index, cloud) for index, cloud in render_clouds(objects, distractors.views)]


MAX_FILES = 3
"""Number of files that are kept: those used most recently."""

FORMAT = "thor2 samples of distractors"
NAME = re.compile(r"distractors-[0-9a-f]{64}\.safetensors")

log = logging.getLogger(__name__)


def _read_stored(file: Path) -> Samples | None:
    """Return the samples of a file in the cache; None if it does not exist or, with a warning, cannot be used."""
    try:
        if not file.is_file():
            return None
        samples = Samples(**load_arrays(file))
    except (OSError, ValueError, TypeError) as error:
        log.warning("%s cannot be used (%s)%s", file, error, "" if _is_own(file) else "; delete this file")
        return None
    with contextlib.suppress(OSError):  # the cache may be read-only
        os.utime(file)
    return samples


def _store(samples: Samples, file: Path) -> None:
    """Store samples, unless a file of the user has this name or another process is writing."""
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
        log.warning("the distractors cannot be stored for the next training: %s", error)


def _is_own(path: Path) -> bool:
    """Return whether a file holds samples of distractors (of any version) and may be replaced or removed."""
    try:
        return bool(NAME.fullmatch(path.name)) and load_metadata(path)["format"].startswith(FORMAT)
    except (ValueError, KeyError, AttributeError):
        return False
