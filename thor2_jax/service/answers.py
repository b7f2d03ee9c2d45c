"""From what was found to the records that are answered."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.recognition.prepared_instance import PreparedInstance
from thor2_jax.recognition.recognizer import Recognition
from thor2_jax.service.engine import Row
from thor2_jax.service.preparing import Prepared
from thor2_jax.service.schemas import Candidate, Details, ExplainedFrame, ExplainedInstance, Instance, Slice, Strip
from thor2_jax.service.settings import MAX_DETAILED

__all__ = ["explained_frame", "instance"]

MAX_POINTS = 1000
"""Points of a cloud that are shown."""


def instance(found: Recognition) -> Instance:
    """What is said of one instance."""
    top = {
        name: [Candidate(name=candidate, probability=p) for candidate, p in best] for name, best in found.top.items()
    }
    return Instance(
        label=found.label,
        name=found.name,
        confidence=found.confidence,
        classifier=found.classifier,
        top=top,
        occluded=found.occluded,
        overflow=found.overflow,
        points_used=found.points_used,
        kept_by_fallback=found.kept_by_fallback,
        unrecognized=found.reason,
    )


def explained_frame(
    prepared: Prepared,
    found: Sequence[Recognition],
    rows: Sequence[Row],
    config: DescriptorConfig,
    timings: dict[str, float],
) -> ExplainedFrame:
    """What is said of a frame's instances, and what it rests on.

    Args:
        prepared: the frame, with its label map.
        found: one an instance.
        rows: one an instance that could be used, in order.
        config: of the descriptors.
        timings: milliseconds a stage.
    """
    assert prepared.label_map is not None
    following = iter(rows)
    instances: list[ExplainedInstance] = []
    for one, recognition in zip(prepared.instances, found, strict=True):
        details = None
        if one.reason is None:
            row = next(following)
            if len(instances) < MAX_DETAILED:
                details = _details(one, row, config)
        instances.append(ExplainedInstance(**dict(instance(recognition)), details=details))
    return ExplainedFrame(instances=instances, label_map=prepared.label_map, timings=timings)


def _details(prepared: PreparedInstance, row: Row, config: DescriptorConfig) -> Details:
    aligned = row.aligned[: len(prepared.points)]
    shown = np.random.default_rng(0).permutation(len(aligned))[:MAX_POINTS]
    peak = float(row.images.max())
    images = np.rint(row.images * (255 / peak if peak > 0 else 0)).astype(int)
    return Details(
        points=aligned[shown].astype(float).round(4).tolist(),
        colors=prepared.colors[shown].tolist(),
        slice_borders=_slice_borders(aligned[:, 2], config),
        image_peak=peak,
        slices=[
            Slice(image=image.tolist(), strips=_strips(color))
            for image, color in zip(images, row.strip_colors, strict=True)
        ],
    )


def _slice_borders(z: NDArray[np.float32], config: DescriptorConfig) -> list[tuple[float, float]]:
    if config.convention == "paper":
        low = np.arange(config.n_slices) * config.sigma_1
    else:  # z is rounded, and the levels that occur are the slices
        low = (np.unique(np.rint(z / config.sigma_1))[: config.n_slices] - 0.5) * config.sigma_1
    return [(round(float(border), 4), round(float(border + config.sigma_1), 4)) for border in low]


def _strips(color: NDArray[np.float32]) -> list[Strip]:
    strips = []
    for number in np.flatnonzero(color.any(axis=1)):
        regions = np.flatnonzero(color[number])
        weights = color[number, regions].astype(float).round(3).tolist()
        strips.append(Strip(strip=int(number), regions=regions.tolist(), weights=weights))
    return strips
