"""Embeddings of clouds: unit vectors that are close for views of one object, also of objects without training.

    embedding = load_default()                              # packaged, trained on procedural objects
    similarity = embedding.embed(clouds) @ embedding.embed(others).T

An embedding has two blocks, each of unit length before it is weighted: the output of a trained network on the
descriptor; and the colour embeddings of the strips, the histogram of balanced colours and the persistence images,
projected to their principal components, which depend little on what the network was trained on. Embeddings of earlier
versions have no images there, or the histogram of the colour regions in a block of its own. The embedding of a run also
classifies: by this network and further ones, whose class probabilities are averaged. `training.embedding` fits the
networks.
"""

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from flax import nnx

import colornet
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.descriptor.cloud_statistics import N_BALANCED, N_SCALARS, is_color, square_root
from thor2_jax.descriptor.looks import LookDescriptors, describe_looks
from thor2_jax.errors import decoding
from thor2_jax.files import atomic_write, content_digest, read_file, safetensors_metadata
from thor2_jax.gallery.references import REFERENCES_FILE, References
from thor2_jax.model.classifier import compiled, model_arrays, model_from_arrays
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["Embedding", "EmbeddingNetwork", "EmbeddingSizes", "class_cosines", "load_default"]

EMBEDDING_FORMAT, FORMAT_WITH_FURTHER = 1, 2
"""Version of the file: float16 arrays of one network, or of several, and JSON metadata."""

IMAGE_SHARE = 0.5
BLOCK_WEIGHTS = (1.0, 1.0, 1.0), (1.0, 2.0), (0.5, 2 + IMAGE_SHARE)
"""Shares of the blocks in the similarity by `EmbeddingSizes.version`, before they are divided by their sum; the share
of the persistence images in the projected block, where each kind of colours has 1. Chosen on held-out frames."""

VIEW_WEIGHT, NEUTRAL_SIMILARITY = 10.0, 0.8
"""Log-odds of an object being one of the classes for each unit of its similarity to the nearest reference view, as a
logistic regression on held-out views weighs it; the similarity at which they stay as they are."""

_METADATA = "embedding"
# safetensors writes several metadata keys in a random order, and equal embeddings shall have equal bytes.


_FURTHER = "further/{}/"
"""Prefix of the names of the arrays of a further network in the file, with its number."""


@dataclasses.dataclass(frozen=True)
class EmbeddingSizes:
    """Sizes of the network of an embedding, and what its outputs are made of.

    Attributes:
        cell: outputs of the layer that is shared by all strip positions.
        hidden: units of the hidden layers.
        learned: length of the network's block of the embedding.
        color: length of the block of projected colours and images.
        balanced: whether that has the histogram of balanced colours; False in embeddings of earlier versions.
        shape: whether it has the persistence images; False in embeddings of earlier versions.
        nearest: whether every distractor counts with the logit of the nearest one, for each network and look; False in
            embeddings of earlier versions, where each counts with its own.
        views: whether the reference views take part in the classification; False in embeddings of earlier versions.
    """

    cell: int = 20
    hidden: tuple[int, ...] = (384, 256)
    learned: int = 128
    color: int = 120
    balanced: bool = True
    shape: bool = True
    nearest: bool = True
    views: bool = True

    @property
    def version(self) -> int:
        """Version of what is projected: 0 strips, 1 also balanced colours, 2 also persistence images."""
        return self.balanced + (self.balanced and self.shape)


def _unit(x: jax.Array) -> jax.Array:
    """Scale the last axis to unit length; zeros stay zeros."""
    return x * jax.lax.rsqrt(jnp.maximum(jnp.square(x).sum(axis=-1, keepdims=True), 1e-12))


class EmbeddingNetwork(nnx.Module):
    """Network of an embedding: one linear layer on each strip position of each slice, then fully connected layers.

    At a position, the layer reads the row of the persistence image born there and the colour embedding of the strip.
    Empty positions contribute zero.
    """

    def __init__(
        self, config: DescriptorConfig, n_regions: int, sizes: EmbeddingSizes, n_proxies: int, *, rngs: nnx.Rngs
    ) -> None:
        """Initialize the weights; the colour basis is zero and the blocks have equal weights.

        Args:
            config: descriptor.
            n_regions: number of colour regions.
            sizes: sizes of the layers.
            n_proxies: number of proxies, which classify; 0 for none.
            rngs: generators of the weights and the dropout.
        """
        self.positions = max(config.image_size, config.n_strips)
        self.n_regions, self.version = n_regions, sizes.version
        n_cells = config.n_slices * self.positions
        widths = (n_cells * sizes.cell + N_SCALARS + n_regions, *sizes.hidden)
        he = nnx.initializers.he_normal()
        self.cell = nnx.Linear(config.image_size + n_regions, sizes.cell, kernel_init=he, rngs=rngs)
        layers = [nnx.Linear(a, b, use_bias=False, kernel_init=he, rngs=rngs) for a, b in itertools.pairwise(widths)]
        self.layers = nnx.List(layers)
        self.norms = nnx.List([nnx.BatchNorm(n, momentum=0.9, rngs=rngs) for n in sizes.hidden])
        self.dropout = nnx.Dropout(0.15)
        self.head = nnx.Linear(sizes.hidden[-1], sizes.learned, use_bias=False, kernel_init=he, rngs=rngs)
        n_strips, cells = n_regions * config.n_strips, -(-config.image_size // 2)
        n_features = config.n_slices * n_strips, N_BALANCED, config.n_slices * cells**2  # one more in each version
        self.color_basis = nnx.BatchStat(jnp.zeros((sum(n_features[: sizes.version + 1]), sizes.color)))
        self.block_weights = nnx.BatchStat(jnp.array(BLOCK_WEIGHTS[sizes.version]))
        if n_proxies:
            self.proxies = nnx.Param(jax.random.normal(rngs.params(), (sizes.learned, n_proxies)))
            self.log_scale = nnx.Param(jnp.log(jnp.float32(16)))  # a weak type would compile the first steps anew

    def learned(
        self, descriptors: Descriptors, statistics: jax.Array, *, train: bool = False, rngs: nnx.Rngs | None = None
    ) -> jax.Array:
        """Return the learned block [B, learned], of unit length.

        Args:
            descriptors: of B clouds.
            statistics: [B, 12 + R] or more, from `cloud_statistics`; those after the first 12 + R are not read.
            train: normalize by the statistics of the batch, and drop units.
            rngs: generators of the dropout.
        """
        colors = jnp.swapaxes(square_root(descriptors.embeddings), -1, -2)
        cells = [100 * descriptors.images, 0.5 * colors]
        padded = [jnp.pad(a, ((0, 0), (0, 0), (0, self.positions - a.shape[2]), (0, 0))) for a in cells]
        bias = jnp.asarray(self.cell.bias)
        x = nnx.relu(self.cell(jnp.concatenate(padded, axis=-1))) - nnx.relu(bias)
        read = statistics[:, : N_SCALARS + self.n_regions]
        scale = jnp.where(jnp.arange(read.shape[1]) < N_SCALARS, 1, 2)
        x = jnp.concatenate([x.reshape(len(x), -1), read * scale], axis=1)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = nnx.relu(norm(layer(x), use_running_average=not train))
            x = self.dropout(x, deterministic=not train, rngs=rngs)
        return _unit(self.head(x))

    def class_logits(self, learned: jax.Array) -> jax.Array:
        """Return one logit for each proxy [B, n_proxies] from learned blocks [B, learned]."""
        return jnp.exp(self.log_scale[...]) * class_cosines(learned, self.proxies[...])

    def __call__(self, descriptors: Descriptors, statistics: jax.Array) -> jax.Array:
        """Return the embeddings [B, D], of unit length.

        The arguments are those of `learned`; if the colours are balanced, `balanced_histogram` ends the statistics.
        """
        features = projected_features(descriptors, statistics, self.version)
        blocks = [self.learned(descriptors, statistics), _unit(features @ self.color_basis[...])]
        if self.version == 0:
            blocks.append(statistics[:, N_SCALARS : N_SCALARS + self.n_regions])
        weights = jnp.sqrt(self.block_weights[...])
        return _unit(jnp.concatenate([w * block for w, block in zip(weights, blocks, strict=True)], axis=1))


def class_cosines(learned: jax.Array, proxies: jax.Array) -> jax.Array:
    """Return the cosines [B, n] of unit vectors [B, learned] with proxies [learned, n]."""
    return learned @ (proxies / jnp.linalg.norm(proxies, axis=0))


def projected_features(descriptors: Descriptors, statistics: jax.Array, version: int) -> jax.Array:
    """Return the features [B, F] that are projected to their principal components, by `EmbeddingSizes.version`.

    They are the square roots of the colour embeddings, `balanced_histogram`, with which the statistics end, and
    the square roots of the persistence images, in cells of 2 x 2 pixels. Each part has a constant length.
    """
    count = len(descriptors.embeddings)
    parts = [_unit(square_root(descriptors.embeddings).reshape(count, -1))]
    if version > 0:
        parts.append(statistics[:, -N_BALANCED:])
    if version > 1:
        cells = nnx.avg_pool(jnp.moveaxis(descriptors.images, 1, -1), (2, 2), strides=(2, 2), padding="SAME")
        parts.append(math.sqrt(IMAGE_SHARE) * _unit(square_root(cells).reshape(count, -1)))
    return jnp.concatenate(parts, axis=1)


def _embed_looks(models: Sequence[EmbeddingNetwork], oriented: LookDescriptors) -> jax.Array:
    return models[0](*oriented.flat).reshape(*oriented.shape, -1)


class _ClassViews(nnx.Module):
    """The learned blocks of the reference views of the classes.

    Attributes:
        learned: [C, n, L], of unit length, or zeros beyond the views of a class.
    """

    def __init__(self, references: References, n_classes: int, length: int) -> None:
        learned = np.asarray(_unit(jnp.asarray(references.embeddings[:, :length], jnp.float32)))
        of_class = [learned[references.label == label] for label in range(n_classes)]
        padded = np.zeros((n_classes, max(map(len, of_class)), length), np.float32)
        for label, views in enumerate(of_class):
            padded[label, : len(views)] = views
        self.learned = nnx.Variable(jnp.asarray(padded))

    def similarity(self, learned: jax.Array, label: jax.Array) -> jax.Array:
        """Return the cosine [B, K] of each look [B, K, L] at a cloud with the nearest view of the class `label` [B]."""
        return jnp.einsum("bkl,bnl->bkn", learned, self.learned[...][label]).max(axis=-1, initial=-1)


def _class_probabilities(
    models: Sequence[Any], oriented: LookDescriptors, n_classes: int, n_networks: int, nearest: bool
) -> jax.Array:
    """Return the probabilities [B, n_classes] of the first proxies.

    With `nearest`, all others are one column, with the sum that they would have if each had the logit of the nearest
    one. With `_ClassViews` after the networks, the odds of all classes together grow with the similarity of the most
    probable one.
    """
    networks = models[:n_networks]
    learned = [model.learned(*oriented.flat) for model in networks]
    logits = jnp.stack([model.class_logits(block) for model, block in zip(networks, learned, strict=True)])
    if nearest:
        largest = logits[..., n_classes:].max(axis=-1, keepdims=True) + math.log(logits.shape[-1] - n_classes)
        logits = jnp.concatenate([logits[..., :n_classes], largest], axis=-1)
    # `fuse` normalizes: the mean logits give the geometric mean of the networks' probabilities.
    fused = oriented.fuse(logits.mean(axis=0))
    probabilities = fused[:, :n_classes]
    if len(models) > n_networks:
        views = models[n_networks]
        looks = learned[0].reshape(*oriented.shape, -1)
        similarity = views.similarity(looks, probabilities.argmax(axis=1)).mean(axis=1)
        probabilities *= jnp.exp(VIEW_WEIGHT * (similarity - NEUTRAL_SIMILARITY))[:, None]
        probabilities /= (probabilities.sum(axis=1) + fused[:, n_classes:].sum(axis=1))[:, None]
    return probabilities


def _split(model: EmbeddingNetwork) -> tuple[Any, Any]:
    """Return the graph and the state of a network, with its values as the file stores them."""
    with jax.ensure_compile_time_eval():  # the result is kept, also if the first call is inside a compiled function
        graph, state = nnx.split(model)
        # By NumPy: JAX would compile a program for each shape.
        with np.errstate(over="ignore"):
            return graph, jax.tree.map(lambda a: jax.device_put(np.asarray(a, np.float16).astype(np.float32)), state)


@dataclasses.dataclass(frozen=True, eq=False)
class Embedding:
    """The networks of an embedding, with everything that determines their results.

    Attributes:
        config: constants of the descriptor, which is always computed in closed form.
        network: the colour network.
        sizes: sizes of the network.
        model: the network of the embedding. Do not change it: compiled functions and `fingerprint` keep its arrays.
        classes: classes that the network also recognizes by its first proxies; none in the packaged embedding.
        distractors: number of proxies after those of the classes, of objects that are none of them.
        further: networks from `create_further`, fitted as `model` was from other random weights. `class_probabilities`
            averages all networks, which separates unknown objects more reliably (Lakshminarayanan et al., "Simple and
            Scalable Predictive Uncertainty Estimation using Deep Ensembles", NeurIPS 2017). Only `model` embeds.
        references: embedded views of the classes and of the background, for galleries and, with `sizes.views`, for the
            classification; None in embeddings of earlier versions, whose galleries know less of what is unknown. Not a
            part of `fingerprint`.
    """

    config: DescriptorConfig
    network: colornet.ColorNetwork
    sizes: EmbeddingSizes
    model: EmbeddingNetwork
    classes: tuple[str, ...] = ()
    distractors: int = 0
    further: tuple[EmbeddingNetwork, ...] = ()
    references: References | None = None

    @classmethod
    def create(
        cls,
        config: DescriptorConfig | None = None,
        network: colornet.ColorNetwork | None = None,
        sizes: EmbeddingSizes | None = None,
        seed: int = 0,
        classes: tuple[str, ...] = (),
        distractors: int = 0,
    ) -> "Embedding":
        """Return an embedding with random weights.

        Args:
            config: by default the paper's descriptor.
            network: by default the packaged colour network.
            sizes: of the network.
            seed: seed for the weights.
            classes: names of the classes that the network also recognizes.
            distractors: number of objects that are none of the classes.
        """
        config = dataclasses.replace(config or DescriptorConfig(), homology="closed_form")
        network, sizes = network or colornet.load_default(), sizes or EmbeddingSizes()
        n_proxies = len(classes) + distractors
        model = EmbeddingNetwork(config, network.n_regions, sizes, n_proxies, rngs=nnx.Rngs(seed))
        return cls(config, network, sizes, model, classes, distractors)

    def create_further(self, seed: int = 0) -> EmbeddingNetwork:
        """Return a network for `further` with random weights; without a colour block, since it does not embed.

        Its weights of the statistics of colours are zero, as they stay if it is fitted on statistics without them.
        """
        sizes = dataclasses.replace(self.sizes, color=0)
        n_regions, n_proxies = self.network.n_regions, len(self.classes) + self.distractors
        model = EmbeddingNetwork(self.config, n_regions, sizes, n_proxies, rngs=nnx.Rngs(seed))
        kernel = model.layers[0].kernel
        is_used = np.concatenate([np.ones(kernel.shape[0] - N_SCALARS - n_regions, bool), ~is_color(n_regions)])
        kernel[...] = jnp.where(is_used[:, None], kernel[...], 0)
        return model

    def without_proxies(self) -> "Embedding":
        """Return the same embedding without classes and distractors."""
        arrays = model_arrays(self.model)
        model = model_from_arrays(lambda: Embedding.create(self.config, self.network, self.sizes).model, arrays)
        return Embedding(self.config, self.network, self.sizes, model)

    @property
    def size(self) -> int:
        """Length D of an embedding."""
        return self.sizes.learned + self.sizes.color + (0 if self.sizes.balanced else self.network.n_regions)

    @functools.cached_property
    def _embedder(self) -> tuple[Any, Any]:
        return _split(self.model)

    @functools.cached_property
    def _embed_looks(self) -> Callable[[LookDescriptors], jax.Array]:
        return compiled(_embed_looks, [self._embedder])

    def embed(self, clouds: PointClouds) -> jax.Array:
        """Return the embeddings [B, D] float32 of clouds in metres, each of unit length.

        Each shape [B, N] of the batch compiles once for all embeddings of the same sizes and descriptor.
        """
        return self.embed_oriented(describe_looks(clouds, self.network, self.config, 1), clouds)[:, 0]

    def embed_oriented(self, oriented: LookDescriptors, clouds: PointClouds | None = None) -> jax.Array:
        """Return the embeddings [B, K, D] of K looks at clouds.

        Args:
            oriented: described by this descriptor.
            clouds: [B, N] the clouds, whose colours are compared too; None if `oriented` is `with_balanced`.
        """
        if self.sizes.balanced and clouds is not None:
            oriented = oriented.with_balanced(clouds)
        return self._embed_looks(oriented)

    @functools.cached_property
    def class_probabilities(self) -> Callable[[LookDescriptors], jax.Array]:
        """Function from K looks at clouds, described by this embedding's descriptor, to class probabilities [B, C].

        What they lack to 1 is that of the distractors. They are the geometric mean over the networks and over the
        looks. With `sizes.nearest`, every distractor has the logit of the nearest one, for each
        network and look. With `sizes.views`, the odds of all classes are multiplied by
        exp(`VIEW_WEIGHT` (s - `NEUTRAL_SIMILARITY`)), where s is the largest cosine between the learned blocks of a
        look and of a reference view of the most probable class, averaged over the looks (Sun et al.,
        "Out-of-Distribution Detection with Deep Nearest Neighbors", ICML 2022).
        """
        models = [self._embedder, *map(_split, self.further)]
        static = len(self.classes), len(models), self.sizes.nearest and self.distractors > 0
        if self.sizes.views and self.references is not None:
            with jax.ensure_compile_time_eval():  # as in `_split`; on the device, or every call would copy the views
                models.append(nnx.split(_ClassViews(self.references, len(self.classes), self.sizes.learned)))
        return compiled(_class_probabilities, models, *static)

    @functools.cached_property
    def _content(self) -> bytes:
        about = {
            "format": FORMAT_WITH_FURTHER if self.further else EMBEDDING_FORMAT,
            "descriptor_version": DESCRIPTOR_VERSION,
            "descriptor_config": dataclasses.asdict(self.config),
            "color_network": self.network.fingerprint,
            "sizes": dataclasses.asdict(self.sizes),
            "classes": list(self.classes),
            "distractors": self.distractors,
        }
        if self.further:
            about["further"] = len(self.further)
        arrays = model_arrays(self.model)
        for number, model in enumerate(self.further):
            arrays |= {_FURTHER.format(number) + name: array for name, array in model_arrays(model).items()}
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
        return safetensors.numpy.save(arrays, {_METADATA: json.dumps(about, sort_keys=True)})

    @functools.cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the file; embeddings of other fingerprints cannot be compared."""
        return content_digest([self._content])

    def save(self, path: str | Path) -> None:
        """Write the embedding to a file (safetensors, float16), and its references beside it, each atomically.

        Raises:
            OSError: a file cannot be written.
        """
        if self.references is not None:
            self.references.save(Path(path).with_name(REFERENCES_FILE), self.fingerprint)
        with atomic_write(path) as temporary:
            temporary.write_bytes(self._content)

    @classmethod
    def load(cls, path: str | Path, network: colornet.ColorNetwork | None = None) -> "Embedding":
        """Read an embedding.

        Args:
            path: file that `save` wrote.
            network: colour network that the embedding was fitted with; by default the packaged one.

        Raises:
            InputError: the file is missing or damaged, or its format, descriptor version or colour network is another
                one. The message names the file.
        """
        path, network = Path(path), network or colornet.load_default()
        advice = "an embedding of this version; copy the whole run directory, or train the run again"
        with decoding(f"embedding: {path} cannot be used", advice):
            content = read_file(path)
            about = json.loads(safetensors_metadata(content)[_METADATA])
            arrays = {name: array.astype(np.float32) for name, array in safetensors.numpy.load(content).items()}
            count = int(about.get("further", 0))
            version = FORMAT_WITH_FURTHER if count else EMBEDDING_FORMAT
            current = (version, DESCRIPTOR_VERSION, network.fingerprint)
            for field, expected in zip(("format", "descriptor_version", "color_network"), current, strict=True):
                if about[field] != expected:
                    raise ValueError(f"{field} is {about[field]!r}; expected {expected!r}")
            config = DescriptorConfig.of_record(about["descriptor_config"])
            earlier: dict[str, Any] = dict.fromkeys(("balanced", "shape", "nearest", "views"), False)
            sizes = EmbeddingSizes(**earlier | about["sizes"] | {"hidden": tuple(about["sizes"]["hidden"])})
            classes, distractors = tuple(map(str, about.get("classes", ()))), int(about.get("distractors", 0))
            model = model_from_arrays(lambda: cls.create(config, network, sizes, 0, classes, distractors).model, arrays)
            embedding = cls(config, network, sizes, model, classes, distractors)
            further = []
            for prefix in map(_FURTHER.format, range(count)):
                own = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
                further.append(model_from_arrays(embedding.create_further, own))
        file, references = path.with_name(REFERENCES_FILE), None
        if file.is_file():
            references = References.load(file, content_digest([content]), embedding.size)
        embedding = dataclasses.replace(embedding, further=tuple(further), references=references)
        # The file determines the fingerprint, also if another version of this software wrote it.
        embedding.__dict__["_content"] = content
        return embedding


@functools.cache
def load_default() -> Embedding:
    """Return the packaged embedding, trained on procedural objects; `python -m training.embedding.build` makes it."""
    return Embedding.load(Path(__file__).with_name("data") / "embedding.safetensors")
