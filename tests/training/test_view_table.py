"""Tables of training views, by classifiers with random weights."""

import numpy as np
from refusals import assert_refused
from small_runs import untrained_run

from thor2_jax.recognizer import Recognizer
from training.objects.builtin_objects import builtin_objects
from training.view_table import view_table


def test_the_table_has_views_of_the_trained_classes_only() -> None:
    objects = builtin_objects()
    known, other = list(objects)[:2]
    recognizer = Recognizer(untrained_run((known, "another")))
    table = view_table(recognizer, {known: objects[known], other: objects[other]})
    assert table.label.tolist() == [0] * 16 and len(table.rotations) == len(table.probabilities) == 16
    np.testing.assert_allclose(table.probabilities.sum(axis=1), 1, rtol=1e-5)
    products = table.rotations @ table.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (16, 1, 1)), atol=1e-9)
    assert (table.rotations[:, 2, 2] < 0).all()  # all cameras look down
    assert_refused("none of the classes", view_table, recognizer, {other: objects[other]})
