"""Protocols: their epochs, and whether they fit an embedding."""

import dataclasses
from pathlib import Path

import pytest

from thor2_jax.networks import FEATURES
from training.embedding.distractors import Distractors
from training.protocol import DEFAULT, PAPER, QUICK, Protocol

MESHES = {"mug": Path("mug.ply")}


def test_epochs_are_also_those_of_the_embedding() -> None:
    own = DEFAULT.replace(epochs=3)
    assert own.fit.epochs == 3 and own.distractors == dataclasses.replace(DEFAULT.distractors, epochs=3)
    for protocol in (DEFAULT, PAPER):
        given = protocol.replace(distractors=Distractors(procedural=50), epochs=3)
        assert given.distractors == Distractors(procedural=50, epochs=3)
    assert PAPER.replace(epochs=3).distractors is None


@pytest.mark.parametrize(
    ("protocol", "procedural", "fitted"),
    [(DEFAULT, None, 1500), (QUICK, None, 600), (DEFAULT, 20, 20), (PAPER, 20, 20)],
)
def test_the_number_of_distractors(protocol: Protocol, procedural: int | None, fitted: int) -> None:
    chosen = protocol.with_distractors(procedural, MESHES, workers=2)
    own = protocol.distractors or Distractors()
    assert chosen.distractors == dataclasses.replace(own, procedural=fitted, meshes=MESHES, workers=2)
    assert chosen.classifiers == protocol.classifiers


def test_without_an_embedding_there_are_classifiers() -> None:
    assert PAPER.with_distractors(None, {}, 1) == PAPER
    for protocol in (DEFAULT, QUICK):
        without = protocol.with_distractors(0, {}, 1)
        assert without.distractors is None and without.classifiers == FEATURES
