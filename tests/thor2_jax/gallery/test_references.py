"""The file of reference views."""

from pathlib import Path

import numpy as np
from numpy.testing import assert_array_equal
from refusals import assert_refused

from thor2_jax.gallery.embedding import BACKGROUND, REFERENCES_FILE, Embedding, References, load_default

VIEWS = np.eye(4, dtype=np.float16)[[0, 1, 2]]
REFERENCES = References(VIEWS, np.array([0, 1, BACKGROUND], np.int32), ("mug", "bowl"))


def test_references_are_read_as_written(tmp_path: Path) -> None:
    REFERENCES.save(tmp_path / "r", "print")
    loaded = References.load(tmp_path / "r", "print", 4)
    assert_array_equal(loaded.embeddings, VIEWS)
    assert_array_equal(loaded.label, REFERENCES.label)
    assert loaded.classes == ("mug", "bowl")


def test_references_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r"
    REFERENCES.save(path, "print")
    for fingerprint, size, message in (
        ("other", 4, "of another embedding.*copy both files"),
        ("print", 5, "embeddings are float16"),
    ):
        assert_refused(message, References.load, path, fingerprint, size)
    path.write_bytes(path.read_bytes()[:-3])
    assert_refused("cannot be used", References.load, path, "print", 4)
    References(VIEWS, np.array([0, 1, 2], np.int32), ("mug", "bowl")).save(path, "print")
    assert_refused("out of range", References.load, path, "print", 4)


def test_an_embedding_keeps_its_references_beside_it(tmp_path: Path) -> None:
    packaged = load_default()
    assert packaged.references is not None and packaged.references.embeddings.shape == (1024, packaged.size)
    assert (packaged.references.label == BACKGROUND).all() and packaged.references.classes == ()
    packaged.save(tmp_path / "embedding.safetensors")
    loaded = Embedding.load(tmp_path / "embedding.safetensors")
    assert loaded.fingerprint == packaged.fingerprint and loaded.references is not None
    assert_array_equal(loaded.references.embeddings, packaged.references.embeddings)
    (tmp_path / REFERENCES_FILE).unlink()
    assert Embedding.load(tmp_path / "embedding.safetensors").references is None
