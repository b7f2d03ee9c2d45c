"""Constants of the descriptor: default and rejected values."""

import dataclasses
import json
import math
import re

import pytest
from helpers import input_error

from thor2_jax import DescriptorConfig, InputError, Relaxation


def test_the_papers_constants() -> None:
    config = DescriptorConfig()
    assert (config.sigma_s, config.sigma_1, config.sigma_2) == (2.5, 0.1, 0.025)
    assert (config.n_slices, config.n_strips, config.image_size, config.image_variance) == (7, 31, 32, 0.00025)
    assert config.alpha == math.pi / 4
    assert (config.homology, config.convention) == ("gudhi", "paper")
    assert config.persistence_weight == 1 and config.relaxation is None
    assert config.window == pytest.approx(0.775)


def test_released_changes_only_the_convention() -> None:
    assert DescriptorConfig.released() == dataclasses.replace(DescriptorConfig(), convention="released")
    assert DescriptorConfig.released(homology="closed_form", n_strips=29).n_strips == 29


def test_frozen_and_hashable() -> None:
    config = DescriptorConfig()
    assert hash(config) == hash(DescriptorConfig()) and config == DescriptorConfig()
    assert config != DescriptorConfig(homology="closed_form")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.sigma_s = 1.0  # type: ignore[misc]


INVALID = [
    *[(name, "ripser") for name in ("homology", "convention")],
    *[
        (name, value)
        for name in ("sigma_s", "sigma_1", "sigma_2", "image_variance", "persistence_weight")
        for value in (0, -1.0, math.nan, math.inf, "2.5", None, True)
    ],
    *[(name, value) for name in ("n_slices", "n_strips", "image_size") for value in (0, -1, 7.0, "7", True)],
    *[("alpha", value) for value in (math.nan, -math.inf, "45", None)],
    *[("relaxation", value) for value in (0.1, "soft", {"slice": 0.1})],
]


@pytest.mark.parametrize(("name", "value"), INVALID)
def test_invalid_values_are_rejected_by_name(name: str, value: object) -> None:
    with input_error(f"DescriptorConfig.{name}", repr(value)):
        DescriptorConfig(**{name: value})


def test_released_convention_fixes_the_widths() -> None:
    with pytest.raises(InputError, match=r"sigma_1, sigma_2 are 0\.2, 0\.025"):
        DescriptorConfig.released(sigma_1=0.2)
    with pytest.raises(InputError, match=r"sigma_1, sigma_2 are 0\.1, 0\.05"):
        DescriptorConfig.released(sigma_2=0.05)


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Relaxation)])
@pytest.mark.parametrize("value", [0, -1.0, math.nan, math.inf, "1", None, True])
def test_invalid_temperatures_are_rejected_by_name(name: str, value: object) -> None:
    with input_error(f"Relaxation.{name}", repr(value)):
        Relaxation(**{name: value})


def test_relaxed_configs_are_hashable_and_differ() -> None:
    relaxed = DescriptorConfig(relaxation=Relaxation(color=2.0))
    assert hash(relaxed) == hash(DescriptorConfig(relaxation=Relaxation(color=2.0)))
    assert len({relaxed, DescriptorConfig(), DescriptorConfig(relaxation=Relaxation())}) == 3


def test_released_convention_cannot_be_relaxed() -> None:
    with pytest.raises(InputError, match="relaxation is Relaxation"):
        DescriptorConfig.released(relaxation=Relaxation())


@pytest.mark.parametrize(
    ("record", "name"), [(DescriptorConfig, "sigma_s"), (DescriptorConfig, "alpha"), (Relaxation, "color")]
)
def test_integers_beyond_the_largest_float_are_rejected(record: type, name: str) -> None:
    with pytest.raises(InputError, match=f"{name} is 1000"):
        record(**{name: 10**400})


def stored(**changes: object) -> dict[str, object]:
    """Return the record of a config as JSON holds it, with some constants changed; None removes one."""
    record = json.loads(json.dumps(dataclasses.asdict(DescriptorConfig()))) | changes
    return {name: value for name, value in record.items() if value is not None or name == "relaxation"}


@pytest.mark.parametrize(
    ("changes", "looks"),
    [
        ({}, 1),
        ({"looks": 4}, 4),
        ({"looks": None}, 1),
        *(({"looks": None, "orientations": k}, expected) for k, expected in ((1, 1), (2, 2), (4, 2))),
    ],
    ids=str,
)
def test_stored_configs_have_their_looks(changes: dict[str, object], looks: int) -> None:
    record = stored(**changes)
    before = dict(record)
    assert DescriptorConfig.of_record(record) == DescriptorConfig(looks=looks)  # type: ignore[arg-type]
    assert record == before


def test_a_stored_relaxation_is_read() -> None:
    config = DescriptorConfig(relaxation=Relaxation(slice=0.5), looks=2)
    assert DescriptorConfig.of_record(json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.parametrize("name", ["looks", "orientations"])
@pytest.mark.parametrize("value", [0, 3, 5, -1, "2", [2], {}])
def test_bad_stored_looks_are_refused(name: str, value: object) -> None:
    with pytest.raises(InputError, match=re.escape(f"DescriptorConfig.looks is {value!r}")):
        DescriptorConfig.of_record(stored(**{"looks": None, name: value}))


def test_unknown_and_missing_constants_are_refused() -> None:
    with pytest.raises(TypeError, match="turns"):
        DescriptorConfig.of_record(stored(turns=2))
    record = stored()
    del record["relaxation"]
    with pytest.raises(KeyError, match="relaxation"):
        DescriptorConfig.of_record(record)
