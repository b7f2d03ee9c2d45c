"""The interface of a trained baseline, its inputs, its file, and functions shared by the fits of baselines.

The file is RUN/baselines/NAME.safetensors. Its metadata entry "about" is JSON. It has the format, the classes, the
temperature (null without a held-out set), the training time in seconds, any files of pretrained weights, and a digest
of these entries and the arrays.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax import DescriptorConfig, PointClouds, RGBDFrame, view_normalize
from thor2_jax.errors import decoding
from thor2_jax.files import content_digest, json_digest, pack_arrays, read_file, unpack_arrays, write_bytes
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import Compiled
from thor2_jax.recognizer import DescribedFrame
from training.fitting.fit import FitState, fit_temperature, network_step
from training.fitting.loop import Checkpoints, FitOptions, Steps, fit_progress, run_epochs
from training.storage.jobs import Progress
from training.views.crops import ViewCrops, rgbd_crop
from training.views.normalized_views import NormalizedViews, ViewSource, fold_of_views

__all__ = [
    "BaselineInputs",
    "FitTask",
    "Predictor",
    "StoredBaseline",
    "baseline_file",
    "compiled_network",
    "in_batches",
]

Integers = NDArray[np.integer[Any]]


class BaselineInputs(NamedTuple):
    """The B instances of a described frame, as inputs of baselines.

    Attributes:
        normal: view-normalized clouds, scaled units.
        tops: [B, F] float32, TOPS descriptors of the instances.
        crops: function of the side in pixels that returns the crops of the instances, without padding rows.
    """

    normal: PointClouds
    tops: NDArray[np.float32]
    crops: Callable[[int], ViewCrops]

    @classmethod
    def of_frame(cls, described: DescribedFrame, config: DescriptorConfig, frame: RGBDFrame) -> "BaselineInputs":
        """Return the instances of a frame in the row order of `described.packed`; crops are computed on demand."""

        @functools.cache
        def crops(size: int) -> ViewCrops:
            return ViewCrops.stacked([rgbd_crop(frame, view.label, size) for view in described.usable], size)

        return cls(view_normalize(described.packed, config), np.asarray(described.descriptors.tops), crops)

    def predicted(
        self, size: int, n_classes: int, predict: Callable[[ViewCrops], NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Return class probabilities [B, C] from `predict` for the crops of a size; uniform ones for padding rows."""
        values = np.full((len(self.tops), n_classes), 1 / n_classes, np.float32)
        crops = self.crops(size)
        if len(crops):
            values[: len(crops)] = predict(crops)
        return values


Predictor = Callable[[BaselineInputs], NDArray[np.float32]]
"""A trained baseline: function of the inputs that returns class probabilities [B, C]."""


BASELINE_FORMAT = 1


def baseline_file(run: Path, name: str) -> Path:
    """Return the path of a baseline in a run directory; `name` may be a glob pattern."""
    return run / "baselines" / f"{name}.safetensors"


@dataclasses.dataclass(frozen=True, eq=False)
class StoredBaseline:
    """Contents of a baseline file.

    Attributes:
        arrays: learned arrays by name.
        temperature: temperature fitted on the held-out set; None without one.
        weights: files of pretrained weights from which it was fitted -> SHA-256; empty if it was trained from scratch.
    """

    arrays: Mapping[str, NDArray[Any]]
    temperature: float | None
    weights: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def _digest(self, about: Mapping[str, Any]) -> str:
        parts: list[str | bytes] = [json_digest(about)]
        for name, array in sorted(self.arrays.items()):
            parts += [f"{name} {array.dtype} {array.shape}\0", np.ascontiguousarray(array).tobytes()]
        return content_digest(parts)

    def write(self, path: Path, classes: Sequence[str], seconds: float) -> None:
        """Write the file, with the training time, atomically, and create its directory if it is missing.

        Raises:
            OSError: the file cannot be written.
        """
        about: dict[str, Any] = {
            "format": BASELINE_FORMAT,
            "classes": list(classes),
            "temperature": self.temperature,
            "seconds": round(seconds, 1),
        }
        if self.weights:
            about["weights"] = dict(self.weights)
        about["digest"] = self._digest(about)
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, pack_arrays(self.arrays, {"about": json.dumps(about)}))

    @classmethod
    def read(cls, path: Path, classes: Sequence[str]) -> "StoredBaseline":
        """Read a baseline file.

        Args:
            path: path of the file.
            classes: class names of its run.

        Raises:
            InputError: the file is damaged or has another format or other classes; the message names the file.
        """
        with decoding(f"model: {path} cannot be read", advice="remove it and train the baseline again"):
            arrays, metadata = unpack_arrays(read_file(path))
            about = json.loads(metadata["about"])
            if about["format"] != BASELINE_FORMAT:
                raise ValueError(f"its format is {about['format']!r}; expected {BASELINE_FORMAT}")
            stored, digest = cls(arrays, about["temperature"], about.get("weights", {})), about.pop("digest")
            if digest != stored._digest(about):
                raise ValueError("its digest does not match")
            if about["classes"] != list(classes):
                raise ValueError("it has other classes than its run")
            return stored


def _as_given(*arrays: Any) -> tuple[Any, ...]:
    """Return the arrays of a batch as the arguments of a network."""
    return arrays


@functools.partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=3)
def _step(graph: Any, inputs: Any, optimizer: Any, state: FitState, batch: Any, label: Any, rate: Any) -> Any:
    def outputs_of(model: Any) -> tuple[jax.Array, jax.Array]:
        logits = model(*inputs(*batch))
        return logits, logits

    return network_step(graph, state, optimizer(rate), label, outputs_of)


@dataclasses.dataclass(frozen=True)
class FitTask:
    """Data and options for fitting a baseline.

    Attributes:
        name: name of the baseline.
        source: views of the run.
        run: the run. Its fold is held out, unless it is the only fold.
        directory: directory of the run.
        weights: folder of pretrained weights; None trains networks from scratch.
        progress: called with (stage, done, total, note).
    """

    name: str
    source: ViewSource
    run: TrainedRun
    directory: Path
    weights: Path | None
    progress: Progress

    @property
    def options(self) -> FitOptions:
        """Options of the fit, the same as for the run."""
        record, rates = self.run.record, tuple(self.run.record["learning_rates"])
        return FitOptions(record["epochs"], rates, record["batch_size"], record["seed"])

    @property
    def scratch(self) -> Path:
        """Directory for checkpoints, so that an interrupted fit can resume."""
        return self.directory / "baselines" / f".{self.name}"

    def held_out(self, label: Integers, view: Integers) -> NDArray[np.bool_]:
        """Return which clouds [M] are held out, given class index and view number; the same views as in the run."""
        folds = self.run.record["folds"]
        if folds == 1:
            return np.zeros(len(label), bool)
        return fold_of_views(label, view, self.source.classes, folds, self.options.seed) == self.run.record["fold"]

    def temperature(
        self, label: Integers, held_out: NDArray[np.bool_], predict: Callable[[], NDArray[np.float32]]
    ) -> float | None:
        """Return the temperature for the probabilities from `predict` for held-out clouds; None if there are none."""
        return fit_temperature(predict(), label[held_out]) if held_out.any() else None

    def shards(self, stage: str, unit: str) -> Iterator[tuple[int, slice, NormalizedViews]]:
        """Yield index, rows among all clouds, and views of each shard, while showing the progress of a stage."""
        done, total = 0, self.n_clouds
        for index, shard in enumerate(self.source.shards):
            yield index, slice(done, done + shard.views), self.source.read(index)
            done += shard.views
            self.progress(stage, done, total, unit)

    @property
    def n_clouds(self) -> int:
        """Number of clouds of the source."""
        return sum(shard.views for shard in self.source.shards)

    def fit_network(
        self,
        model: nnx.Module,
        label: Integers,
        held_out: NDArray[np.bool_],
        draw: Callable[[NDArray[np.intp], np.random.Generator], tuple[Any, ...]],
        optimizer: Callable[[Any], Any],
        rate: Callable[[int, int], float],
        batch_size: int,
        *,
        inputs: Callable[..., tuple[Any, ...]] = _as_given,
        n_samples: int | None = None,
        directory: str = "fit",
    ) -> Any:
        """Return a fitted network; an interrupted fit resumes.

        Args:
            model: the network, with its initial weights.
            label: [M] class indices of all clouds.
            held_out: [M], True for clouds on which it is not fitted.
            draw: function of the rows of a batch and a random number generator; returns the batch, a tuple of arrays.
            optimizer: function of the learning rate that returns an optimizer. Static.
            rate: function of the number of a step and the number of all steps that returns the learning rate.
            batch_size: samples per step.
            inputs: function of the arrays of a batch that returns the arguments of the network. Static.
            n_samples: number of clouds that an epoch uses; by default all on which it is fitted.
            directory: directory of the checkpoints.

        Raises:
            InputError: the loss is not finite.
        """
        rows = np.flatnonzero(~held_out)
        n_samples = n_samples or len(rows)
        batch_size = min(batch_size, n_samples)
        steps = Steps(self.options.epochs, n_samples // batch_size, batch_size)
        graph, state = FitState.initial(model, optimizer(0.0))

        def train_epoch(number: int, state: FitState) -> Iterator[tuple[FitState, Any]]:
            rng = np.random.default_rng((self.options.seed, number - 1))
            order = rng.permutation(rows)[: steps.of_epoch * batch_size].reshape(-1, batch_size)
            for step, chosen in enumerate(order, (number - 1) * steps.of_epoch):
                now = np.float32(rate(step, steps.epochs * steps.of_epoch))
                batch = draw(chosen, rng)
                state, computed = _step(graph, inputs, optimizer, state, batch, label[chosen], now)
                yield state, computed

        checkpoints = Checkpoints(self.scratch / directory)
        shown = fit_progress(self.progress, f"fit {self.name}", steps.epochs)
        state = run_epochs(self.name, checkpoints.last(state), steps, train_epoch, checkpoints, progress=shown)
        return nnx.merge(graph, state.params, state.rest)


def _apply(models: Sequence[Any], arrays: tuple[Any, ...], inputs: Any, output: Any) -> jax.Array:
    (model,) = models
    return output(model(*inputs(*arrays)))


def compiled_network(
    model: nnx.Module,
    inputs: Callable[..., tuple[Any, ...]] = _as_given,
    output: Callable[[Any], Any] = jax.nn.softmax,
) -> Callable[[tuple[Any, ...]], jax.Array]:
    """Return a compiled function of a tuple of arrays: `output` of the network applied to `inputs` of the arrays."""
    return Compiled(_apply, [nnx.split(model)], inputs, output)


def in_batches(function: Callable[[tuple[Any, ...]], Any], size: int, *arrays: NDArray[Any]) -> NDArray[np.float32]:
    """Apply a function to arrays [V, ...], `size` rows at a time, and return the results [V, ...]; V is at least 1."""
    count, results = len(arrays[0]), []
    for first in range(0, count, size):
        rows = np.resize(np.arange(first, min(first + size, count)), size)
        results.append(np.asarray(function(tuple(array[rows] for array in arrays)))[: count - first])
    return np.concatenate(results)
