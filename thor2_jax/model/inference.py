"""Inference: the outputs of a model for clouds, and the answers that follow from them.

>>> inference = infer(model, describe_looks(clouds, network, config))               # doctest: +SKIP
>>> answers(model, instances, inference)                                            # doctest: +SKIP

Recognition of frames and sequences, the service, explanations and evaluation all use these functions.

The instances of a frame are processed in chunks: JAX dispatches asynchronously, so that the device computes one chunk
while the host prepares the next one.
"""

import dataclasses
import itertools
import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from thor2_jax.capacity import BATCH_BUCKETS, batch_bucket, batch_points
from thor2_jax.descriptor.looks import LookDescriptors, describe_looks
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.enrollment import LOOKS
from thor2_jax.model.model import Model
from thor2_jax.model.recognition import Recognition, overflow_reason
from thor2_jax.networks.networks import EMBEDDING
from thor2_jax.surfaces.evidence import Sample, sample_points, with_evidence
from thor2_jax.surfaces.surfaces import Surfaces
from thor2_jax.types import PointClouds

__all__ = [
    "Inference",
    "answers",
    "compute_by_chunks",
    "infer",
    "infer_clouds",
    "object_scores",
    "padded_rows",
]

MIN_PART = 32
"""A chunk is padded to at least 1 / MIN_PART of its size, so that fewer sizes are compiled for large chunks."""

T = TypeVar("T")


def compute_by_chunks(
    instances: Iterable[PreparedInstance], size: int, compute: Callable[[PointClouds], T]
) -> tuple[list[PreparedInstance], T]:
    """Prepare instances and apply a function to the usable ones in chunks.

    Args:
        instances: an iterator that prepares the instances one by one.
        size: number of usable instances in a chunk.
        compute: function from the clouds of a chunk, padded to `padded_rows`, to arrays [B, ...] as a pytree; it is
            called at least once.

    Returns:
        All instances, and the arrays of the usable ones on the host, padded with zeros to whole batch buckets.
    """
    prepared: list[PreparedInstance] = []

    def usable() -> Iterator[PreparedInstance]:
        for instance in instances:
            prepared.append(instance)
            if instance.reason is None:
                yield instance

    remaining, results, counts = usable(), list[T](), list[int]()
    while (chunk := list(itertools.islice(remaining, size))) or not results:
        capacity = batch_points(len(instance.points) for instance in chunk) if size > MIN_PART else None
        results.append(compute(pack_instances(chunk, padded_rows(len(chunk), size), capacity)))
        counts.append(len(chunk))
    n_padding = padded_rows(sum(counts), size) - sum(counts)

    def concatenate(*arrays: jax.Array) -> NDArray[Any]:
        rows = [np.asarray(array)[:count] for array, count in zip(arrays, counts, strict=True)]
        return np.concatenate([*rows, np.zeros((n_padding, *rows[0].shape[1:]), rows[0].dtype)])

    return prepared, jax.tree.map(concatenate, *results)


def padded_rows(n: int, size: int) -> int:
    """Return the padded number of rows for `n` instances in chunks of `size`: whole largest batches, then a bucket.

    The result is at least `size` / `MIN_PART`, or the largest bucket if that is smaller, and at least 1.
    """
    whole = n // BATCH_BUCKETS[-1] * BATCH_BUCKETS[-1]
    return n if n == whole > 0 else whole + batch_bucket(max(n - whole, min(size // MIN_PART, BATCH_BUCKETS[-1]), 1))


N_TOP = 5
"""Number of most probable names of each classifier in an answer."""


class Inference(NamedTuple):
    """Outputs of a model for clouds, one row for each.

    Attributes:
        overflow: [B] int, overflow of the descriptors of the first look.
        probabilities: classifier -> class probabilities [B, C], fused over the looks; empty if the gallery alone
            answers. The embedding's probabilities sum to the probability that the object is one of the classes.
        embeddings: [B, K, D] float32, embeddings for the gallery; None if the classifiers alone answer.
        scores: [B, n_objects] scores of the gallery, which replace the embeddings after fusion over frames.
        samples: what is compared with the surfaces of enrolled objects; None without embeddings.
    """

    overflow: Any
    probabilities: Mapping[str, Any]
    embeddings: Any = None
    scores: Any = None
    samples: Sample | None = None


def infer(
    model: Model,
    oriented: LookDescriptors,
    clouds: PointClouds | None = None,
    classifiers: Sequence[str] | None = None,
    *,
    embeds: bool = False,
) -> Inference:
    """Evaluate a model on descriptors; arrays stay on the device.

    Args:
        model: the model.
        oriented: descriptors of the looks at B clouds.
        clouds: [B, N] the clouds in metres; None to leave out the comparison with surfaces.
        classifiers: classifiers to evaluate, see `Model.chosen_classifiers`; empty if the gallery alone answers.
        embeds: whether to embed the clouds, if they are given, for the gallery.
    """
    names = model.chosen_classifiers() if classifiers is None else classifiers
    probabilities = {name: model.classifiers[name](oriented) for name in names}
    surfaces = model.run.surfaces if EMBEDDING in probabilities else None
    samples = None if clouds is None or not (embeds or surfaces) else sample_points(clouds)
    if surfaces is not None and samples is not None:
        probabilities[EMBEDDING] = _with_evidence_in_threads(probabilities[EMBEDDING], surfaces, samples)
    if clouds is None or not embeds:
        return Inference(oriented.overflow, probabilities)
    embedding, run = model.embedding, model.run
    # Neither the homology nor the number of looks changes a look.
    config = dataclasses.replace(embedding.config, homology=run.config.homology, looks=run.config.looks)
    if run.network == embedding.network and run.config == config and oriented.shape[1] >= LOOKS:
        looks = jax.tree.map(lambda a: a[:, :LOOKS], oriented)
    else:
        looks = describe_looks(clouds, embedding.network, embedding.config, LOOKS)
    return Inference(oriented.overflow, probabilities, embedding.embed_oriented(looks, clouds), samples=samples)


def _with_evidence_in_threads(probabilities: jax.Array, surfaces: Surfaces, samples: Sample) -> jax.Array:
    """Return `with_evidence`, computed in threads on CPUs, where XLA computes the calls of a thread one by one."""
    is_traced = any(isinstance(a, jax.core.Tracer) for a in jax.tree.leaves((probabilities, surfaces, samples)))
    if jax.default_backend() != "cpu" or is_traced or not len(probabilities):
        return with_evidence(probabilities, surfaces, samples)
    n_rows, n_cores = len(probabilities), os.cpu_count() or 1
    size = n_rows // math.gcd(n_rows, 1 << (n_cores - 1).bit_length())
    parts = dict[int, jax.Array]()

    def compute(first: int) -> None:
        parts[first] = with_evidence(probabilities, surfaces, samples, first, size)

    starts = range(0, n_rows, size)
    # An executor would refuse calls while the interpreter waits for other threads at its end.
    threads = [threading.Thread(target=compute, args=(first,)) for first in starts[1:]]
    for thread in threads:
        thread.start()
    compute(0)
    for thread in threads:
        thread.join()
    return jnp.concatenate([parts[first] for first in starts])


def infer_clouds(
    model: Model, clouds: PointClouds, classifiers: Sequence[str] | None = None, answer_by: str | None = None
) -> Inference:
    """Describe clouds [B, N] in metres and evaluate a model on them; arrays stay on the device.

    Args:
        model: the model.
        clouds: the clouds.
        classifiers: classifiers to evaluate, if they answer, see `Model.chosen_classifiers`.
        answer_by: source of the answers, see `Model.answers_by`.

    Raises:
        InputError: a classifier that the run does not have.
    """
    source, config = model.answers_by(answer_by), model.run.config
    names = model.chosen_classifiers(classifiers) if source != "gallery" else ()
    # If the gallery alone answers, it needs `LOOKS` looks, which `infer` would otherwise describe again.
    count = max(config.looks, LOOKS) if source == "gallery" else config.looks
    oriented = describe_looks(clouds, model.run.network, config, count)
    return infer(model, oriented, clouds, names, embeds=source != "classifiers")


def object_scores(model: Model, inference: Inference) -> NDArray[np.float32] | None:
    """Return the scores [B, n_objects] of the enrolled objects; None if the classifiers alone answer."""
    if inference.embeddings is None:
        return inference.scores
    gallery, samples = model.gallery, inference.samples
    scores = gallery.scores(inference.embeddings)
    return gallery.with_evidence(scores, samples) if gallery.surfaces and samples is not None else scores


def answers(model: Model, instances: Sequence[PreparedInstance], inference: Inference) -> list[Recognition]:
    """Return the answer for each instance of a frame.

    Args:
        model: the model.
        instances: all instances of the frame.
        inference: outputs of the model, whose first rows belong to the usable instances in order.
    """
    n_usable = sum(instance.reason is None for instance in instances)
    inference = jax.tree.map(lambda a: np.asarray(a)[:n_usable], inference)
    names, scores = model.names, object_scores(model, inference)
    combined = model.combined(inference.probabilities, scores)
    thresholds = model.thresholds("both" if inference.probabilities else "gallery")
    by_source = {name: model.gallery.of_classifiers(p) for name, p in inference.probabilities.items()}
    if scores is not None:
        by_source["gallery"] = model.gallery.combine(None, scores)
    rows = iter(range(n_usable))
    result = []
    for instance in instances:
        if instance.reason is not None:
            result.append(Recognition(instance.label, reason=instance.reason))
            continue
        row = next(rows)
        overflow, n_points = int(inference.overflow[row]), len(instance.points)
        best = int(combined[row].argmax()) if names else -1
        confidence = float(combined[row, best]) if names else 0.0
        reason = overflow_reason(overflow, n_points)
        if reason is None and not names:
            reason = "unknown: no object is enrolled"
        elif reason is None and confidence < thresholds[best]:
            reason = f"unknown: a confidence of {confidence:.3f}, below {thresholds[best]:.3g}"
        top = {source: np.argsort(-of_all[row], kind="stable")[:N_TOP] for source, of_all in by_source.items()}
        result.append(
            Recognition(
                label=instance.label,
                name=names[best] if reason is None else None,
                confidence=confidence,
                classifier=max(by_source, key=lambda source: by_source[source][row, best]) if names else None,
                top={source: [(names[k], float(by_source[source][row, k])) for k in top[source]] for source in top},
                occluded=instance.occluded,
                overflow=overflow,
                points_used=n_points,
                kept_by_fallback=instance.kept_by_fallback,
                reason=reason,
            )
        )
    return result
