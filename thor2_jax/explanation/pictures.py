"""Pictures of an explanation: matplotlib figures with captions, which use the plots of `thor2_jax.plot`."""

import dataclasses
import math
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from thor2_jax import plot
from thor2_jax.explanation.changes import Change
from thor2_jax.explanation.explain import Explanation, pixel_attributions
from thor2_jax.figures import name_style, plain_text
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.surfaces.surfaces import FAR

__all__ = ["ExplanationPicture", "change_text", "loss_text", "main_pictures", "pictures"]


@dataclasses.dataclass(frozen=True, eq=False)
class ExplanationPicture:
    """A picture of an explanation.

    Attributes:
        name: name of the picture's file, without ending.
        section: "decided", "surfaces", "changes", "nearest", "shape", "slices" or "network".
        title: short title.
        caption: description in full sentences.
        figure: the picture.
    """

    name: str
    section: str
    title: str
    caption: str
    figure: Figure


def _figure(width: float = 5.2, height: float = 4.4, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """Return a figure, whose size is in inches, and its axes; the other arguments are those of `subplots`.

    With 130 pixels per inch, a picture of the default size is legible on a telephone, too.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def main_pictures(explanation: Explanation, frame: RGBDFrame) -> Iterator[ExplanationPicture]:
    """Yield the most important pictures: attributions of points, surfaces, smallest changes and nearest views."""
    yield _photo(explanation, frame)
    yield _decided_cloud(explanation)
    if explanation.surfaces:
        yield _surfaces(explanation)
    if explanation.changes:
        yield _changes(explanation)
    if explanation.nearest:
        yield _nearest(explanation)


def pictures(explanation: Explanation, frame: RGBDFrame) -> Iterator[ExplanationPicture]:
    """Yield all pictures of an explanation.

    Args:
        explanation: the explanation.
        frame: the frame of the explained instance.
    """
    yield from main_pictures(explanation, frame)
    yield _slices(explanation, decided=True)
    yield _check(explanation)
    yield _slices(explanation, decided=False)
    yield _diagrams(explanation)
    for number in np.flatnonzero(explanation.described.colors.any(axis=(1, 2))):
        yield _slice(explanation, int(number))
    yield _network(explanation)


def _color_bar(figure: Figure, axes: Any, explanation: Explanation, below: bool = False) -> None:
    scale = plot.attribution_colors(explanation.attributions.values)
    place: dict[str, Any] = {"location": "bottom", "shrink": 0.6, "pad": 0.02} if below else {"shrink": 0.8}
    bar = figure.colorbar(scale, ax=axes, ticks=[scale.norm.vmin, 0, scale.norm.vmax], **place)
    bar.set_ticklabels(["against", "neutral", "for"])
    bar.set_label(plain_text(explanation.name), **name_style())


def _photo(explanation: Explanation, frame: RGBDFrame) -> ExplanationPicture:
    mask = frame.label_image == explanation.instance.label
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = 8 + max(int(np.ptp(rows)), int(np.ptp(columns))) // 6
    window = tuple(slice(max(0, int(s[0]) - margin), int(s[-1]) + margin + 1) for s in (rows, columns))
    color, painted = frame.color[window], pixel_attributions(explanation, frame)[window]
    grey = 0.55 * color.mean(axis=2, keepdims=True) / 255 + 0.35
    shown = np.repeat(grey, 3, axis=2)
    known = np.isfinite(painted)
    # Each pixel shows the value of largest magnitude around it, so that single points are visible.
    size = max(3, color.shape[1] // 60)
    high, low = (extreme(np.nan_to_num(painted), size)[known] for extreme in (maximum_filter, minimum_filter))
    colored = plot.attribution_colors(explanation.attributions.values).to_rgba(np.where(high > -low, high, low))
    shown[known] = colored[:, :3]
    wide = color.shape[1] > 1.5 * color.shape[0]
    shape = (5.4, 2, 1) if wide else (3.8, 1, 2)
    figure, (first, second) = _figure(5.2, *shape)
    first.imshow(color)
    second.imshow(shown)
    for axes, title in ((first, "the object"), (second, "what decided")):
        axes.set_title(title, fontsize=10)
        axes.contour(mask[window], [0.5], colors="#ffffff", linewidths=0.8)
        axes.set_axis_off()
    _color_bar(figure, [first, second], explanation, below=True)
    caption = (
        f"Orange pixels support {explanation.name}, blue pixels oppose it, and grey pixels have little influence. If "
        "the outline decides, few pixels are coloured: the width of a strip depends only on its outermost points."
    )
    return ExplanationPicture("photo", "decided", "What decided, on the colour image", caption, figure)


def _decided_cloud(explanation: Explanation) -> ExplanationPicture:
    figure, axes = _figure()
    instance = explanation.instance
    plot.cloud(axes, instance.points, instance.colors, explanation.attributions.values, size=_point_size(instance))
    axes.set_adjustable("datalim")  # The axes of a narrow cloud would be narrow, and their numbers overlap.
    _color_bar(figure, axes, explanation)
    caption = f"The {len(instance.points)} points of the object as the camera sees them, in the same colours."
    return ExplanationPicture("cloud", "decided", "What decided, on the points", caption, figure)


def _point_size(instance: PreparedInstance) -> float:
    return float(np.clip(16000 / max(len(instance.points), 1), 4, 25))


def _check(explanation: Explanation) -> ExplanationPicture:
    left = explanation.left_out
    used = np.isfinite(left.strips)
    rows, columns = (int(np.flatnonzero(used.any(axis=axis)).max(initial=0)) + 1 for axis in (1, 0))
    figure, panels = _figure(rows=2, sharex=True)
    titles = ("exact: loss of the answer without the strip", "predicted: sum of the attributions in the strip")
    for axes, values, title in zip(panels, (left.strips, left.predicted), titles, strict=True):
        shown = values[:rows, :columns]
        scale = plot.attribution_colors(shown[np.isfinite(shown)])
        axes.imshow(np.ma.masked_invalid(shown), origin="lower", aspect="auto", cmap=scale.cmap, norm=scale.norm)
        figure.colorbar(scale, ax=axes)
        axes.set_title(title, fontsize=10)
        axes.set(ylabel="slice", yticks=range(rows))
    axes.set_xlabel("strip")
    caption = (
        f"Above: the loss of the answer if it is computed again without the strip ({_unit(explanation)}). Below: the "
        "loss that the attributions predict."
    )
    if left.agreement is not None:
        caption += f" The rank correlation of both is {left.agreement:.2f} (1: the same order, 0: unrelated)."
    return ExplanationPicture("check", "decided", "Exact check: strips left out", caption, figure)


def _unit(explanation: Explanation) -> str:
    return "in log-odds" if explanation.scores.unit == "log-odds" else "in cosine similarity"


def loss_text(explanation: Explanation, loss: float) -> str:
    """Return a loss of the answer in words; a negative loss is a gain."""
    return f"{'gains' if loss < -0.005 else 'loses'} {abs(loss):.2f} {_unit(explanation)}"


def change_text(change: Change) -> str:
    """Return a change in words.

    >>> change_text(Change("extent", (0.9, 0.999, 1.25), 0.25, "bowl", None))
    'longest side -10 %, middle side +0 %, shortest side +25 %'
    """
    if change.kind == "color":
        return "red {:+d}, green {:+d}, blue {:+d} (of 255)".format(*map(round, change.values))
    percent = [round(100 * (factor - 1)) for factor in change.values]
    return "longest side {:+d} %, middle side {:+d} %, shortest side {:+d} %".format(*percent)


def _changes(explanation: Explanation) -> ExplanationPicture:
    titles = {"color": "other colour", "extent": "other side lengths"}
    shown = [(f"as it is:\n{explanation.name}", explanation.instance)]
    shown += [(f"{titles[change.kind]}:\n{change.answer}", change.instance) for change in explanation.changes]
    figure = _clouds(shown)
    caption = (
        "The smallest changes of the object's colour and of its side lengths that were found to make another name most "
        "probable. Each was confirmed by recognizing the changed cloud, which may still be an unknown object."
    )
    return ExplanationPicture("changes", "changes", "Smallest changes that change the answer", caption, figure)


def _surfaces(explanation: Explanation) -> ExplanationPicture:
    instance, scale = explanation.instance, ScalarMappable(Normalize(0, 1000 * FAR), "viridis_r")
    shown = []
    for fit in explanation.surfaces:
        colors = scale.to_rgba(1000 * fit.of_points.clip(max=FAR), bytes=True)[:, :3]
        shown.append((fit.name, dataclasses.replace(instance, colors=colors)))
    figure = _clouds(shown)
    figure.colorbar(scale, ax=figure.axes, location="bottom", shrink=0.6, label="distance from the surface (mm)")
    caption = (
        "The distance of each point from the surfaces of the most probable objects, in the pose that fits best. Points "
        "of another object lie off the surface, unless it has the same shape."
    )
    return ExplanationPicture("surfaces", "surfaces", "Fit to the surfaces of objects", caption, figure)


def _nearest(explanation: Explanation) -> ExplanationPicture:
    shown = [("this object", explanation.instance)]
    shown += [(f"{one.name}\n{one.similarity:.2f}", one.view) for one in explanation.nearest]
    figure = _clouds(shown, own_scales=True)
    caption = (
        "The enrolled views that the object resembles most, one for each of the most similar objects, each as its "
        "camera saw it and at its own scale. Numbers are similarities (1: equal)."
    )
    return ExplanationPicture("nearest", "nearest", "Nearest enrolled views", caption, figure)


def _clouds(shown: Sequence[tuple[str, PreparedInstance]], own_scales: bool = False) -> Figure:
    """Draw clouds with titles, in one row around their means or in rows of two at their own scales."""
    columns, height = (2, 2.9) if own_scales else (len(shown), 2.6)
    rows = math.ceil(len(shown) / columns)
    is_shared = not own_scales
    figure, grid = _figure(5.2, rows * height, rows, columns, squeeze=False, sharex=is_shared, sharey=is_shared)
    for axes, (title, instance) in zip(grid.flat, shown, strict=False):
        points = instance.points if own_scales else instance.points - instance.points.mean(axis=0)
        plot.cloud(axes, points, instance.colors, size=_point_size(instance) / 2)
        lines = [part for line in title.split("\n") for part in textwrap.wrap(line, 66 // columns)]
        axes.set_title(plain_text("\n".join(lines)), fontsize=9, **name_style())
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for axes in figure.axes[len(shown) :]:
        axes.set_visible(False)
    return figure


def _slices(explanation: Explanation, decided: bool) -> ExplanationPicture:
    figure, axes = _figure()
    instance, config = explanation.instance, explanation.config
    values = explanation.attributions.values if decided else None
    size = _point_size(instance)
    plot.slices(axes, explanation.described.points, instance.colors, config, values, strips=True, size=size)
    if decided:
        _color_bar(figure, axes, explanation)
        title = "What decided, in slices and strips"
        caption = (
            "The same points, aligned as they are for the descriptor, with slices (numbered rows) and strips (columns)."
        )
        return ExplanationPicture("slices-attributions", "decided", title, caption, figure)
    slice_mm, strip_mm = (1000 * width / config.sigma_s for width in (config.sigma_1, config.sigma_2))
    caption = (
        "The points seen from the side, after the object was rotated so that its longest side rises at 45 degrees. "
        f"Slices (numbered rows) are {slice_mm:.0f} mm thick, strips (columns) {strip_mm:.0f} mm wide. "
        f"One scaled unit is {1000 / config.sigma_s:.0f} mm."
    )
    return ExplanationPicture("slices", "shape", "The cloud in slices and strips", caption, figure)


def _diagrams(explanation: Explanation) -> ExplanationPicture:
    figure, axes = _figure()
    plot.persistence_diagram(axes, explanation.described.diagrams, explanation.config)
    caption = (
        "Persistence diagrams: one dot for each strip, in the colour of its slice. Its birth is the position of the "
        "strip; its height above the dashed line, the persistence, is the width of the object there."
    )
    return ExplanationPicture("diagrams", "shape", "Persistence diagrams", caption, figure)


def _slice(explanation: Explanation, number: int) -> ExplanationPicture:
    described, network = explanation.described, explanation.scores.network
    regions = np.flatnonzero(described.colors.any(axis=(0, 1)))
    figure, (upper, lower) = _figure(3.6, 6.6, rows=2)
    image, colors = described.images[number], described.colors[number]
    plot.persistence_image(upper, image, explanation.config, largest=float(described.images.max()))
    plot.color_matrix(lower, colors, network, regions=regions.tolist(), largest=float(described.colors.max()))
    upper.set_title(f"slice {number}: persistence image", fontsize=10)
    lower.set_title(f"slice {number}: colour matrix", fontsize=10)
    loss = float(explanation.left_out.slices[number])
    caption = f"Slice {number}. Without it, the answer {loss_text(explanation, loss)}."
    return ExplanationPicture(f"slice-{number}", "slices", f"Slice {number}", caption, figure)


def _network(explanation: Explanation) -> ExplanationPicture:
    weights: NDArray[np.float32] = explanation.described.colors.sum(axis=(0, 1))
    figure, axes = _figure(5.2, 5.0)
    plot.color_network(axes, explanation.scores.network, weights)
    order = np.argsort(-weights)[:3]
    most = ", ".join(f"{k} ({weights[k] / max(float(weights.sum()), 1e-9):.0%})" for k in order if weights[k] > 0)
    caption = (
        "The colour network: regions of similar colours, connected if they are neighbours. Discs in full colour are "
        f"regions of this object, sized by its number of points; most are in region {most}. Pale regions are unused."
    )
    return ExplanationPicture("network", "network", "The part of the colour network in use", caption, figure)
