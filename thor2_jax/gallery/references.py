"""Reference views: embedded views of the classes of a run and of the background, objects that are none of its names.

They take part in the regression of a gallery (`Gallery.scores`), so that an enrolled object is recognized by what
distinguishes it from them, and a gallery with a single object already knows what is unknown. With
`EmbeddingSizes.views`, those of the classes also take part in the classification (`Embedding.class_probabilities`).
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from thor2_jax.errors import decoding
from thor2_jax.files import atomic_write, open_file

__all__ = ["BACKGROUND", "REFERENCES_FILE", "References"]

REFERENCES_FILE = "references.safetensors"
"""References of the embedding in the same directory."""

BACKGROUND = -1
"""Label of views of the background."""

_METADATA = "references"


@dataclasses.dataclass(frozen=True, eq=False)
class References:
    """Embedded views that no one enrolled.

    Attributes:
        embeddings: [n, D] float16, of unit length.
        label: [n] int32, index into `classes`, or `BACKGROUND`.
        classes: names of the classes.
    """

    embeddings: NDArray[np.float16]
    label: NDArray[np.int32]
    classes: tuple[str, ...] = ()

    def save(self, path: Path, fingerprint: str) -> None:
        """Write the references of the embedding with this fingerprint, atomically; raises OSError if that fails."""
        about = {"embedding": fingerprint, "classes": list(self.classes)}
        metadata = {_METADATA: json.dumps(about, sort_keys=True)}
        content = safetensors.numpy.save({"embeddings": self.embeddings, "label": self.label}, metadata)
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)

    @classmethod
    def load(cls, path: Path, fingerprint: str, size: int) -> "References":
        """Read the references of the embedding with this fingerprint and of this length D.

        Raises:
            InputError: the file is missing or damaged, or of another embedding. The message names the file.
        """
        expected = "the views of the embedding beside it; copy both files, or train the run again"
        with decoding(f"embedding: {path} cannot be used", expected):
            open_file(path).close()
            with safetensors.safe_open(path, "numpy") as stored:
                about = json.loads(stored.metadata()[_METADATA])
                embeddings, label = stored.get_tensor("embeddings"), stored.get_tensor("label")
            classes = tuple(map(str, about["classes"]))
            if (embeddings.shape, embeddings.dtype) != ((len(label), size), np.float16) or label.dtype != np.int32:
                raise ValueError(f"embeddings are {embeddings.dtype} {list(embeddings.shape)}")
            if len(label) and not (BACKGROUND <= label.min() and label.max() < len(classes)):
                raise ValueError("a label is out of range")
            if about["embedding"] != fingerprint:
                raise ValueError("it is of another embedding")
        return cls(embeddings, label, classes)
