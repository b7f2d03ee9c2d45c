"""Constants of the descriptor: default and rejected values."""

import dataclasses
import json
import math
import re

import pytest
from refusals import assert_refused

from thor2_jax import DescriptorConfig, Relaxation


def test_the_papers_constants() -> None:
    constants = ("gudhi", "paper", 2.5, 0.1, 0.025, math.pi / 4, 7, 31, 32, 0.00025, 1, None, 1)
    assert dataclasses.astuple(DescriptorConfig()) == constants
    assert DescriptorConfig().window == pytest.approx(0.775)


def test_released_changes_only_the_convention() -> None:
    assert DescriptorConfig.released() == dataclasses.replace(DescriptorConfig(), convention="released")
    assert DescriptorConfig.released(homology="closed_form", n_strips=29).n_strips == 29


NO_POSITIVE_NUMBERS = (0, -1.0, math.nan, math.inf, "2.5", None, True, 10**400)
INVALID = [
    *[(DescriptorConfig, name, "ripser") for name in ("homology", "convention")],
    *[(DescriptorConfig, "looks", value) for value in (0, 3, 5, -1, "2", [2], {})],
    *[
        (DescriptorConfig, name, value)
        for name in ("sigma_s", "sigma_1", "sigma_2", "image_variance", "persistence_weight")
        for value in NO_POSITIVE_NUMBERS
    ],
    *[(DescriptorConfig, name, v) for name in ("n_slices", "n_strips", "image_size") for v in (0, -1, 7.0, "7", True)],
    *[(DescriptorConfig, "alpha", value) for value in (math.nan, -math.inf, "45", 45, None, 10**400)],
    *[(DescriptorConfig, "relaxation", value) for value in (0.1, "soft", {"slice": 0.1})],
    *[(Relaxation, field.name, value) for field in dataclasses.fields(Relaxation) for value in NO_POSITIVE_NUMBERS],
]


@pytest.mark.parametrize(("record", "name", "value"), INVALID, ids=lambda value: str(value)[:40])
def test_invalid_values_are_rejected_by_name(record: type, name: str, value: object) -> None:
    assert_refused(rf"{record.__name__}\.{name}.*{re.escape(repr(value))}", record, **{name: value})


def test_released_convention_fixes_the_widths_and_borders() -> None:
    assert_refused(r"sigma_1 is 0\.2; expected 0\.1 ", DescriptorConfig.released, sigma_1=0.2)
    assert_refused(r"sigma_2 is 0\.05; expected 0\.025 ", DescriptorConfig.released, sigma_2=0.05)
    assert_refused("relaxation is Relaxation", DescriptorConfig.released, relaxation=Relaxation())


def stored_without(constant: str) -> dict[str, object]:
    """Return the record of a config without one of its constants."""
    return {name: value for name, value in dataclasses.asdict(DescriptorConfig()).items() if name != constant}


@pytest.mark.parametrize("config", [DescriptorConfig(looks=4), DescriptorConfig(relaxation=Relaxation(slice=0.5))])
def test_a_stored_config_is_read(config: DescriptorConfig) -> None:
    assert DescriptorConfig.of_record(json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.parametrize(("orientations", "looks"), [(1, 1), (2, 2), (4, 2)])
def test_configs_stored_by_earlier_versions_have_their_looks(orientations: int, looks: int) -> None:
    assert DescriptorConfig.of_record(stored_without("looks")) == DescriptorConfig(looks=1)
    record = stored_without("looks") | {"orientations": orientations}
    before = dict(record)
    assert DescriptorConfig.of_record(record) == DescriptorConfig(looks=looks)  # type: ignore[arg-type]
    assert record == before
    assert_refused(r"DescriptorConfig.looks is \[2\]", DescriptorConfig.of_record, record | {"orientations": [2]})


def test_unknown_and_missing_constants_are_refused() -> None:
    with pytest.raises(TypeError, match="turns"):
        DescriptorConfig.of_record(dataclasses.asdict(DescriptorConfig()) | {"turns": 2})
    with pytest.raises(KeyError, match="relaxation"):
        DescriptorConfig.of_record(stored_without("relaxation"))
