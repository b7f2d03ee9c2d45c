"""Figures of the colour network: the regions on the a*-b* plane, and the similarity matrix."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator
from numpy.typing import NDArray

from colornet.colors import LUMA, MEAN_WHITE, to_lab
from colornet.files import atomic_write
from colornet.network import ColorNetwork

__all__ = ["draw_network", "draw_similarity", "plot_network"]

_TEXT_COLOR = "#222222"
_EDGE_COLOR = "#8a8a8a"
_PALE_EDGE_COLOR = "#dcdcdc"
_LEGEND_STYLE: dict[str, Any] = {"loc": "upper left", "frameon": False, "alignment": "left", "title_fontsize": 11}


def draw_network(network: ColorNetwork, path: str | Path) -> None:
    """Draw the network on the a*-b* plane of CIELAB (PNG).

    Each region is a disc at its mean colour and in that colour; its area grows with the number of its colours. Edges
    are thicker if the two mean colours are closer (HyAB); edges that close the hue circle are dashed.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(9.6, 9.0))
    axes = figure.add_axes((0.08, 0.07, 0.72, 0.88))
    plot_network(axes, network)
    axes.set_title(f"Colour network: {network.n_regions} regions, {len(network.edges)} edges")
    disc: dict[str, Any] = {"linestyle": "", "marker": "o", "markerfacecolor": "white", "markeredgecolor": _TEXT_COLOR}
    counts = (100, 5_000, 20_000)
    sizes = [Line2D([], [], markersize=float(np.sqrt(_area(count))), label=f"{count:,}", **disc) for count in counts]
    figure.legend(handles=sizes, title="grid colours", labelspacing=1.6, **_LEGEND_STYLE, bbox_to_anchor=(0.815, 0.93))
    lines = [Line2D([], [], color=_EDGE_COLOR, linewidth=_width(w), label=str(w)) for w in (25, 50, 100)]
    lines.append(Line2D([], [], color=_EDGE_COLOR, linewidth=_width(50), linestyle="--", label="across the\nhue seam"))
    figure.legend(handles=lines, title="edge: HyAB", labelspacing=1.0, **_LEGEND_STYLE, bbox_to_anchor=(0.815, 0.66))
    _save(figure, path)


def plot_network(axes: Axes, network: ColorNetwork, weights: NDArray[np.float64] | None = None) -> None:
    """Draw the network on the a*-b* plane on matplotlib axes, as `draw_network` does.

    Args:
        axes: matplotlib axes.
        network: the colour network.
        weights: [R] numbers of points in each region, at least 0. If given, they determine the areas of the discs, and
            regions without points and their edges are pale.
    """
    a, b = to_lab(network.mean_rgb, MEAN_WHITE)[:, 1:].T
    used = np.ones(network.n_regions, bool) if weights is None else weights > 0
    share = None if weights is None else weights / max(float(weights.sum()), 1e-12)
    area = _area(network.member_counts) if share is None else 190 + 2500 * share
    for (i, j), weight, cyclic in zip(network.edges, network.edge_weights, network.cyclic, strict=True):
        color, style = _EDGE_COLOR if used[i] and used[j] else _PALE_EDGE_COLOR, "--" if cyclic else "-"
        line: dict[str, Any] = {"linestyle": style, "linewidth": _width(weight), "solid_capstyle": "butt"}
        axes.plot(a[[i, j]], b[[i, j]], color=color, zorder=1, **line)
    # Pale regions are opaque, so that no edge is visible through them.
    faces = np.where(used[:, None], network.mean_rgb / 255, 0.75 + 0.25 * network.mean_rgb / 255)
    outlines = [_TEXT_COLOR if one else _PALE_EDGE_COLOR for one in used]
    # Draw the smallest discs last, in front of larger discs.
    for r in np.argsort(-area):
        axes.scatter(a[r], b[r], s=area[r], color=faces[r], edgecolors=outlines[r], linewidths=0.8, zorder=2)
        text_color = _contrasting(255 * faces[r]) if used[r] else "#8a8a8a"
        label: dict[str, Any] = {"ha": "center", "va": "center", "fontweight": "bold" if used[r] else "normal"}
        axes.text(a[r], b[r], str(r), color=text_color, fontsize=9, zorder=3, **label)
    axes.set(aspect="equal", axisbelow=True, xlabel="a*  (green to red)", ylabel="b*  (blue to yellow)")
    axes.margins(0.08)
    axes.grid(color="#ececec")


def draw_similarity(network: ColorNetwork, path: str | Path) -> None:
    """Draw the similarity matrix Delta as a heat map, with the mean colours of the regions along the axes (PNG).

    Raises:
        OSError: the file cannot be written.
    """
    n = network.n_regions
    figure = Figure(figsize=(9.6, 8.8))
    axes = figure.add_axes((0.09, 0.09, 0.77, 0.84))
    # Mask the diagonal, which is ten times as large as the other entries, so that the colour scale covers these.
    off_diagonal = np.ma.masked_array(network.similarity, np.eye(n, dtype=bool) | (network.similarity == 0))
    axes.set_facecolor("#e4e4e4")
    image = axes.imshow(off_diagonal, cmap="viridis", norm=LogNorm())
    axes.set_title(f"Similarity of the {n} colour regions (diagonal, grey: 1)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(range(n))
        axis.set_label_text("region, in its mean colour")
        axis.labelpad = 9
        for label, rgb in zip(axis.get_ticklabels(), network.mean_rgb, strict=True):
            label.set(color=_contrasting(rgb), backgroundcolor=rgb / 255, fontweight="bold", fontsize=9)
    ticks = LogLocator(subs=(1, 2, 5))
    beside = figure.add_axes((0.88, 0.09, 0.03, 0.84))
    bar = figure.colorbar(image, cax=beside, ticks=ticks, format=FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.minorticks_off()
    bar.set_label("Delta = 1 / (1 + HyAB length of the cheapest path)")
    _save(figure, path)


def _area(counts: NDArray[np.int64] | int) -> NDArray[np.float64]:
    """Return the marker area in points squared; the smallest marker still holds a two-digit number."""
    return np.asarray(190 + 0.03 * np.asarray(counts, np.float64))


def _width(weight: float) -> float:
    """Return the line width in points, inversely proportional to the distance."""
    return 90 / float(weight)


def _contrasting(rgb: NDArray[np.float64]) -> str:
    """Return black or white, whichever has more contrast to a colour."""
    return "black" if rgb @ LUMA > 128 else "white"


def _save(figure: Figure, path: str | Path) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)
