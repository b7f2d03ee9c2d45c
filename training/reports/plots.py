"""Plots of objects and their descriptors, trainings and evaluations (matplotlib, PNG)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax import DescriptorConfig, PointClouds, align, describe_strips, plot, strips
from thor2_jax.figures import name_style, plain_text, save_figure
from thor2_jax.networks.networks import EMBEDDING
from thor2_jax.plot import PALETTE
from training.objects.mesh import TexturedMesh
from training.rendering.camera import RayCaster, camera_pose

__all__ = [
    "draw_accuracy",
    "draw_confusion",
    "draw_curves",
    "draw_descriptor",
    "draw_known_unknown",
    "draw_objects",
    "draw_reliability",
]


def draw_objects(objects: Mapping[str, TexturedMesh], path: str | Path) -> None:
    """Draw every object as seen by a training camera, all at the same scale, with its name below.

    Raises:
        OSError: the file cannot be written.
    """
    columns = min(6, len(objects))
    rows = -(-len(objects) // columns)
    figure = Figure(figsize=(1.9 * columns, 2.1 * rows), layout="constrained")
    views = {name: RayCaster([mesh]).render(camera_pose(0.6, 1.1, mesh.centre)) for name, mesh in objects.items()}
    half = max(max(view.depth.shape) for view in views.values()) / 2
    for axes, (name, view) in zip(figure.subplots(rows, columns, squeeze=False).flat, views.items(), strict=False):
        picture = np.where((view.depth > 0)[..., None], view.color, 255).astype(np.uint8)
        axes.imshow(picture)
        row, column = picture.shape[0] / 2, picture.shape[1] / 2
        axes.set(xlim=(column - half, column + half), ylim=(row + half, row - half))
        axes.set_title(plain_text(name), fontsize=9, y=-0.12, **name_style())
    for axes in figure.axes:
        axes.set_axis_off()
    save_figure(figure, path)


def draw_descriptor(
    xyz: NDArray[np.floating[Any]],
    rgb: NDArray[np.uint8],
    network: ColorNetwork,
    config: DescriptorConfig,
    name: str,
    path: str | Path,
) -> None:
    """Draw a cloud from the side with its slices, and each slice's persistence image and colour vectors.

    Args:
        xyz: [n, 3] metres, camera frame, n > 0.
        rgb: [n, 3] uint8.
        network: colour network; the regions are drawn in their mean colours.
        config: descriptor configuration.
        name: name of the object, for the title.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    aligned = align(PointClouds.pack([(xyz, rgb)]), config)
    cut = strips(aligned, network, config)
    images = np.asarray(describe_strips(cut, network, config).images[0])
    color = np.asarray(cut.color)[0]
    used = max(1, int(np.flatnonzero(color.sum(axis=(1, 2)) > 0).max(initial=-1)) + 1)
    most_points = max(1.0, float(color.sum(axis=2).max()))

    figure = Figure(figsize=(1.9 * (used + 2.2), 6.2), layout="constrained")
    grid = figure.add_gridspec(2, used + 1, width_ratios=[2.2, *[1] * used], height_ratios=[1.2, 1])
    side = figure.add_subplot(grid[:, 0])
    plot.slices(side, *aligned.unpack()[0], config, size=3)
    side.set_title(plain_text(f"{name}: {int(aligned.mask.sum())} points"), fontsize=10, **name_style())
    for i in range(used):
        upper, lower = figure.add_subplot(grid[0, i + 1]), figure.add_subplot(grid[1, i + 1])
        plot.persistence_image(upper, images[i], config, largest=images.max())
        upper.set_title(f"slice {i}", fontsize=10)
        plot.color_vectors(lower, color[i], network)
        lower.set_ylim(0, most_points)
        if i > 0:
            for axes in (upper, lower):
                axes.set(yticklabels=[], ylabel="")
    save_figure(figure, path)


def draw_accuracy(
    names: Sequence[str], accuracy: Mapping[str, Sequence[float]], counts: Mapping[str, int], path: str | Path
) -> None:
    """Draw a group of bars for each subset of the instances, with one bar for each recognizer.

    Args:
        names: names of the recognizers, at most eight.
        accuracy: subset -> one value for each name.
        counts: subset -> number of instances.
        path: path of the picture.

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
        bars = axes.bar(places, heights, width * 0.92, label=name, color=PALETTE[k % len(PALETTE)])
        axes.bar_label(bars, fmt="%.2f", fontsize=8, padding=2 if crowded else 1, rotation=90 if crowded else 0)
    ticks = [plain_text(f"{subset}\ninstances: {counts[subset]}") for subset in accuracy]
    axes.set_xticks(range(len(accuracy)), ticks, **name_style())
    axes.set(ylim=(0, 1.15 if crowded else 1.08), yticks=np.arange(0, 1.01, 0.2), ylabel="accuracy")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False)
    save_figure(figure, path)


def draw_confusion(counts: NDArray[np.integer[Any]], classes: Sequence[str], name: str, path: str | Path) -> None:
    """Draw a confusion matrix with counts; the shade is the fraction of the row.

    A class without instances that is not predicted either is left out: it may be one of a hundred enrolled objects.

    Args:
        counts: [C, C + 1]; rows are true classes, columns are predicted classes, and the last column counts instances
            without an answer.
        classes: class names.
        name: name of the recognizer.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    occur: list[int] = np.flatnonzero(counts.any(axis=1) | counts[:, :-1].any(axis=0)).tolist()
    counts, classes = counts[np.ix_(occur, [*occur, -1])], [classes[k] for k in occur]
    columns = len(classes) + bool(counts[:, -1].any())
    figure = Figure(figsize=(0.36 * columns, 0.36 * len(classes)))
    axes = figure.add_axes((0, 0, 1, 1))
    plot.confusion(axes, counts, classes)
    axes.set_xlabel(f"recognized by {name} as")
    save_figure(figure, path)


def draw_reliability(bins: Mapping[str, Sequence[Any]], name: str, path: str | Path) -> None:
    """Draw a reliability diagram: accuracy against confidence, and the number of answers in each bin.

    Args:
        bins: "answers" and "accuracy" of each bin of equal width; the accuracy of an empty bin is None.
        name: name of the recognizer.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(5.2, 5.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    plot.reliability(upper, bins, counts=lower)
    lower.set_xlabel(f"confidence of {name}")
    save_figure(figure, path)


def draw_known_unknown(
    curve: Mapping[str, Sequence[float]], marked: tuple[float, float], name: str, path: str | Path
) -> None:
    """Draw the fraction of unknown objects that are named against the fraction of correct answers that are kept.

    Args:
        curve: "kept" and "named".
        marked: point of the curve to emphasize.
        name: name of the recognizer.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(5.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.step(curve["kept"], curve["named"], where="pre", color=PALETTE[5])
    axes.plot([0, 1], [0, 1], color="#222222", linewidth=1, linestyle="--", label="uninformative confidence")
    kept, named = marked
    axes.plot([kept], [named], "o", color=PALETTE[6], label=f"{named:.0%} named where {kept:.0%} are kept")
    axes.set(xlim=(0, 1.01), ylim=(0, 1.02), xlabel=f"correct answers of {name} kept", ylabel="unknown objects named")
    axes.legend(frameon=False, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def draw_curves(curves: Mapping[str, Sequence[Mapping[str, Any]]], path: str | Path) -> None:
    """Draw loss and accuracy by epoch, one colour for each classifier and one line for each of its folds.

    Args:
        curves: classifier -> records with "epoch", "loss", "accuracy"; optionally "fold", and "held_out_accuracy",
            which is drawn dashed.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(5.5, 5.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    dashed = any(row.get("held_out_accuracy") is not None for rows in curves.values() for row in rows)
    for k, (name, records) in enumerate(curves.items()):
        folds = sorted({record.get("fold", 0) for record in records})
        for fold in folds:
            rows = [record for record in records if record.get("fold", 0) == fold]
            style: dict[str, Any] = {"color": PALETTE[k % len(PALETTE)], "linewidth": 1.5 if len(folds) == 1 else 0.8}
            if len(rows) < 30:
                style |= {"marker": "o", "markersize": 3}
            epochs = [record["epoch"] for record in rows]
            title = "embedding, distractors included" if name == EMBEDDING else name.upper()
            upper.plot(epochs, [record["loss"] for record in rows], label=title if fold == folds[0] else None, **style)
            lower.plot(epochs, [record["accuracy"] for record in rows], **style)
            lower.plot(epochs, [record.get("held_out_accuracy") for record in rows], linestyle="--", **style)
    upper.set(yscale="log", ylabel="loss (cross-entropy)")
    lower.set(xlabel="epoch", ylabel="accuracy" if dashed else "accuracy, with dropout")
    if dashed:
        lower.plot([], [], color="#888888", label="training, with dropout")
        lower.plot([], [], color="#888888", linestyle="--", label="held-out set")
        lower.legend(frameon=False)
    upper.legend(frameon=False)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)
