"""Plots of objects and of the descriptor of a view (matplotlib, PNG)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax import plot
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe_strips, strips
from thor2_jax.descriptor.view_normalization import align
from thor2_jax.figures import name_style, plain_text, save_figure
from thor2_jax.types import PointClouds
from training.objects.mesh import TexturedMesh
from training.rendering.camera import RayCaster, camera_pose, render_view

__all__ = ["draw_descriptor", "draw_objects"]


def draw_objects(objects: Mapping[str, TexturedMesh], path: str | Path) -> None:
    """Draw every object as a training camera sees it, all at one scale, with its name below.

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
