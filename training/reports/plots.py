"""Pictures of a training and of its results (matplotlib, PNG)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe_strips, strips
from thor2_jax.descriptor.view_normalization import align
from thor2_jax.files import atomic_write
from thor2_jax.types import PointClouds
from training.evaluate import Instance
from training.objects.mesh import TexturedMesh
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import camera_pose

__all__ = [
    "draw_accuracy",
    "draw_confusion",
    "draw_confusion_counts",
    "draw_curves",
    "draw_descriptor",
    "draw_objects",
    "save_figure",
]

_DPI = 130
_BARS = ("#56b4e9", "#e69f00", "#009e73", "#222222", "#cc79a7", "#0072b2", "#d55e00", "#f0e442")
"""Okabe and Ito's palette: told apart by all eyes."""


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG; it appears whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    FigureCanvasAgg(figure)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=_DPI, format="png")


def draw_objects(objects: Mapping[str, TexturedMesh], path: str | Path) -> None:
    """Draw every object as a training camera sees it, all at one scale, names below.

    Raises:
        OSError: the file cannot be written.
    """
    columns = min(6, len(objects))
    rows = -(-len(objects) // columns)
    figure = Figure(figsize=(1.9 * columns, 2.1 * rows), layout="constrained")
    views = {name: render_view(RayCaster([mesh]), camera_pose(0.6, 1.1, mesh.centre)) for name, mesh in objects.items()}
    half = max(max(view.depth.shape) for view in views.values()) / 2
    for axes, (name, view) in zip(figure.subplots(rows, columns, squeeze=False).flat, views.items(), strict=False):
        picture = np.where((view.depth > 0)[..., None], view.color, 255).astype(np.uint8)
        axes.imshow(picture)
        row, column = picture.shape[0] / 2, picture.shape[1] / 2
        axes.set(xlim=(column - half, column + half), ylim=(row + half, row - half))
        axes.set_title(name, fontsize=9, y=-0.12)
    for axes in figure.axes:
        axes.set_axis_off()
    save_figure(figure, path)


def draw_accuracy(
    names: Sequence[str], accuracy: Mapping[str, Sequence[float]], counts: Mapping[str, int], path: str | Path
) -> None:
    """Draw a group of bars for each part of the instances, a bar for each recognizer.

    Args:
        names: of the recognizers, at most eight.
        accuracy: part -> one value a name.
        counts: part -> number of instances.
        path: of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.add_subplot()
    width = 0.8 / len(names)
    crowded = len(names) * len(accuracy) > 16
    for k, name in enumerate(names):
        places = np.arange(len(accuracy)) + (k - (len(names) - 1) / 2) * width
        heights = [values[k] for values in accuracy.values()]
        bars = axes.bar(places, heights, width * 0.92, label=name, color=_BARS[k % len(_BARS)])
        axes.bar_label(bars, fmt="%.2f", fontsize=8, padding=2 if crowded else 1, rotation=90 if crowded else 0)
    axes.set_xticks(range(len(accuracy)), [f"{part}\n{counts[part]} instances" for part in accuracy])
    axes.set_ylim(0, 1.15 if crowded else 1.08)
    axes.set_yticks(np.arange(0, 1.01, 0.2))
    axes.set_ylabel("accuracy")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False)
    save_figure(figure, path)


def draw_confusion(instances: Sequence[Instance], classes: Sequence[str], name: str, path: str | Path) -> None:
    """Draw the confusion matrix of one joining of classifiers; counts, and the share of each row as shade.

    Args:
        instances: as `evaluate` returns them; those without an answer of that name stand in a last column "none".
        classes: order of rows and columns.
        name: of the joining, for instance "THOR2".
        path: of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    columns = [*classes, "none"]
    counts = np.zeros((len(classes), len(columns)), int)
    for instance in instances:
        if instance.truth in classes:
            answer = instance.answers.get(name, ("none",))[0]
            counts[classes.index(instance.truth), columns.index(answer)] += 1
    draw_confusion_counts(counts, classes, name, path)


def draw_confusion_counts(
    counts: NDArray[np.integer[Any]], classes: Sequence[str], name: str, path: str | Path
) -> None:
    """Draw a confusion matrix [C, C + 1]: rows the truth, columns the answers, the last one those without an answer.

    Raises:
        OSError: the file cannot be written.
    """
    columns = [*classes, "none"]
    if not counts[:, -1].any():
        columns, counts = columns[:-1], counts[:, :-1]
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = 2.2 + 0.36 * len(columns)
    figure = Figure(figsize=(side, side), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for i, j in zip(*np.nonzero(counts), strict=True):
        ink = "white" if share[i, j] > 0.5 else "black"
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=8, color=ink)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axes.set_yticks(range(len(classes)), classes, fontsize=8)
    axes.set_xlabel(f"named by {name}")
    axes.set_ylabel("truth")
    save_figure(figure, path)


def draw_curves(curves: Mapping[str, Sequence[Mapping[str, Any]]], path: str | Path) -> None:
    """Draw loss and accuracy by epoch: a colour for each classifier, a line for each of its folds.

    Args:
        curves: classifier -> records with "epoch", "loss", "accuracy"; optionally "fold", and "held_out_accuracy",
            which is dashed.
        path: of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(5.5, 5.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    dashed = False
    for k, (name, records) in enumerate(curves.items()):
        folds = sorted({record.get("fold", 0) for record in records})
        for fold in folds or [0]:
            mine = [record for record in records if record.get("fold", 0) == fold]
            style: dict[str, Any] = {"color": _BARS[k % len(_BARS)], "linewidth": 1.5 if len(folds) < 2 else 0.8}
            if len(mine) < 30:
                style |= {"marker": "o", "markersize": 3}
            epochs = [record["epoch"] for record in mine]
            label = name.upper() if fold == (folds or [0])[0] else None
            upper.plot(epochs, [record["loss"] for record in mine], label=label, **style)
            lower.plot(epochs, [record["accuracy"] for record in mine], **style)
            held_out = [record.get("held_out_accuracy") for record in mine]
            if held_out and None not in held_out:
                lower.plot(epochs, held_out, linestyle="--", **style)
                dashed = True
    upper.set_yscale("log")
    upper.set_ylabel("loss (cross-entropy)")
    lower.set_ylabel("accuracy" if dashed else "accuracy, with dropout")
    lower.set_xlabel("epoch")
    if dashed:
        lower.plot([], [], color="#888888", label="in training, with dropout")
        lower.plot([], [], color="#888888", linestyle="--", label="views held out")
        lower.legend(frameon=False)
    upper.legend(frameon=False)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def draw_descriptor(
    xyz: NDArray[np.floating[Any]],
    rgb: NDArray[np.uint8],
    network: ColorNetwork,
    config: DescriptorConfig,
    name: str,
    path: str | Path,
) -> None:
    """Draw a cloud from the side with its slices, and each slice's persistence image and colour strips.

    Args:
        xyz: [n, 3] metres, camera frame, n > 0.
        rgb: [n, 3] uint8.
        network: colour regions; strips are painted in their regions' mean colours.
        config: the descriptor.
        name: for the title.
        path: of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    aligned = align(PointClouds.pack([(xyz, rgb)]), config)
    found = strips(aligned, network, config)
    images = np.asarray(describe_strips(found, network, config).images[0])
    color = np.asarray(jax.device_get(found.color)[0])
    mask = np.asarray(aligned.mask[0])
    points, colors = np.asarray(aligned.points[0])[mask], np.asarray(aligned.colors[0])[mask]
    used = max(1, int(np.flatnonzero(color.sum(axis=(1, 2)) > 0).max(initial=-1)) + 1)
    window = (-config.sigma_2, config.window) * 2

    figure = Figure(figsize=(1.9 * (used + 2.2), 6.2), layout="constrained")
    grid = figure.add_gridspec(2, used + 1, width_ratios=[2.2, *[1] * used], height_ratios=[1.2, 1])
    side = figure.add_subplot(grid[:, 0])
    side.scatter(points[:, 0], points[:, 2], c=colors, s=3)
    for i in range(used + 1):
        side.axhline(i * config.sigma_1, color="#888888", linewidth=0.7)
    side.set_aspect("equal")
    side.set_xlabel("x (scaled units)")
    side.set_ylabel("z: slices")
    side.set_title(f"{name}: {len(points)} points", fontsize=10)
    top = images[:used].max() or 1.0
    for i in range(used):
        shape = figure.add_subplot(grid[0, i + 1])
        shape.imshow(images[i].T, origin="lower", extent=window, cmap="magma", vmin=0, vmax=top)
        shape.set_title(f"slice {i}", fontsize=10)
        strip = figure.add_subplot(grid[1, i + 1])
        low = np.zeros(color.shape[1])
        for r in np.argsort(-color[i].sum(axis=0)):
            if color[i, :, r].any():
                heights = color[i, :, r]
                strip.bar(np.arange(len(low)), heights, 1.0, bottom=low, color=network.mean_rgb[r] / 255)
                low += heights
        strip.set_xlim(-0.5, len(low) - 0.5)
        strip.set_ylim(0, max(1.0, float(color.sum(axis=2).max())))
        strip.set_xlabel("strip", fontsize=9)
        shape.set_xlabel("birth", fontsize=9)
        if i == 0:
            shape.set_ylabel("persistence", fontsize=9)
            strip.set_ylabel("points by colour region", fontsize=9)
        else:
            shape.set_yticklabels([])
            strip.set_yticklabels([])
    save_figure(figure, path)
