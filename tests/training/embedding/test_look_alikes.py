"""Look-alikes: the shape of one class in the colours of another."""

import numpy as np

from training.embedding.look_alikes import LEAST_TURN, look_alike, painted


def random_colors(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 3), dtype=np.uint8)


def brightness(colors: np.ndarray) -> np.ndarray:
    return colors.astype(float) @ [0.299, 0.587, 0.114]


def test_light_and_dark_parts_stay_where_they_are() -> None:
    before, colors = random_colors(50, 0), random_colors(50, 1)
    after = painted(before, colors, 0.0)
    assert sorted(map(tuple, after)) == sorted(map(tuple, colors))
    assert np.array_equal(np.argsort(brightness(after)), np.argsort(brightness(before)))
    fewer, more = painted(before, colors[:10], 0.0), painted(before[:10], colors, 0.0)
    assert {tuple(c) for c in fewer} == {tuple(c) for c in colors[:10]}
    assert np.array_equal(np.argsort(brightness(more)), np.argsort(brightness(before[:10])))


def test_a_third_of_a_turn_exchanges_the_channels() -> None:
    colors = random_colors(20, 2)
    turned = painted(colors, colors, 2 * np.pi / 3).astype(int)
    assert np.abs(turned - np.roll(colors, 1, axis=1)).max() <= 1
    grey = np.full((5, 3), 90, np.uint8)
    assert np.abs(painted(colors[:5], grey, 1.0).astype(int) - grey).max() <= 1


def test_a_look_alike_has_the_shape_of_its_class_and_one_turn_of_the_hue() -> None:
    rng = np.random.default_rng(3)
    clouds = [(rng.random((30, 3)).astype(np.float32), random_colors(30, seed)) for seed in range(3)]
    red = [(cloud[0], np.full((30, 3), (200, 60, 60), np.uint8)) for cloud in clouds]
    views = look_alike(clouds, red, 6, np.random.default_rng(4))
    assert len(views) == 6
    assert all(any(xyz is cloud[0] for cloud in clouds) for xyz, _ in views)
    assert len({tuple(color) for _, rgb in views for color in rgb}) == 1
    angle = np.random.default_rng(4).uniform(LEAST_TURN, 2 * np.pi - LEAST_TURN)
    assert np.array_equal(views[0][1], painted(clouds[0][1], red[0][1], angle))
    assert np.abs(views[0][1][0].astype(int) - (200, 60, 60)).max() > 40
