"""Embeddings of clouds: unit vectors that are close for views of one object, even if it was not in the training set.

    embedding = load_default()                              # packaged, trained on procedural objects
    similarity = embedding.embed(clouds) @ embedding.embed(others).T

An embedding has two blocks, each of unit length before it is weighted. The first block is the output of a network,
which reads the descriptor. The second block depends little on the training set: the colour embeddings of the strips,
the histogram of balanced colours and the persistence images are projected to their principal components. In embeddings
of earlier versions, this block has no images, or the histogram of the colour regions is a third block. The embedding of
a run also classifies: the class probabilities of its network and of further networks are averaged. `training.embedding`
fits the networks.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

import colornet
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.descriptor.looks import N_SCALARS, LookDescriptors, describe_looks, is_color
from thor2_jax.errors import decoding
from thor2_jax.files import content_digest, pack_arrays, read_file, unpack_arrays, write_bytes
from thor2_jax.networks.networks import (
    Compiled,
    EmbeddingNetwork,
    EmbeddingSizes,
    model_arrays,
    model_from_arrays,
    to_unit_length,
)
from thor2_jax.types import HIGHEST, PointClouds

__all__ = ["BACKGROUND", "REFERENCES_FILE", "Embedding", "References", "load_default"]

EMBEDDING_FORMAT, FORMAT_WITH_FURTHER = 1, 2
"""Version of the file: float16 arrays of one network, or of several, and JSON metadata."""

VIEW_WEIGHT, NEUTRAL_SIMILARITY = 10.0, 0.8
"""VIEW_WEIGHT: change of the log-odds of being one of the classes per unit of similarity to the nearest reference view,
from a logistic regression on held-out views. NEUTRAL_SIMILARITY: similarity at which they do not change."""

_FURTHER = "further/{}/"
"""Prefix of the array names of a further network in the file, with the number of the network."""


REFERENCES_FILE = "references.safetensors"
"""File of the references, in the directory of the embedding."""

BACKGROUND = -1
"""Label of the views of distractors, the background."""


@dataclasses.dataclass(frozen=True, eq=False)
class References:
    """Reference views: embedded views of the classes of a run, and of the background: objects of no class.

    The regression of a gallery includes them (`Gallery.scores`). So an enrolled object is recognized by its differences
    from the references, and even a gallery with a single object rejects unknown objects. With `EmbeddingSizes.views`,
    the classification also uses the views of the classes (`Embedding.class_probabilities`).

    Attributes:
        embeddings: [n, D] float16, of unit length.
        label: [n] int32, index into `classes`, or `BACKGROUND`.
        classes: names of the classes.
    """

    embeddings: NDArray[np.float16]
    label: NDArray[np.int32]
    classes: tuple[str, ...] = ()

    def save(self, path: Path, fingerprint: str) -> None:
        """Write the references of the embedding with this fingerprint, atomically; raise OSError if that fails."""
        about = {"embedding": fingerprint, "classes": list(self.classes)}
        arrays: dict[str, NDArray[Any]] = {"embeddings": self.embeddings, "label": self.label}
        write_bytes(path, pack_arrays(arrays, {"references": json.dumps(about, sort_keys=True)}))

    @classmethod
    def load(cls, path: Path, fingerprint: str, size: int) -> "References":
        """Read the references of the embedding with this fingerprint and of this length D.

        Raises:
            InputError: the file is missing or damaged, or belongs to another embedding. The message names the file.
        """
        expected = "the views of the embedding beside it; copy both files, or train the run again"
        with decoding(f"embedding: {path} cannot be used", expected):
            arrays, metadata = unpack_arrays(read_file(path))
            about, embeddings, label = json.loads(metadata["references"]), arrays["embeddings"], arrays["label"]
            classes = tuple(map(str, about["classes"]))
            is_fitting = embeddings.shape == (len(label), size) and embeddings.dtype == np.float16
            if not is_fitting or label.dtype != np.int32:
                raise ValueError(f"embeddings are {embeddings.dtype} {list(embeddings.shape)}")
            if len(label) and not (BACKGROUND <= label.min() and label.max() < len(classes)):
                raise ValueError("a label is out of range")
            if about["embedding"] != fingerprint:
                raise ValueError("it is of another embedding")
        return cls(embeddings, label, classes)


def _embed_looks(models: Sequence[EmbeddingNetwork], oriented: LookDescriptors) -> jax.Array:
    return models[0](*oriented.flat).reshape(*oriented.shape, -1)


def _class_views(references: References, n_classes: int, length: int) -> nnx.Variable[jax.Array]:
    """Return the learned blocks [C, n, L] of each class's views, of unit length, or zeros beyond the last view."""
    learned = np.asarray(to_unit_length(jnp.asarray(references.embeddings[:, :length], jnp.float32)))
    of_class = [learned[references.label == label] for label in range(n_classes)]
    padded = np.zeros((n_classes, max(map(len, of_class)), length), np.float32)
    for label, views in enumerate(of_class):
        padded[label, : len(views)] = views
    return nnx.Variable(jnp.asarray(padded))


def _class_probabilities(
    models: Sequence[Any], oriented: LookDescriptors, n_classes: int, n_networks: int, nearest: bool
) -> jax.Array:
    """Return the probabilities [B, n_classes] of the classes, which are the first proxies.

    With `nearest`, the distractors are merged into one column, as if each had the logit of the nearest distractor. If
    `_class_views` follow the networks, the odds of all classes together grow with the similarity of the nearest view of
    the most probable class.
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
        looks, views = learned[0].reshape(*oriented.shape, -1), models[n_networks][...][probabilities.argmax(axis=1)]
        cosines = jnp.einsum("bkl,bnl->bkn", looks, views, precision=HIGHEST)
        similarity = cosines.max(axis=-1, initial=-1).mean(axis=1)
        probabilities *= jnp.exp(VIEW_WEIGHT * (similarity - NEUTRAL_SIMILARITY))[:, None]
        probabilities /= (probabilities.sum(axis=1) + fused[:, n_classes:].sum(axis=1))[:, None]
    return probabilities


def _split(model: EmbeddingNetwork) -> tuple[Any, Any]:
    """Return the graph and the state of a network, with its values as the file stores them."""
    with jax.ensure_compile_time_eval():  # the result is cached, even if the first call is inside a compiled function
        graph, state = nnx.split(model)
        # NumPy converts the values, since JAX would compile a program for each shape.
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
        distractors: number of distractors, whose proxies follow those of the classes.
        further: networks from `create_further`, fitted like `model` from other random weights. `class_probabilities`
            averages all networks, which separates unknown objects more reliably (Lakshminarayanan et al., "Simple and
            Scalable Predictive Uncertainty Estimation using Deep Ensembles", NeurIPS 2017). Only `model` embeds.
        references: embedded views of the classes and of the background, for galleries and, with `sizes.views`, for the
            classification; None in embeddings of earlier versions, whose galleries reject fewer unknown objects. Not
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
            sizes: sizes of the network.
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
        """Return a network for `further` with random weights; it has no colour block, since it does not embed.

        Its weights for the colour statistics are zero, and stay zero in a fit on statistics without colours.
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
    def embed_described(self) -> Callable[[LookDescriptors], jax.Array]:
        """Function from K looks at clouds, `with_balanced`, to embeddings [B, K, D]."""
        return Compiled(_embed_looks, [self._embedder])

    def embed(self, clouds: PointClouds) -> jax.Array:
        """Return the embeddings [B, D] float32 of clouds in metres, each of unit length.

        Each shape [B, N] of the batch compiles once for all embeddings of the same sizes and descriptor.
        """
        return self.embed_oriented(describe_looks(clouds, self.network, self.config, 1), clouds)[:, 0]

    def embed_oriented(self, oriented: LookDescriptors, clouds: PointClouds | None = None) -> jax.Array:
        """Return the embeddings [B, K, D] of K looks at clouds.

        Args:
            oriented: descriptors of the looks, computed with this embedding's config.
            clouds: [B, N] the clouds, whose colours are compared too; None if `oriented` is `with_balanced`.
        """
        if self.sizes.balanced and clouds is not None:
            oriented = oriented.with_balanced(clouds)
        return self.embed_described(oriented)

    @functools.cached_property
    def class_probabilities(self) -> Callable[[LookDescriptors], jax.Array]:
        """Function from K looks at clouds, described by this embedding's descriptor, to class probabilities [B, C].

        The rest to 1 is the probability of the distractors. The probabilities are the geometric mean over the networks
        and over the looks. With `sizes.nearest`, every distractor has the logit of the nearest distractor, for each
        network and look. With `sizes.views`, the odds of all classes are multiplied by
        exp(`VIEW_WEIGHT` (s - `NEUTRAL_SIMILARITY`)) (Sun et al., "Out-of-Distribution Detection with Deep Nearest
        Neighbors", ICML 2022). Here s is the largest cosine between the learned blocks of a look and of a reference
        view of the most probable class, averaged over the looks.
        """
        models = [self._embedder, *map(_split, self.further)]
        static = len(self.classes), len(models), self.sizes.nearest and self.distractors > 0
        if self.sizes.views and self.references is not None:
            with jax.ensure_compile_time_eval():  # as in `_split`; keeps the views on the device
                models.append(nnx.split(_class_views(self.references, len(self.classes), self.sizes.learned)))
        return Compiled(_class_probabilities, models, *static)

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
            arrays |= model_arrays(model, _FURTHER.format(number))
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
        return pack_arrays(arrays, {"embedding": json.dumps(about, sort_keys=True)})

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
        write_bytes(path, self._content)

    @classmethod
    def load(cls, path: str | Path, network: colornet.ColorNetwork | None = None) -> "Embedding":
        """Read an embedding.

        Args:
            path: file that `save` wrote.
            network: colour network that the embedding was fitted with; by default the packaged one.

        Raises:
            InputError: the file is missing or damaged, or its format, descriptor version or colour network does not
                fit. The message names the file.
        """
        path, network = Path(path), network or colornet.load_default()
        advice = "an embedding of this version; copy the whole run directory, or train the run again"
        with decoding(f"embedding: {path} cannot be used", advice):
            content = read_file(path)
            stored, metadata = unpack_arrays(content)
            about = json.loads(metadata["embedding"])
            arrays = {name: array.astype(np.float32) for name, array in stored.items()}
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
            prefixes = map(_FURTHER.format, range(count))
            further = tuple(model_from_arrays(embedding.create_further, arrays, prefix) for prefix in prefixes)
        file = path.with_name(REFERENCES_FILE)
        references = References.load(file, content_digest([content]), embedding.size) if file.is_file() else None
        embedding = dataclasses.replace(embedding, further=further, references=references)
        # The fingerprint is computed from the file itself, which another version of this software may have written.
        embedding.__dict__["_content"] = content
        return embedding


@functools.cache
def load_default() -> Embedding:
    """Return the packaged embedding, trained on procedural objects; `python -m training.embedding.build` fits it."""
    return Embedding.load(Path(__file__).with_name("data") / "embedding.safetensors")
