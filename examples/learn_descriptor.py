"""THOR2-L: learn parameters of the descriptor together with the classifiers, and compare it with THOR2.

Gradients of the loss of both classifiers update Delta (as a similarity matrix), the variance of the persistence images
and the exponent of their weight. THOR2 is trained in the same way with these parameters fixed, on the same synthetic
views and with the same seeds and epochs. Both are evaluated on scenes that are not used in training.
`python examples/learn_descriptor.py [--out DIRECTORY]` trains on built-in objects, and

    python examples/learn_descriptor.py --meshes MESHES --names names.json --azimuth-step 20 --polar-step 15 \
        --epochs 5 --evaluate-uwis DATASET --evaluate-frames FRAMES

trains on scans. The learned parameters are saved in the config and the colour network of the run directory
DIRECTORY/thor2-l, for `thor2 recognize --model`.
"""

import argparse
import dataclasses
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

import colornet
import thor2_jax as thor2
from thor2_jax.files import check_output_directory
from thor2_jax.model.run_directory import TrainedRun, save_run
from thor2_jax.networks.networks import MLP, feature_of, input_size
from thor2_jax.recognizer import THOR2
from training.evaluation.answers import fusions
from training.evaluation.job import answer_frames
from training.evaluation.results import compute_results
from training.evaluation.runs import Run
from training.fitting.fit import FitState, scale_inputs
from training.fitting.loop import FitOptions
from training.fitting.samples import Batch, Samples, describe_batch, sample_views
from training.objects.builtin_objects import COLOR_PAIRS, SHAPE_PAIRS, builtin_objects
from training.objects.meshes import find_meshes
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrame
from training.readers.uwis import UWISOccluded
from training.rendering.scenes import compose_scene
from training.views.mesh_views import render_views
from training.views.normalized_views import MemoryViews, check_classes

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(homology="closed_form")
PAIRS = np.triu_indices(NETWORK.n_regions, 1)

RATE = 0.01
"""Initial learning rate of the descriptor's parameters (logarithms and logits), with a cosine decay."""

N_SCENES, LIGHT = 20, 0.4
"""Number of scenes of built-in objects, and largest relative change of brightness in a scene."""

LOOK_ALIKES = sorted({name for pair in COLOR_PAIRS + SHAPE_PAIRS for name in pair})
"""The built-in objects that differ from another built-in object only in colour or only in shape."""


class LearnedValues(NamedTuple):
    """The learned parameters of the descriptor, transformed to be unbounded.

    Attributes:
        similarity: logits of Delta above the diagonal.
        image_variance: logarithm of the variance.
        persistence_weight: logarithm of the exponent.
    """

    similarity: jax.Array
    image_variance: jax.Array
    persistence_weight: jax.Array

    @classmethod
    def start(cls) -> "LearnedValues":
        """Return the values of the paper."""
        delta = NETWORK.similarity[PAIRS]
        numbers = (np.log(delta / (1 - delta)), np.log(CONFIG.image_variance), np.log(CONFIG.persistence_weight))
        return cls(*(jnp.asarray(values, jnp.float32) for values in numbers))

    def parameters(self) -> thor2.Parameters:
        """Return parameters with a symmetric Delta in (0, 1) with diagonal 1, and positive other values."""
        upper = jnp.zeros((NETWORK.n_regions,) * 2).at[PAIRS].set(jax.nn.sigmoid(self.similarity))
        return dataclasses.replace(
            thor2.Parameters.of(NETWORK, CONFIG),
            similarity=upper + upper.T + jnp.eye(NETWORK.n_regions),
            image_variance=jnp.exp(self.image_variance),
            persistence_weight=jnp.exp(self.persistence_weight),
        )


def described(batch: Batch, free: LearnedValues) -> thor2.Descriptors:
    """Return the descriptors of a batch of samples."""
    return describe_batch(batch, NETWORK, CONFIG, free.parameters())


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def train_step(graphs: Any, state: FitState, batch: Batch, rates: tuple[Any, Any], key: jax.Array) -> FitState:
    """Make one step of Adam on the sum of both losses.

    The parameters are the weights of the classifiers and the learned values of the descriptor, with a rate for each.
    """

    def loss_of(weights: dict[str, Any], free: LearnedValues) -> Any:
        descriptors, loss, rest = described(batch, free), jnp.zeros(()), {}
        for name, graph in graphs:
            model = nnx.merge(graph, weights[name], state.rest[name], copy=True)
            logits = model(feature_of(descriptors, name), train=True, rngs=nnx.Rngs(dropout=key))
            loss += optax.softmax_cross_entropy_with_integer_labels(logits, batch.label).mean()
            rest[name] = nnx.state(model, nnx.Not(nnx.Param))
        return loss, rest

    gradients, rest = jax.grad(loss_of, argnums=(0, 1), has_aux=True)(*state.params)
    steps, optimizer = optax.adam(1.0).update(gradients, state.optimizer)
    params = tuple(
        jax.tree.map(lambda value, step: value + rate * step, values, part)  # noqa: B023
        for values, part, rate in zip(state.params, steps, rates, strict=True)
    )
    return FitState(params, rest, optimizer)


def train(samples: Samples, classes: tuple[str, ...], options: FitOptions, learn: bool) -> TrainedRun:
    """Train both classifiers and, with `learn`, the descriptor."""
    graphs: list[Any] = []
    weights: dict[str, Any] = {}
    rest: dict[str, Any] = {}
    sample = samples.take(np.arange(0, len(samples), max(1, len(samples) // 1024)), NETWORK, CONFIG)
    for name in THOR2:
        n_inputs = input_size(name, CONFIG, NETWORK.n_regions)
        model = MLP(n_inputs, len(classes), rngs=nnx.Rngs(options.seed))
        model.input_scale[...] = scale_inputs(sample, name, NETWORK, CONFIG)
        split: Any = nnx.split(model, nnx.Param, ...)
        graph, weights[name], rest[name] = split
        graphs.append((name, graph))
    learned = weights, LearnedValues.start()
    state = FitState(learned, rest, optax.adam(1.0).init(learned))

    rng, key = np.random.default_rng(options.seed), jax.random.key(options.seed)
    batch_size = min(options.batch_size, len(samples))
    n_steps = len(samples) // batch_size
    decay = optax.cosine_decay_schedule(RATE if learn else 0.0, n_steps * options.epochs)
    for epoch in range(options.epochs):
        rate = options.learning_rates[epoch >= (options.epochs + 1) // 2]
        order = rng.permutation(len(samples))
        for number in range(n_steps):
            batch = samples.take(order[number * batch_size :][:batch_size], NETWORK, CONFIG)
            step = epoch * n_steps + number
            state = train_step(tuple(graphs), state, batch, (rate, decay(step)), jax.random.fold_in(key, step))

    weights, free = state.params
    parameters = free.parameters()
    # After conversion to float32, these are the values with which the classifiers were trained.
    config = dataclasses.replace(
        CONFIG,
        image_variance=float(parameters.image_variance),
        persistence_weight=float(parameters.persistence_weight),
    )
    network = dataclasses.replace(NETWORK, similarity=np.asarray(parameters.similarity, np.float64))
    classifiers = {name: nnx.merge(graph, weights[name], state.rest[name]) for name, graph in graphs}
    record = {"epochs": options.epochs, "seed": options.seed, "learned": learn}
    return TrainedRun(config, network, classes, classifiers, record)


def arguments() -> tuple[argparse.ArgumentParser, argparse.Namespace]:
    """Parse and check the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("learn-descriptor"), help="directory for the picture and the run"
    )
    parser.add_argument("--seeds", type=int, default=3, help="number of trainings of THOR2 and of THOR2-L")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--azimuth-step", type=float, default=40.0, help="degrees between training views")
    parser.add_argument("--polar-step", type=float, default=45.0, help="degrees between training views")
    parser.add_argument("--meshes", type=Path, help="folder of meshes, instead of the built-in objects")
    parser.add_argument("--names", type=Path, help="table: object name -> mesh (default: all meshes)")
    parser.add_argument(
        "--evaluate-uwis", type=Path, nargs="+", default=[], help="datasets in the layout of UW-IS Occluded"
    )
    parser.add_argument("--evaluate-frames", type=Path, nargs="+", default=[], help="folders of labelled frames")
    options = parser.parse_args()
    if options.seeds < 1:
        parser.error(f"--seeds is {options.seeds}; expected at least 1")
    if (options.meshes is None) != (not options.evaluate_uwis and not options.evaluate_frames):
        parser.error("--meshes and one of --evaluate-uwis and --evaluate-frames need each other; give both or neither")
    if options.names and options.meshes is None:
        parser.error("--names needs --meshes")
    return parser, options


def load_sets(options: argparse.Namespace) -> tuple[Mapping[str, Any], dict[str, Iterable[LabelledFrame]]]:
    """Return the objects to train on and the sets of frames to evaluate on."""
    if options.meshes is None:
        every = builtin_objects()
        objects = {name: every[name] for name in LOOK_ALIKES}
        streams = np.random.SeedSequence(0).spawn(N_SCENES)
        scenes = [compose_scene(objects, np.random.default_rng(stream), light=LIGHT) for stream in streams]
        return objects, {"built-in scenes": [LabelledFrame(f"{k}", s.frame, s.truth, {}) for k, s in enumerate(scenes)]}
    meshes = find_meshes(options.meshes, options.names)
    sets: dict[str, Iterable[LabelledFrame]] = {str(path): UWISOccluded(path) for path in options.evaluate_uwis}
    return meshes, sets | {str(path): FrameFolder(path) for path in options.evaluate_frames}


def main() -> None:
    """Train and evaluate both, print the accuracies and draw a picture."""
    parser, options = arguments()
    try:
        fits = [FitOptions(epochs=options.epochs, seed=seed) for seed in range(options.seeds)]
        check_output_directory(options.out / "thor2-l")
        compare(options, fits)
    except (thor2.InputError, OSError) as error:
        parser.error(str(error))


def compare(options: argparse.Namespace, fits: Sequence[FitOptions]) -> None:
    """Train, evaluate and report with checked options."""
    start = time.perf_counter()
    objects, sets = load_sets(options)
    for title, frames in sets.items():
        if not any(name in objects for item in frames for name in item.truth.values()):
            raise thor2.InputError(f"{title} contains none of the objects to train on; expected at least one")
    source = MemoryViews(render_views(objects, options.azimuth_step, options.polar_step), CONFIG)
    check_classes(source)
    samples, _ = sample_views(source, NETWORK, CONFIG)
    print(f"{len(samples)} samples of {len(objects)} objects, {time.perf_counter() - start:.0f} s", flush=True)

    runs: dict[str, list[TrainedRun]] = {"THOR2": [], "THOR2-L": []}
    names = list(fusions(THOR2))
    accuracy: dict[str, dict[str, list[list[float]]]] = {title: {name: [] for name in runs} for title in sets}
    for fit in fits:
        for name, trained in runs.items():
            trained.append(train(samples, source.classes, fit, learn=name == "THOR2-L"))
            for title, frames in sets.items():
                run = Run(name, "", thor2.Recognizer(trained[-1]))
                results = compute_results("frames", [run], [*answer_frames([run], frames)])
                cell = results["accuracy"][results["rule"]][0]["cells"][0]
                accuracy[title][name].append([cell["accuracy"][fusion]["mean"] for fusion in names])
                print(
                    f"seed {fit.seed}, {title} ({cell['instances']}): {name} {accuracy[title][name][-1][-1]:.3f}",
                    flush=True,
                )
    options.out.mkdir(parents=True, exist_ok=True)
    save_run(runs["THOR2-L"][0], options.out / "thor2-l")

    report(names, accuracy, runs["THOR2-L"])
    print(f"{time.perf_counter() - start:.0f} s")
    lengths = samples.strips[:, :: 1 + NETWORK.n_regions]
    batch = samples.take(np.diff(lengths.indptr).argmax(keepdims=True), NETWORK, CONFIG)
    draw(batch, runs["THOR2-L"][0], accuracy, names.index("THOR2"), options.out / "learn_descriptor.png")
    print(f"picture: {options.out / 'learn_descriptor.png'}; run: {options.out / 'thor2-l'}")


def report(names: Sequence[str], accuracy: Mapping[str, Mapping[str, Any]], learned: Sequence[TrainedRun]) -> None:
    """Print mean and standard deviation of the accuracies over the seeds, and the learned parameters."""
    print(f"{'accuracy':44}" + "".join(f"{name:>16}" for name in names))
    for title, runs in accuracy.items():
        for name, rows in runs.items():
            cells = [f"{mean:.3f} ± {std:.3f}" for mean, std in zip(np.mean(rows, 0), np.std(rows, 0), strict=True)]
            print(f"{title[-34:]:35}{name:9}" + "".join(f"{cell:>16}" for cell in cells))
    for field in ("image_variance", "persistence_weight"):
        values = [getattr(run.config, field) for run in learned]
        print(f"{field}: {getattr(CONFIG, field):.3g} > {np.mean(values):.3g} ± {np.std(values):.2g}")
    after = np.mean([run.network.similarity[PAIRS] for run in learned], axis=0)
    before = NETWORK.similarity[PAIRS]
    print(f"Delta, mean of the seeds: changed by {np.abs(after - before).mean():.4f} on average, most:")
    for k in np.argsort(-np.abs(after - before))[:5]:
        one, other = (f"{region[k]} {NETWORK.mean_rgb[region[k]].round().astype(int)}" for region in PAIRS)
        print(f"  {one} and {other}: {before[k]:.3f} > {after[k]:.3f}")


def draw(batch: Batch, learned: TrainedRun, accuracy: Mapping[str, Mapping[str, Any]], column: int, path: Path) -> None:
    """Draw Delta, a persistence image and the accuracies, before and after."""
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.2, 1))
    colors = ("#56b4e9", "#d55e00")

    tables = {"THOR2": (NETWORK, CONFIG), "THOR2-L": (learned.network, learned.config)}
    before, after = (
        np.ma.masked_array(network.similarity, np.eye(network.n_regions, dtype=bool)) for network, _ in tables.values()
    )
    change = np.log2(after / before)
    scale = LogNorm(min(before.min(), after.min()), max(before.max(), after.max()))
    shown = {
        "Delta of THOR2": (before, "viridis", scale),
        "Delta of THOR2-L": (after, "viridis", scale),
        "log2 of after / before": (change, "RdBu_r", Normalize(-np.abs(change).max(), np.abs(change).max())),
    }
    for axes, (title, (values, colormap, norm)) in zip(upper.subplots(1, 3), shown.items(), strict=True):
        image = axes.imshow(values, cmap=colormap, norm=norm)
        for k, rgb in enumerate(NETWORK.mean_rgb / 255):
            axes.scatter([k, -1.2], [-1.2, k], marker="s", s=25, color=rgb, clip_on=False)
        axes.set(xticks=[], yticks=[], title=title)
        axes.spines[:].set_visible(False)
        upper.colorbar(image, ax=axes, location="bottom", shrink=0.9)

    bars, *pictures = lower.subplots(1, 3, width_ratios=(2, 1, 1))
    for k, name in enumerate(tables):
        values = np.array([rows[name] for rows in accuracy.values()])[..., column]
        places = np.arange(len(accuracy)) + (k - 0.5) * 0.38
        drawn = bars.bar(places, values.mean(axis=1), 0.35, yerr=values.std(axis=1), color=colors[k], label=name)
        bars.bar_label(drawn, fmt="%.3f", fontsize=8, label_type="center")
        bars.plot(np.repeat(places, values.shape[1]), values.ravel(), ".", color="#222222")
    bars.set_xticks(range(len(accuracy)), [Path(title).name for title in accuracy])
    bars.set(ylim=(0, 1), title="accuracy: mean, deviation and each seed")
    bars.legend(loc="lower right", fontsize=8)
    images = [np.asarray(describe_batch(batch, *run).images[0]) for run in tables.values()]
    fullest = images[0].sum(axis=(1, 2)).argmax()
    for axes, name, image in zip(pictures, tables, images, strict=True):
        axes.imshow(image[fullest].T, origin="lower", cmap="magma")
        axes.set(xticks=[], yticks=[], xlabel="birth", ylabel="persistence", title=f"image of {name}")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
