"""The constants of the descriptor (paper, section "Descriptor computation") in one frozen, hashable record.

>>> DescriptorConfig().n_slices
7
>>> DescriptorConfig(homology="closed_form").homology
'closed_form'
"""

import dataclasses
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any, Literal

from thor2_jax.errors import InputError

__all__ = ["DESCRIPTOR_VERSION", "LOOK_COUNTS", "DescriptorConfig", "Relaxation"]

DESCRIPTOR_VERSION = 1
"""Version of the descriptor's values, stored in every run directory; a run of another version is refused."""

LOOK_COUNTS = (1, 2, 4)
"""Allowed numbers of looks at a cloud; the paper uses 1."""

_CHOICES = {"homology": ("gudhi", "closed_form"), "convention": ("paper", "released"), "looks": LOOK_COUNTS}


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_positive(value: Any) -> bool:
    return _is_finite(value) and value > 0


def _check(config: object, expected: str, is_valid: Callable[[Any], bool], *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if not is_valid(value):
            raise InputError(f"{type(config).__name__}.{name} is {value!r}; expected {expected}")


@dataclasses.dataclass(frozen=True)
class Relaxation:
    """Temperatures of the relaxed descriptor, which approaches the hard one as all four approach zero.

    Attributes:
        slice: width of the sigmoid at the borders of slices, scaled units along z.
        strip: width of the sigmoid at the borders of strips, scaled units along x.
        extremum: temperature of the log-sum-exp over the points of a strip, scaled units along y.
        color: temperature of the softmax over colours, units of the HyAB distance in CIELAB.

    Raises:
        InputError: a temperature is not a positive number; the message names the field and the value.
    """

    slice: float = 0.01
    strip: float = 0.0025
    extremum: float = 0.005
    color: float = 1.0

    def __post_init__(self) -> None:
        _check(self, "a positive number", _is_positive, "slice", "strip", "extremum", "color")


@dataclasses.dataclass(frozen=True)
class DescriptorConfig:
    """Settings of the descriptors TOPS and TOPS2. Static under `jax.jit`: each config compiles once.

    Lengths are in scaled units (metres times `sigma_s`) unless stated otherwise.

    Attributes:
        homology: source of the persistence diagrams, "gudhi" (one host callback for a batch) or "closed_form" (the same
            pairs, computed by JAX).
        convention: "paper" for the paper's equations, "released" for the authors' released code (see `slicing`).
        sigma_s: scaled units per metre.
        sigma_1: thickness of a slice, along z of the aligned cloud.
        sigma_2: width of a strip, along x of the aligned cloud; also the side of a pixel of an image.
        alpha: angle between the long axis of the normalized cloud and the x-y plane, radians.
        n_slices: number of slices; points beyond them are counted in `overflow`.
        n_strips: number of strips in a slice, n_s^max of the paper (31 for UW-IS Occluded, 29 for OCID).
        image_size: pixels along each side of a persistence image; its window starts at -`sigma_2`.
        image_variance: variance of the Gaussian at each point of a diagram.
        persistence_weight: exponent n of the weight persistence**n of a point in an image; 1 in the paper.
        relaxation: temperatures of soft slices, strips, extremes and colours; None for the paper's hard descriptor.
        looks: looks K at a cloud that recognition describes and fuses, one of `LOOK_COUNTS` (see `descriptor.looks`);
            `describe` returns the first one only.

    Raises:
        InputError: a value is out of range; the message names the field and the value.
    """

    homology: Literal["gudhi", "closed_form"] = "gudhi"
    convention: Literal["paper", "released"] = "paper"
    sigma_s: float = 2.5
    sigma_1: float = 0.1
    sigma_2: float = 0.025
    alpha: float = math.pi / 4
    n_slices: int = 7
    n_strips: int = 31
    image_size: int = 32
    image_variance: float = 0.00025
    persistence_weight: float = 1.0
    relaxation: Relaxation | None = None
    looks: int = 1

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            _check(self, f"one of {allowed}", allowed.__contains__, name)
        numbers = "sigma_s", "sigma_1", "sigma_2", "image_variance", "persistence_weight"
        _check(self, "a positive number", _is_positive, *numbers)
        counts = "n_slices", "n_strips", "image_size"
        _check(self, "a positive integer", lambda value: type(value) is int and value > 0, *counts)
        _check(self, "radians, at most 2 pi", lambda value: _is_finite(value) and abs(value) <= math.tau, "alpha")
        _check(self, "a Relaxation or None", lambda value: isinstance(value, Relaxation | None), "relaxation")
        fixed = {"relaxation": None, "sigma_1": 0.1, "sigma_2": 0.025} if self.convention == "released" else {}
        for name, value in fixed.items():
            _check(self, f"{value} in the released convention", (value,).__contains__, name)

    @classmethod
    def released(cls, **changes: Any) -> "DescriptorConfig":
        """Return a config with the convention of the authors' released code, for the same aligned clouds.

        Coordinates x and y are rounded to 0.01 and z to 0.1, half to even. Slices are the levels of z that occur,
        renumbered from 0. A strip is numbered by, and born at, its upper edge. Colour vectors are divided by the number
        of points of their strip.

        Args:
            changes: other fields of the config.
        """
        return cls(convention="released", **changes)

    @classmethod
    def of_record(cls, constants: Mapping[str, Any]) -> "DescriptorConfig":
        """Return the config of a stored record (from `dataclasses.asdict`); records of version 0.1 have no looks.

        Raises:
            TypeError, KeyError: a constant is unknown or missing.
            InputError: a value is out of range.
        """
        stored = dict(constants)
        relaxation = stored.pop("relaxation")
        if "orientations" in stored:  # from an earlier version, whose first two orientations are the first two looks
            orientations = stored.pop("orientations")
            stored["looks"] = 2 if orientations == 4 else orientations
        return cls(**stored, relaxation=None if relaxation is None else Relaxation(**relaxation))

    @property
    def window(self) -> float:
        """Upper end of the axes of an image, the largest persistence that it covers, in scaled units (0.775)."""
        return (self.image_size - 1) * self.sigma_2
