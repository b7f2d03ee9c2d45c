"""Plots: they show the given values on the given axes."""

from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from refusals import assert_refused
from small_clouds import CLOSED, NETWORK

import thor2_jax as thor2
from thor2_jax import plot

RNG = np.random.default_rng(0)
POINTS = (RNG.random((300, 3)) * (0.2, 0.1, 0.05) + (0, 0, 1)).astype(np.float32)
COLORS = RNG.integers(0, 256, (300, 3), np.uint8)


@pytest.fixture
def ax() -> Iterator[Axes]:
    """Axes, which are rendered after the test."""
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    yield figure.add_subplot()
    canvas.draw()


def test_cloud_is_seen_by_the_camera(ax) -> None:
    drawn = plot.cloud(ax, POINTS, COLORS)
    offsets, faces = drawn.get_offsets(), drawn.get_facecolors()
    far_first = np.argsort(-POINTS[:, 2], kind="stable")
    np.testing.assert_allclose(offsets, POINTS[far_first, :2])
    np.testing.assert_allclose(faces[:, :3], COLORS[far_first] / 255)
    assert ax.yaxis_inverted()
    plot.cloud(ax, POINTS, COLORS)  # A second cloud does not turn the axis back.
    assert ax.yaxis_inverted()
    assert_refused("colors is int64", plot.cloud, ax, POINTS, COLORS.astype(np.int64))


def test_values_replace_the_colors(ax) -> None:
    values = np.linspace(-1, 1, 300)
    drawn = plot.cloud(ax, POINTS, COLORS, values)
    order = np.argsort(np.abs(values), kind="stable")  # large values are drawn last, and larger
    np.testing.assert_allclose(drawn.get_offsets(), POINTS[order, :2])
    np.testing.assert_allclose(np.sort(drawn.get_sizes()), drawn.get_sizes())
    faces = drawn.get_facecolors()[np.argsort(order)]
    assert faces[0, 2] > faces[0, 0] and faces[-1, 0] > faces[-1, 2]  # blue against, orange for
    assert np.ptp(faces[150, :3]) < 0.03
    assert_refused("values", plot.cloud, ax, POINTS, COLORS, values[:-1])
    scale = plot.attribution_colors([0.0] * 97 + [1.0, 2.0, 1000.0])
    assert scale.norm.vmin == -scale.norm.vmax and 0 < scale.norm.vmax < 1000
    assert plot.attribution_colors([0.0, 0.0]).norm.vmax > 0 and plot.attribution_colors([]).norm.vmax > 0


def test_slices_have_borders_and_leave_out_points_without_a_place(ax) -> None:
    aligned = thor2.align(thor2.PointClouds.pack([(POINTS, COLORS)]), CLOSED)
    plot.slices(ax, *aligned.unpack()[0], CLOSED, strips=True)
    levels = sorted({float(line.get_ydata()[0]) for line in ax.lines if len(set(line.get_ydata())) == 1})
    top = float(aligned.points[..., 2].max())
    np.testing.assert_allclose(levels, np.arange(int(top / 0.1) + 2) * 0.1)
    assert [text.get_text() for text in ax.texts] == [str(i) for i in range(len(levels) - 1)]
    plot.slices(ax, np.where(np.arange(len(POINTS))[:, None] < 2, np.nan, POINTS), COLORS, CLOSED)
    assert len(ax.texts) == len(levels) - 1 + CLOSED.n_slices


def test_diagram_has_every_pair(ax) -> None:
    clouds = thor2.PointClouds.pack([(POINTS, COLORS)])
    diagrams = thor2.diagrams(thor2.align(clouds, CLOSED), CLOSED)
    one = thor2.Diagrams(diagrams.births[0], diagrams.deaths[0], diagrams.mask[0])
    plot.persistence_diagram(ax, one, CLOSED)
    drawn = np.concatenate([line.get_xydata() for line in ax.lines if line.get_marker() == "o"])
    mask = np.asarray(one.mask)
    expected = np.column_stack([np.asarray(one.births)[mask], np.asarray(one.deaths)[mask]])
    np.testing.assert_array_equal(drawn, expected)
    assert_refused("diagrams", plot.persistence_diagram, ax, diagrams, CLOSED)


def test_image_has_birth_to_the_right(ax) -> None:
    image = np.zeros((32, 32))
    image[20, 5] = 1  # birth 20, persistence 5
    drawn = plot.persistence_image(ax, image, CLOSED)
    assert drawn.get_array()[5, 20] == 1
    np.testing.assert_allclose(drawn.get_extent(), (-0.025, 0.775, -0.025, 0.775))
    assert_refused("image", plot.persistence_image, ax, image[:31], CLOSED)


def test_color_matrix_has_mean_colors(ax) -> None:
    matrix = np.zeros((31, 22))
    matrix[3, 4], matrix[3, 7] = 16, 4
    plot.color_matrix(ax, matrix, NETWORK)
    cells = ax.images[0].get_array()
    assert cells.shape == (2, 31, 4)
    np.testing.assert_allclose(cells[:, 3, :3], NETWORK.mean_rgb[[4, 7]] / 255)
    np.testing.assert_allclose(cells[:, 3, 3], [1, 0.5])
    assert (np.delete(cells[..., 3], 3, axis=1) == 0).all()
    assert [label.get_text() for label in ax.get_yticklabels()] == ["4", "7"]
    assert_refused("matrix", plot.color_matrix, ax, matrix.T, NETWORK)
    for region in (-1, NETWORK.n_regions, [1], "1st"):
        assert_refused("regions is", plot.color_matrix, ax, matrix, NETWORK, regions=[region])


def test_bars_add_up_to_the_points(ax) -> None:
    matrix = RNG.integers(0, 5, (31, 22)).astype(float)
    plot.color_vectors(ax, matrix, NETWORK)
    tops: dict[float, float] = {}
    for bar in ax.patches:
        centre = bar.get_x() + bar.get_width() / 2
        tops[round(centre)] = max(tops.get(round(centre), 0), bar.get_y() + bar.get_height())
    np.testing.assert_allclose([tops[j] for j in range(31)], matrix.sum(axis=1))


def test_network_emphasizes_used_regions(ax) -> None:
    weights = np.zeros(22)
    weights[[2, 9]] = 30, 10
    plot.color_network(ax, NETWORK, weights)
    faces = {tuple(np.round(collection.get_facecolors()[0][:3], 4)) for collection in ax.collections}
    for region in range(22):
        assert (tuple(np.round(NETWORK.mean_rgb[region] / 255, 4)) in faces) == (region in (2, 9))
    for wrong in (weights[:-1], -weights):
        assert_refused("weights", plot.color_network, ax, NETWORK, wrong)


def test_confusion_shows_the_counts(ax) -> None:
    plot.confusion(ax, [[3, 1, 0], [0, 2, 0]], ("a", "b"))
    assert {(t.get_position(), t.get_text()) for t in ax.texts} == {((0, 0), "3"), ((1, 0), "1"), ((1, 1), "2")}
    np.testing.assert_allclose(ax.images[0].get_array(), [[0.75, 0.25], [0, 1]])  # the empty last column is left out
    assert_refused("counts", plot.confusion, ax, np.zeros((3, 2)), ("a", "b"))
    plot.confusion(ax, np.eye(2), [4, 7])
    assert [label.get_text() for label in ax.get_xticklabels()] == ["4", "7"]


def test_reliability_draws_accuracy_and_counts() -> None:
    upper, lower = Figure().subplots(2)
    plot.reliability(upper, {"answers": [0, 4], "accuracy": [None, 0.75]}, counts=lower)
    assert [bar.get_height() for bar in lower.patches] == [0, 4]
    assert upper.patches[1].get_height() == 0.75 and upper.patches[1].get_x() == 0.5
    assert lower.get_xlabel() == "confidence" and not upper.get_xlabel()


def test_input_that_cannot_be_drawn_is_refused(ax) -> None:
    assert_refused(r"points is \[300, 2\]", plot.cloud, ax, POINTS[:, :2], COLORS)
    assert_refused(r"colors is \[2, 3\]; expected \[300, 3\]", plot.cloud, ax, POINTS, COLORS[:2])
    assert_refused("points is .*numbers", plot.cloud, ax, [[1.0, 2.0, 3.0], [1.0]], COLORS[:2])
    assert_refused("points is .*masked", plot.cloud, ax, np.ma.masked_less(POINTS, 0.1), COLORS)
    assert_refused("values is .*numbers", plot.cloud, ax, POINTS, COLORS, ["red"] * len(POINTS))
    assert_refused("values is .*numbers", plot.attribution_colors, ["red"])
    assert_refused("config is of type NoneType", plot.slices, ax, POINTS, COLORS, None)
    assert_refused("diagrams is of type ndarray", plot.persistence_diagram, ax, np.zeros((7, 2)), CLOSED)
    assert_refused("config is of type ColorNetwork", plot.persistence_image, ax, np.zeros((32, 32)), NETWORK)
    assert_refused("network is of type ndarray", plot.color_matrix, ax, NETWORK, np.zeros((31, 22)))
    assert_refused("matrix is 'red'", plot.color_vectors, ax, "red", NETWORK)
    assert_refused("weights is .nan", plot.color_network, ax, NETWORK, np.full(22, np.nan))
    assert_refused("counts is .*numbers", plot.confusion, ax, [[1, 2], [3]], "ab")
    assert_refused("bins is", plot.reliability, ax, {"answers": [], "accuracy": []})
    assert_refused("bins is", plot.reliability, ax, {"answers": [3, 5], "accuracy": [0.5]})
