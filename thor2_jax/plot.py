"""Plots on matplotlib axes: clouds, slices, persistence, colour, the colour network and measured accuracy.

Every function draws on given axes `ax`, which may be part of any figure:

>>> figure, ax = plt.subplots()                                                    # doctest: +SKIP
>>> aligned = thor2.align(clouds, config)                                          # doctest: +SKIP
>>> thor2.plot.slices(ax, *aligned.unpack()[0], config)                            # doctest: +SKIP

Lengths keep their unit: metres for clouds in the camera frame, scaled units for aligned clouds.
"""

import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from numpy.typing import ArrayLike, NDArray

from colornet import ColorNetwork
from colornet.draw import plot_network
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError, as_array
from thor2_jax.figures import name_style, plain_text
from thor2_jax.types import Diagrams, check_types

__all__ = [
    "PALETTE",
    "attribution_colors",
    "cloud",
    "color_matrix",
    "color_network",
    "color_vectors",
    "confusion",
    "persistence_diagram",
    "persistence_image",
    "reliability",
    "slices",
]

PALETTE = ("#56b4e9", "#e69f00", "#009e73", "#222222", "#cc79a7", "#0072b2", "#d55e00", "#f0e442")
"""The palette of Okabe and Ito, which people with colour blindness can distinguish."""

_DIVERGING = LinearSegmentedColormap.from_list("attribution", ["#0a4f8f", "#7fb2dd", "#d9d9d9", "#f2a36b", "#b83a00"])
"""Blue for negative, grey for zero, orange for positive values."""


def attribution_colors(values: ArrayLike) -> ScalarMappable:
    """Return the colours of attributions: orange for positive values, blue for negative ones, grey for zero.

    The scale is symmetric and ends at the 98th percentile of the absolute values, so that a few extreme points do not
    make all others grey.

    Args:
        values: any shape.

    Returns:
        A mappable: `to_rgba(values)` gives colours, and `figure.colorbar` accepts it.
    """
    magnitudes = np.abs(_as_numbers("values", values).astype(float)).ravel()
    end = float(np.percentile(magnitudes, 98)) if len(magnitudes) else 0.0
    end = end or float(magnitudes.max(initial=0)) or 1.0
    return ScalarMappable(Normalize(-end, end), _DIVERGING)


def _as_numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return an array of real numbers; texts, rows of different lengths, masked values and others raise InputError."""
    try:
        np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {reprlib.repr(values)}; expected an array of numbers") from None
    return as_array(values, name, "an array of numbers")


def _check_points(points: ArrayLike, colors: ArrayLike) -> tuple[NDArray[Any], NDArray[np.float64]]:
    xyz, rgb = _as_numbers("points", points), _as_numbers("colors", colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError(f"points is {list(xyz.shape)}; expected [n, 3], for example a cloud of PointClouds.unpack")
    if rgb.shape != xyz.shape:
        raise InputError(f"colors is {list(rgb.shape)}; expected {list(xyz.shape)}, the shape of points")
    if rgb.dtype != np.uint8 and not np.issubdtype(rgb.dtype, np.floating):
        raise InputError(f"colors is {rgb.dtype}; expected uint8, or floating in [0, 1]")
    return xyz, np.clip(rgb / 255 if rgb.dtype == np.uint8 else rgb, 0, 1)


def _scatter(
    ax: Axes,
    places: NDArray[Any],
    nearness: NDArray[Any],
    colors: NDArray[np.float64],
    values: ArrayLike | None,
    scale: ScalarMappable | None,
    size: float,
) -> PathCollection:
    """Draw points [n, 2], near ones over far ones; with values, large values over small ones and in larger dots."""
    if values is None:
        ax.set_facecolor("#e4e4e4")  # White points must be visible.
        order, areas = np.argsort(nearness, kind="stable"), np.full(len(places), size)
    else:
        given = _as_numbers("values", values).astype(float)
        if given.shape != (len(colors),):
            raise InputError(f"values is {list(given.shape)}; expected [{len(colors)}], one value for each point")
        colors, magnitude = (scale or attribution_colors(given)).to_rgba(given), np.abs(given)
        order = np.argsort(magnitude, kind="stable")
        areas = size * (1 + 2 * np.clip(magnitude / attribution_colors(magnitude).norm.vmax, 0, 1))
    x, y = places[order].T
    return ax.scatter(x, y, c=colors[order], s=areas[order], linewidths=0)


def cloud(
    ax: Axes,
    points: ArrayLike,
    colors: ArrayLike,
    values: ArrayLike | None = None,
    *,
    scale: ScalarMappable | None = None,
    size: float = 4.0,
) -> PathCollection:
    """Draw a cloud as the camera sees it: x to the right, y down, near points over far ones.

    Args:
        ax: matplotlib axes.
        points: [n, 3] metres, camera frame.
        colors: [n, 3] sRGB, uint8 or floating in [0, 1].
        values: [n] numbers that are drawn instead of the colours, such as attributions; large values cover small ones.
        scale: colours of the values; by default `attribution_colors(values)`.
        size: area of a point, points squared.

    Returns:
        The drawn points.

    Raises:
        InputError: the shapes do not fit, or `colors` has another type.
    """
    xyz, rgb = _check_points(points, colors)
    drawn = _scatter(ax, xyz[:, :2], -xyz[:, 2], rgb, values, scale, size)
    ax.set(aspect="equal", xlabel="x, to the right (m)", ylabel="y, down (m)")
    if not ax.yaxis_inverted():
        ax.invert_yaxis()
    return drawn


def slices(
    ax: Axes,
    points: ArrayLike,
    colors: ArrayLike,
    config: DescriptorConfig,
    values: ArrayLike | None = None,
    *,
    scale: ScalarMappable | None = None,
    strips: bool = False,
    size: float = 4.0,
) -> PathCollection:
    """Draw an aligned cloud from the side, with the borders of its slices and the numbers of the slices.

    Args:
        ax: matplotlib axes.
        points: [n, 3] scaled units, as `thor2_jax.align` returns them; slices lie along z, strips along x.
        colors: [n, 3] sRGB, uint8 or floating in [0, 1].
        config: gives the thickness of the slices and the width of the strips.
        values: see `cloud`.
        scale: see `cloud`.
        strips: draw the borders of the strips, too.
        size: area of a point, points squared.

    Returns:
        The drawn points.

    Raises:
        InputError: the shapes do not fit, or `colors` has another type.
    """
    check_types(config=config)
    xyz, rgb = _check_points(points, colors)
    drawn = _scatter(ax, xyz[:, [0, 2]], xyz[:, 1], rgb, values, scale, size)
    right, top = np.where(np.isfinite(xyz), xyz, 0)[:, [0, 2]].max(axis=0, initial=0)
    used = min(config.n_slices, int(top / config.sigma_1) + 1)
    for level in np.arange(used + 1) * config.sigma_1:
        ax.axhline(level, color="#888888", linewidth=0.7, zorder=0.5)
    if strips:
        for place in np.arange(min(config.n_strips, int(right / config.sigma_2) + 1) + 1) * config.sigma_2:
            ax.axvline(place, color="#cccccc", linewidth=0.4, zorder=0.4)
    for number in range(used):
        place = (0.01, (number + 0.5) * config.sigma_1)
        ax.text(*place, str(number), transform=ax.get_yaxis_transform(), va="center", fontsize=8, color="#555555")
    xlabel = "x (scaled units)" + (", lines between strips" if strips else "")
    ax.set(aspect="equal", xlabel=xlabel, ylabel="z (scaled units), lines between slices")
    return drawn


def persistence_diagram(ax: Axes, diagrams: Diagrams, config: DescriptorConfig) -> None:
    """Draw the persistence diagram of a slice, or the diagrams of all slices of a cloud in one colour each.

    A pair above the diagonal is a strip: its birth is its position along x, and its persistence is its width along y.

    Args:
        ax: matplotlib axes.
        diagrams: fields [J] of one slice or [S, J] of one cloud, scaled units.
        config: gives the range of the axes.

    Raises:
        InputError: the fields have more axes, for example a whole batch.
    """
    check_types(diagrams=diagrams, config=config)
    fields = [np.asarray(field) for field in (diagrams.births, diagrams.deaths, diagrams.mask)]
    if fields[0].ndim not in (1, 2):
        raise InputError(f"diagrams has births {list(fields[0].shape)}; expected [J] or [S, J], those of one cloud")
    births, deaths, mask = (np.atleast_2d(field) for field in fields)
    end = max(config.window, float(deaths[mask].max(initial=0)))
    ax.plot([0, end], [0, end], color="#888888", linewidth=0.8, linestyle="--")
    for number in np.flatnonzero(mask.any(axis=1)):
        row = mask[number]
        label = f"slice {number}" if len(mask) > 1 else None
        ax.plot(births[number, row], deaths[number, row], "o", markersize=4, label=label, color=PALETTE[number % 8])
    if len(mask) > 1 and mask.any():
        ax.legend(frameon=False, fontsize=8, loc="lower right")
    limits = (-config.sigma_2, end)
    ax.set(xlim=limits, ylim=limits, aspect="equal", xlabel="birth (scaled units)", ylabel="death (scaled units)")


def persistence_image(
    ax: Axes, image: ArrayLike, config: DescriptorConfig, *, largest: float | None = None
) -> ScalarMappable:
    """Draw the persistence image of a slice, birth to the right and persistence upwards, in scaled units.

    Args:
        ax: matplotlib axes.
        image: [P, P], axes birth and persistence, as in `Descriptors.images`.
        config: gives the range of the axes.
        largest: value of the brightest colour; by default the largest of the image.

    Returns:
        The drawn image, for a colour bar.

    Raises:
        InputError: the image has another shape.
    """
    check_types(config=config)
    values = _as_numbers("image", image)
    if values.shape != (config.image_size,) * 2:
        raise InputError(
            f"image is {list(values.shape)}; expected {[config.image_size] * 2}, one of Descriptors.images"
        )
    window = (-config.sigma_2, config.window) * 2
    top = float(values.max()) if largest is None else largest
    drawn = ax.imshow(values.T, origin="lower", extent=window, cmap="magma", vmin=0, vmax=top or 1.0)
    ax.set(xlabel="birth", ylabel="persistence")
    return drawn


def _check_matrix(matrix: ArrayLike, network: ColorNetwork) -> NDArray[np.float64]:
    check_types(network=network)
    values = _as_numbers("matrix", matrix).astype(float)
    if values.ndim != 2 or values.shape[1] != network.n_regions:
        raise InputError(f"matrix is {list(values.shape)}; expected [J, {network.n_regions}], strips by colour regions")
    return values


def color_vectors(ax: Axes, matrix: ArrayLike, network: ColorNetwork) -> None:
    """Draw the colour vectors of a slice's strips as stacked bars in the mean colours of the regions.

    Args:
        ax: matplotlib axes.
        matrix: [J, R] the colour matrix of the slice, `Strips.color` of one slice.
        network: the colour network.

    Raises:
        InputError: the matrix has another shape.
    """
    color = _check_matrix(matrix, network)
    low = np.zeros(len(color))
    for region in np.argsort(-color.sum(axis=0)):
        if color[:, region].any():
            ax.bar(np.arange(len(low)), color[:, region], 1.0, bottom=low, color=network.mean_rgb[region] / 255)
            low += color[:, region]
    ax.set(xlim=(-0.5, len(low) - 0.5), xlabel="strip", ylabel="points by colour region")


def color_matrix(
    ax: Axes,
    matrix: ArrayLike,
    network: ColorNetwork,
    *,
    regions: Sequence[int] | None = None,
    largest: float | None = None,
) -> None:
    """Draw the colour matrix C^i of a slice: strips to the right, colour regions down, in the regions' mean colours.

    The opacity of a cell shows how many points of the strip have a colour of the region: it is the square root of the
    entry divided by the largest entry.

    Args:
        ax: matplotlib axes.
        matrix: [J, R] the colour matrix of the slice, `Strips.color` of one slice.
        network: the colour network.
        regions: regions to draw; by default those with an entry.
        largest: value of an entry that is drawn opaque; by default the largest entry.

    Raises:
        InputError: the matrix has another shape, or the network lacks a region.
    """
    color = _check_matrix(matrix, network)
    rows = np.flatnonzero(color.any(axis=0)) if regions is None else _as_numbers("regions", regions).astype(int)
    if rows.ndim != 1 or not ((rows >= 0) & (rows < network.n_regions)).all():
        raise InputError(f"regions is {rows.tolist()}; expected numbers from 0 to {network.n_regions - 1}")
    top = (float(color.max(initial=0)) if largest is None else largest) or 1.0
    cells = np.zeros((len(rows), len(color), 4))
    cells[..., :3] = (network.mean_rgb[rows] / 255)[:, None]
    cells[..., 3] = np.sqrt(np.clip(color[:, rows].T / top, 0, 1))
    if len(rows):
        ax.imshow(cells, aspect="auto", interpolation="nearest")
    swatch: dict[str, Any] = {"clip_on": False, "markersize": 7, "markeredgecolor": "#888888", "markeredgewidth": 0.5}
    beside = ax.get_yaxis_transform()
    for row, region in enumerate(rows):
        ax.plot([-0.02], [row], "s", color=network.mean_rgb[region] / 255, transform=beside, **swatch)
    ax.set_yticks(range(len(rows)), [str(region) for region in rows], fontsize=7)
    ax.tick_params(axis="y", length=0, pad=12)
    ax.set(xlim=(-0.5, len(color) - 0.5), xlabel="strip", ylabel="colour region")


def color_network(ax: Axes, network: ColorNetwork, weights: ArrayLike | None = None) -> None:
    """Draw the colour network on the a*-b* plane of CIELAB, each region in its mean colour.

    Args:
        ax: matplotlib axes.
        network: the colour network.
        weights: [R] numbers of a cloud's points in each region. If given, they determine the size of the discs instead
            of the number of colours in the region, and regions without points are pale.

    Raises:
        InputError: the weights have another shape, or a value that is negative or not finite.
    """
    check_types(network=network)
    used = None if weights is None else _as_numbers("weights", weights).astype(float)
    if used is not None and (used.shape != (network.n_regions,) or not ((used >= 0) & (used < np.inf)).all()):
        raise InputError(
            f"weights is {reprlib.repr(used.tolist())} of shape {list(used.shape)}; expected [{network.n_regions}] "
            "finite numbers of points, at least 0"
        )
    plot_network(ax, network, used)


def confusion(ax: Axes, counts: ArrayLike, classes: Sequence[str]) -> None:
    """Draw a confusion matrix with its counts; the shade is the fraction of the row.

    Args:
        ax: matplotlib axes.
        counts: [C, C] or [C, C + 1] integers; rows are true classes, columns are predicted classes. An optional last
            column counts instances without an answer; it is not drawn if it is empty.
        classes: C class names.

    Raises:
        InputError: the shape does not fit the classes.
    """
    table, classes = _as_numbers("counts", counts), list(map(str, classes))
    if table.shape not in ((len(classes),) * 2, (len(classes), len(classes) + 1)):
        raise InputError(f"counts is {list(table.shape)}; expected {[len(classes)] * 2}, or one column more")
    columns = [*map(plain_text, classes), "none"][: table.shape[1]]
    if table.shape[1] > len(classes) and not table[:, -1].any():
        columns, table = columns[:-1], table[:, :-1]
    share = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for i, j in zip(*np.nonzero(table), strict=True):
        ink = "white" if share[i, j] > 0.5 else "black"
        ax.text(j, i, str(table[i, j]), ha="center", va="center", fontsize=8, color=ink)
    ax.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8, **name_style())
    ax.set_yticks(range(len(classes)), columns[: len(classes)], fontsize=8, **name_style())
    ax.set(xlabel="recognized as", ylabel="object")


def reliability(ax: Axes, bins: Mapping[str, Sequence[Any]], *, counts: Axes | None = None) -> None:
    """Draw a reliability diagram: accuracy against confidence, beside the diagonal of perfect calibration.

    Args:
        ax: matplotlib axes.
        bins: "answers" and "accuracy" of bins of equal width from 0 to 1; the accuracy of an empty bin is None.
        counts: further axes, on which the number of answers in each bin is drawn.

    Raises:
        InputError: there is no bin, or the numbers of answers and of accuracies differ.
    """
    if not 0 < len(bins.get("answers", ())) == len(bins.get("accuracy", ())):
        raise InputError(
            f"bins is {reprlib.repr(dict(bins))}; expected answers and accuracy, one number in each for every bin"
        )
    answers, accuracy = (np.array(bins[key], float) for key in ("answers", "accuracy"))  # None becomes NaN
    edges = np.linspace(0, 1, len(answers) + 1)
    ax.bar(edges[:-1], accuracy, 1 / len(answers), align="edge", color=PALETTE[0], edgecolor="white")
    ax.plot([0, 1], [0, 1], color="#222222", linewidth=1, linestyle="--", label="perfect calibration")
    ax.set(xlim=(0, 1), ylim=(0, 1), ylabel="accuracy")
    ax.legend(frameon=False, loc="upper left")
    if counts is not None:
        counts.bar(edges[:-1], answers, 1 / len(answers), align="edge", color="#888888", edgecolor="white")
        counts.set(ylabel="answers")
        counts.locator_params(axis="y", integer=True)
    (ax if counts is None else counts).set_xlabel("confidence")
    for axes in filter(None, (ax, counts)):
        axes.spines[["top", "right"]].set_visible(False)
