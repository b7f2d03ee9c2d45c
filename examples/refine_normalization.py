"""Refine the view normalization of occluded clouds by gradient descent on the difference to a stored descriptor.

The relaxed descriptor of a clean view of each built-in object is stored. Then the far end of the view is occluded and
noise is added to depth and colour, so that the minimal box of the rest gives another frame. Gradient descent finds a
small rotation and a shift of the normalized cloud that reduce the difference to the stored descriptor. Only columns
whose strips lie completely before the occluded end are compared (the paper's object unity, strip by strip):
`python examples/refine_normalization.py [--out DIRECTORY] [--seed N]`.
"""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.scipy.linalg import expm
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import colornet
import thor2_jax as thor2
from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import camera_pose
from training.views.mesh_views import view_cloud

HARD = thor2.DescriptorConfig(homology="closed_form")
SOFT = dataclasses.replace(HARD, relaxation=thor2.Relaxation(slice=0.02, strip=0.01, extremum=0.01, color=10.0))
"""Temperatures above the default; at low ones the loss is almost a step function, and the descent gets stuck."""

N_POINTS = 1024
"""Largest number of points of a clean view."""

HIDDEN = 0.1, 0.3
"""Smallest and largest occluded fraction of the points of a view."""

TILT = np.radians(20)
"""Largest angle between the edge of the occluder and the normal of the object's long side, radians."""

EDGE = 0.004
"""Points within this distance of the edge, in the image at unit distance, are marked as occlusion boundary."""

DEPTH_NOISE, COLOR_NOISE = 0.002, 5.0
"""Standard deviations of the depth along the ray, metres, and of colour levels."""

STEPS, RATE = 100, 0.01
"""Number of steps and learning rate of Adam, with a cosine decay; a fifth of the rate is used for the shift."""

PRIOR = 0.1
"""Weight of the squared rotation, which keeps the frame close to that of the box if few columns can be compared."""

ANOTHER_BOX = 45.0
"""Error in degrees beyond which the sides of the box are interchanged, which gradient descent cannot correct."""


class Motion(NamedTuple):
    """The optimized rotation and shift of each cloud; the shift along y stays 0, since it changes no descriptor.

    Attributes:
        rotation: [B, 3] rotation vectors about the centres of the clouds, radians.
        shift: [B, 3] scaled units.
    """

    rotation: jax.Array
    shift: jax.Array


class Columns(NamedTuple):
    """Masks of the compared columns of each slice: `images` [B, S, P] and `embeddings` [B, S, J], bool."""

    images: jax.Array
    embeddings: jax.Array


def occlude(clean: tuple[np.ndarray, np.ndarray], far: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return the noisy cloud (xyz, rgb) without its end in the direction `far`, and a mask of its edge points."""
    xyz, rgb = clean
    angle = rng.uniform(-TILT, TILT)
    direction = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ far[:2]
    along = xyz[:, :2] / xyz[:, 2:] @ direction / np.linalg.norm(direction)
    cut = np.quantile(along, 1 - rng.uniform(*HIDDEN))
    seen = along < cut
    xyz, rgb, along = xyz[seen], rgb[seen], along[seen]
    xyz = xyz * (1 + rng.normal(0, DEPTH_NOISE, (len(xyz), 1)) / np.linalg.norm(xyz, axis=1, keepdims=True))
    rgb = (rgb + rng.normal(0, COLOR_NOISE, rgb.shape)).clip(0, 255).astype(np.uint8)
    return xyz.astype(np.float32), rgb, along > cut - EDGE


def frames(clouds: thor2.PointClouds, turned: thor2.PointClouds) -> list[Rotation]:
    """Return the rotation from each cloud to its rotated copy."""
    rotations = []
    for before, after, mask in zip(*map(np.asarray, (clouds.points, turned.points, clouds.mask)), strict=True):
        before, after = before[mask], after[mask]
        rotations.append(Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))[0])
    return rotations


def moved(normal: thor2.PointClouds, motion: Motion) -> thor2.PointClouds:
    """Rotate, align and shift normalized clouds."""
    inside = normal.mask[..., None]
    middle = (normal.points * inside).sum(axis=1, keepdims=True) / inside.sum(axis=1, keepdims=True)
    x, y, z = motion.rotation.T
    zero = jnp.zeros_like(x)
    matrix = expm(jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1))
    points = jnp.einsum("bij,bnj->bni", matrix, normal.points - middle, precision=jax.lax.Precision.HIGHEST) + middle
    aligned = thor2.turn(dataclasses.replace(normal, points=jnp.where(inside, points, 0)), HARD)
    return dataclasses.replace(aligned, points=jnp.where(inside, aligned.points + motion.shift[:, None], 0))


def before_cut(aligned: thor2.PointClouds) -> Columns:
    """Return the columns of the strips that end before the first boundary point along the object's long side."""
    c, s = np.cos(HARD.alpha), np.sin(HARD.alpha)
    along = c * aligned.points[..., 0] + s * aligned.points[..., 2]
    cut = jnp.where(aligned.boundary, along, jnp.inf).min(axis=1)
    ends_x, ends_z = (jnp.arange(1, n + 1) for n in (HARD.n_strips, HARD.n_slices))
    whole = c * HARD.sigma_2 * ends_x + s * HARD.sigma_1 * ends_z[:, None] <= cut[:, None, None]
    # The birth of strip j is at the border of pixels j and j + 1, and its Gaussian extends one pixel further.
    return Columns(images=jnp.pad(whole[..., 1:], ((0, 0), (0, 0), (0, 2))), embeddings=whole)


def difference(descriptors: thor2.Descriptors, stored: thor2.Descriptors, columns: Columns) -> jax.Array:
    """Return the squared differences [B] over the columns, relative to the stored images and embeddings."""
    total = jnp.zeros(len(descriptors.overflow))
    for name, counted in columns._asdict().items():
        one, other = getattr(descriptors, name), getattr(stored, name)
        square = (jnp.square(one - other) * counted[:, :, None]).sum(axis=(1, 2, 3))
        total += square / jnp.square(other).sum(axis=(1, 2, 3))
    return total


def main() -> None:
    """Refine the frames of all views, print the differences and draw a picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("refine-normalization"))
    parser.add_argument("--seed", type=int, default=0, help="seed for views, occluders and noise")
    options = parser.parse_args()
    if options.seed < 0:
        parser.error(f"--seed is {options.seed}; expected at least 0")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out is {options.out}, which cannot be created ({error.strerror}); choose another directory")
    start = time.perf_counter()
    network, rng = colornet.load_default(), np.random.default_rng(options.seed)

    objects = builtin_objects()
    views = []
    for mesh in objects.values():
        xyz, rgb = view_cloud(mesh, camera_pose(rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 1.6), mesh.centre))
        some = rng.permutation(len(xyz))[:N_POINTS]
        views.append((xyz[some], rgb[some]))
    clean = thor2.PointClouds.pack(views, N_POINTS)
    clean_normal = thor2.view_normalize(clean, HARD)
    far = [frame.inv().apply([1.0, 0.0, 0.0]) for frame in frames(clean, clean_normal)]
    occluded = [occlude(view, direction, rng) for view, direction in zip(views, far, strict=True)]
    edges = [edge for *_, edge in occluded]
    seen = thor2.PointClouds.pack([(xyz, rgb) for xyz, rgb, _ in occluded], N_POINTS, boundary=edges)

    normal = thor2.view_normalize(seen, HARD)
    aligned = thor2.turn(clean_normal, HARD)
    soft, hard = (thor2.describe_aligned(aligned, network, config) for config in (SOFT, HARD))
    nothing = Motion(jnp.zeros((len(objects), 3)), jnp.zeros((len(objects), 3)))
    columns = before_cut(moved(normal, nothing))

    def differences(motion: Motion, config: thor2.DescriptorConfig, stored: thor2.Descriptors) -> jax.Array:
        return difference(thor2.describe_aligned(moved(normal, motion), network, config), stored, columns)

    @jax.jit
    @jax.grad
    def descend(motion: Motion) -> jax.Array:
        return differences(motion, SOFT, soft).sum() + PRIOR * jnp.square(motion.rotation).sum()

    motion = nothing
    optimizer = optax.adam(optax.cosine_decay_schedule(1.0, STEPS))
    state = optimizer.init(motion)
    for _ in range(STEPS):
        updates, state = optimizer.update(descend(motion), state)
        motion = Motion(motion.rotation + RATE * updates.rotation, motion.shift + RATE / 5 * updates.shift)

    truth = frames(clean, aligned)
    figures = {
        name: np.array([np.asarray(differences(m, config, stored)) for m in (nothing, motion)])
        for name, config, stored in (("relaxed", SOFT, soft), ("hard", HARD, hard))
    }
    figures["angle"] = np.degrees(
        [
            [(a * b.inv()).magnitude() for a, b in zip(frames(seen, moved(normal, m)), truth, strict=True)]
            for m in (nothing, motion)
        ]
    )
    compared = np.asarray(columns.embeddings).any(axis=(1, 2))
    for name in ("relaxed", "hard"):
        figures[name][:, ~compared] = np.nan
    near = np.asarray(compared & (figures["angle"][0] < ANOTHER_BOX))
    report(list(objects), figures, compared, near)
    print(f"{time.perf_counter() - start:.0f} s")
    shown = int(np.argmax(np.where(near, figures["hard"][0] - figures["hard"][1], -np.inf)))
    clouds = [jax.tree.map(lambda a: a[shown], m) for m in (aligned, moved(normal, nothing), moved(normal, motion))]
    draw(list(objects)[shown], clouds, {k: v[:, shown] for k, v in figures.items()}, figures, near, options.out)
    print(f"picture: {options.out / 'refine_normalization.png'}")


def report(names: list[str], figures: dict[str, np.ndarray], compared: np.ndarray, near: np.ndarray) -> None:
    """Print a row for each view, the medians, and how many views improve."""
    print(f"{'before > after':18}{'relaxed difference':>20}{'hard difference':>20}{'degrees off':>20}")
    for k, name in enumerate(names):
        cells = [f"{before:.3g} > {after:.3g}" for before, after in (values[:, k] for values in figures.values())]
        if not compared[k]:
            cells[:2] = "nothing to", "compare"
        print(f"{name:18}" + "".join(f"{cell:>20}" for cell in cells))
    groups = {
        "all views": np.ones(len(names), bool),
        "some columns are compared": compared,
        f"and the box is less than {ANOTHER_BOX:.0f} degrees off": near,
    }
    for title, rows in groups.items():
        print(f"{title}: {rows.sum()}")
        for name, values in figures.items():
            before, after = values[:, rows]
            better, worse = (after < before).sum(), (after > before).sum()
            median = f"{np.nanmedian(before):6.3f} > {np.nanmedian(after):6.3f}"
            print(
                f"  {name:8} median {median}   {better} better, {worse} worse, {rows.sum() - better - worse} as before"
            )


def draw(
    name: str,
    clouds: list[thor2.PointClouds],
    own: dict[str, np.ndarray],
    figures: dict[str, np.ndarray],
    near: np.ndarray,
    out: Path,
) -> None:
    """Draw one view before and after refinement over the stored view, and the differences of all views."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1, 1.1))
    stored, *others = clouds
    titles = (f"{name} in the frame of its box, {own['angle'][0]:.1f}° off", f"refined, {own['angle'][1]:.1f}° off")
    for axes, cloud, title in zip(upper.subplots(1, 2, sharex=True, sharey=True), others, titles, strict=True):
        for k, (shown, color, label) in enumerate(
            ((stored, "#aaaaaa", "stored view"), (cloud, "#d55e00", "occluded, noisy view"))
        ):
            x, y, z = np.asarray(shown.points)[np.asarray(shown.mask)].T
            axes.scatter(x, z, s=3, color=color, label=label, zorder=2 + k)
            axes.scatter(x + 0.5, y - np.median(y) + 0.15, s=3, color=color, zorder=2 + k)
        axes.set_aspect("equal")
        axes.set_title(title, fontsize=10)
        axes.text(0, -0.05, "side: x, z", fontsize=8)
        axes.text(0.5, -0.05, "from above: x, y", fontsize=8)
        axes.set_axis_off()
    upper.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, markerscale=3, frameon=False)
    units = {"relaxed": "relaxed difference", "hard": "hard difference", "angle": "degrees off the true frame"}
    for axes, (key, title) in zip(lower.subplots(1, 3), units.items(), strict=True):
        before, after = figures[key]
        axes.loglog(before[near], after[near], "o", color="#0072b2", label=f"box less than {ANOTHER_BOX:.0f}° off")
        axes.loglog(before[~near], after[~near], "x", color="#999999", label="another box, or nothing to compare")
        ends = np.array([min(*axes.get_xlim(), *axes.get_ylim()), max(*axes.get_xlim(), *axes.get_ylim())])
        axes.loglog(ends, ends, color="#222222", linewidth=0.8)
        axes.set(xlim=ends, ylim=ends, xlabel="before", ylabel="after (below the line: better)")
        axes.set_title(title, fontsize=10)
    lower.axes[2].legend(fontsize=7, loc="upper left")
    figure.savefig(out / "refine_normalization.png", dpi=120)


if __name__ == "__main__":
    main()
