"""Draw the pictures of docs/explanation: python docs/hooks/draw_pictures.py [FRAMES] (two minutes).

The results are committed. They are rendered from the built-in objects. With FRAMES, a directory with the frames `REAL`
of YCB-Video and PoseCNN, only the pictures of real failures are drawn.
"""

import io
import sys
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import colornet
import thor2_jax as thor2
from colornet.draw import draw_similarity
from thor2_jax import plot
from thor2_jax.frames.frames import RGBDFrame
from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import camera_pose
from training.rendering.scenes import compose_scene
from training.views.mesh_views import view_cloud

OUT = Path(__file__).parents[1] / "images" / "explanation"
CONFIG = thor2.DescriptorConfig()

REAL = {
    "real-metal": ("ycbv_posecnn_demo/000004", (150, 60, 310, 330), "no depth on the shiny lid"),
    "real-near": ("ycbv_real_0000/000001", (60, 120, 500, 360), "holes on the box and at the edges"),
    "real-alike": ("ycbv_posecnn_demo/000003", (120, 210, 330, 260), "two cans with metal lids"),
    "real-thin": ("ycbv_posecnn_demo/000002", (20, 250, 420, 220), "the scissors hardly rise above the table"),
}
"""Picture -> frame, the part that is shown (left, top, width, height in pixels), and the title of its depth."""


def save(figure: plt.Figure, name: str) -> None:
    """Write a figure as a PNG with a palette, which is a third of the size."""
    stream = io.BytesIO()
    figure.savefig(stream, dpi=110)
    plt.close(figure)
    Image.open(stream).convert("RGB").quantize(128).save(OUT / f"{name}.png", optimize=True)


def draw_stages(name: str) -> None:
    """Draw the cloud of an object, its slices, and the diagram, the image and the colour matrix of one slice."""
    mesh, network = builtin_objects()[name], colornet.load_default()
    xyz, rgb = view_cloud(mesh, camera_pose(0.8, 1.2, mesh.centre))
    clouds = thor2.PointClouds.pack([(xyz, rgb)])
    aligned = thor2.align(clouds, CONFIG)
    strips = thor2.strips(aligned, network, CONFIG)
    descriptors = thor2.describe_strips(strips, network, CONFIG)
    images, color = np.asarray(descriptors.images[0]), np.asarray(strips.color[0])
    chosen = int(np.argmax(images.reshape(len(images), -1).sum(axis=1)))

    figure, axes = plt.subplots(1, 2, figsize=(8.5, 4), layout="constrained")
    plot.cloud(axes[0], xyz, rgb)
    plot.slices(axes[1], *aligned.unpack()[0], CONFIG)
    axes[0].set_title("the cloud, as the camera sees it")
    axes[1].set_title("view-normalized, with slices")
    save(figure, "slices")

    figure, axes = plt.subplots(1, 2, figsize=(8.5, 3.8), layout="constrained")
    pairs = jax.tree.map(lambda part: np.asarray(part[0]), thor2.diagrams(aligned, CONFIG))
    plot.persistence_diagram(axes[0], pairs, CONFIG)
    plot.persistence_image(axes[1], images[chosen], CONFIG, largest=images.max())
    axes[0].set_title("persistence diagrams of the slices")
    axes[1].set_title(f"persistence image of slice {chosen}")
    save(figure, "persistence")

    figure, axes = plt.subplots(1, 2, figsize=(8.5, 4.2), layout="constrained")
    plot.color_matrix(axes[0], color[chosen], network)
    plot.color_network(axes[1], network, color.sum(axis=(0, 1)))
    axes[0].set_title(f"colour matrix of slice {chosen}")
    axes[1].set_title("the regions that the object has")
    save(figure, "color")
    draw_similarity(network, OUT / "similarity.png")


def draw_failures() -> None:
    """Draw frames in which recognition fails, from rendered scenes."""
    objects, rng = builtin_objects(), np.random.default_rng(3)
    scene = compose_scene(objects, rng, n_objects=5, clutter=0.9).frame
    depth = scene.depth_m
    largest = max(np.unique(scene.label_image)[1:], key=lambda label: (scene.label_image == label).sum())
    glass = np.where(scene.label_image == largest, np.nan, depth)
    near = np.where(depth < np.quantile(depth[depth > 0], 0.35), np.nan, depth)
    thin = compose_scene(
        {name: objects[name] for name in ("screwdriver", "wooden_spoon")}, np.random.default_rng(0), n_objects=2
    ).frame
    draw_depths("glass", scene, {"as rendered": depth, "the largest object is glass: no depth": glass})
    draw_depths("near", scene, {"as rendered": depth, "closer than the sensor measures": near})
    draw_depths("thin", thin, {"few pixels across, and mixed at the edges": thin.depth_m})

    pairs = [("mug_blue", "mug_white"), ("soup_can_red", "soup_can_green")]
    figure, axes = plt.subplots(1, 4, figsize=(9, 2.8), layout="constrained")
    for ax, name in zip(axes, [name for pair in pairs for name in pair], strict=True):
        mesh = objects[name]
        plot.cloud(ax, *view_cloud(mesh, camera_pose(2.2, 1.2, mesh.centre)))
        ax.set_title(name)
        ax.set_axis_off()
    save(figure, "alike")


def draw_depths(name: str, frame: RGBDFrame, depths: dict[str, np.ndarray]) -> None:
    """Draw the colour of a frame beside depth images, in which missing depth is black."""
    figure, axes = plt.subplots(1, 1 + len(depths), figsize=(3.4 * (1 + len(depths)), 2.9), layout="constrained")
    axes[0].imshow(frame.color)
    axes[0].set_title("colour")
    for ax, (title, depth) in zip(axes[1:], depths.items(), strict=True):
        colors = plt.get_cmap("viridis_r").copy()
        colors.set_bad("black")
        ax.imshow(np.where(depth > 0, depth, np.nan), cmap=colors, vmin=0.5, vmax=1.2)
        ax.set_title(title, fontsize=9)
    for ax in axes:
        ax.set_axis_off()
    save(figure, name)


def draw_real_failures(frames: Path) -> None:
    """Draw parts of real frames, in colour and depth."""
    for name, (path, (left, top, width, height), title) in REAL.items():
        window = slice(top, top + height), slice(left, left + width)
        depth = np.asarray(Image.open(frames / path / "depth.png"))[window] / 1000
        near, far = np.quantile(depth[depth > 0], [0.02, 0.9])
        colors = plt.get_cmap("viridis_r").copy()
        colors.set_bad("black")
        figure, axes = plt.subplots(1, 2, figsize=(8.5, 4.4 * height / width + 0.3), layout="constrained")
        axes[0].imshow(
            Image.open(frames / path / "color.png").convert("RGB").crop((left, top, left + width, top + height))
        )
        axes[1].imshow(np.where(depth > 0, depth, np.nan), cmap=colors, vmin=near, vmax=far)
        for ax, text in zip(axes, ("colour", title), strict=True):
            ax.set_title(text)
            ax.set_axis_off()
        save(figure, name)


if __name__ == "__main__":
    plt.switch_backend("agg")
    OUT.mkdir(parents=True, exist_ok=True)
    if len(sys.argv) > 1:
        draw_real_failures(Path(sys.argv[1]))
    else:
        draw_stages("mug_blue")
        draw_failures()
