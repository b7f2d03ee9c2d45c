"""Constants of the descriptor (paper, section "Descriptor computation"), in one frozen, hashable record.

>>> DescriptorConfig().n_slices
7
>>> DescriptorConfig(homology="closed_form").homology
'closed_form'
"""

import dataclasses
import math
from typing import Any, Literal

from thor2_jax.errors import InputError

__all__ = ["DESCRIPTOR_VERSION", "DescriptorConfig", "Relaxation"]

DESCRIPTOR_VERSION = 1
"""Raised by one with every change that alters a descriptor's values; stored in run folders, which refuse to mix."""

_CHOICES = {"homology": ("gudhi", "closed_form"), "convention": ("paper", "released")}


def _is_finite(value: object) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer past the largest float
        return False


@dataclasses.dataclass(frozen=True)
class Relaxation:
    """Temperatures of the soft descriptor (`relaxation`). Towards zero, all together, it becomes the hard one.

    Attributes:
        slice: width of the sigmoid at a slice's borders, scaled units along z.
        strip: width of the sigmoid at a strip's borders, scaled units along x.
        extremum: of the log-sum-exp over a strip's points, scaled units along y.
        color: of the softmax over colours, units of the HyAB distance in CIELAB.

    Raises:
        InputError: a temperature that is no positive number, naming the field and the value.
    """

    slice: float = 0.01
    strip: float = 0.0025
    extremum: float = 0.005
    color: float = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (_is_finite(value) and value > 0):
                raise InputError(f"Relaxation.{field.name} is {value!r}; it must be a positive number")


@dataclasses.dataclass(frozen=True)
class DescriptorConfig:
    """What turns a coloured cloud into TOPS and TOPS2. Static under jit: another config is another compilation.

    Lengths are scaled units (metres x `sigma_s`) unless said otherwise.

    Attributes:
        homology: where persistence diagrams come from: gudhi through one host callback a batch, or the same pairs in
            JAX.
        convention: the paper's equations, or those of the authors' released code (see `released`).
        sigma_s: scaled units per metre.
        sigma_1: thickness of a slice (along z of the aligned cloud).
        sigma_2: width of a strip (along x of the aligned cloud); also the side of an image's pixel.
        alpha: angle in radians between the normalized cloud's long axis and the x-y plane.
        n_slices: slices kept in a descriptor; points beyond count as overflow.
        n_strips: strips kept in a slice, n_s^max of the paper (31 for UW-IS Occluded, 29 for OCID).
        image_size: pixels along either side of a persistence image; the window starts at -`sigma_2`.
        image_variance: variance of the Gaussian at each point of a diagram.
        persistence_weight: exponent n of a point's weight in an image, persistence**n; the paper's is 1.
        relaxation: temperatures of soft slices, strips, extremes and colours; None is the paper's hard descriptor.

    Raises:
        InputError: a value out of its range, naming the field and the value.
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

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"DescriptorConfig.{name} is {getattr(self, name)!r}; it must be one of {allowed}")
        for name in ("sigma_s", "sigma_1", "sigma_2", "image_variance", "persistence_weight"):
            if not (_is_finite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"DescriptorConfig.{name} is {getattr(self, name)!r}; it must be a positive number")
        for name in ("n_slices", "n_strips", "image_size"):
            if type(getattr(self, name)) is not int or getattr(self, name) < 1:
                raise InputError(f"DescriptorConfig.{name} is {getattr(self, name)!r}; it must be a positive integer")
        if not _is_finite(self.alpha):
            raise InputError(f"DescriptorConfig.alpha is {self.alpha!r}; it must be a finite angle in radians")
        if not (self.relaxation is None or isinstance(self.relaxation, Relaxation)):
            raise InputError(f"DescriptorConfig.relaxation is {self.relaxation!r}; it must be a Relaxation or None")
        if self.convention == "released" and self.relaxation is not None:
            raise InputError(
                f"DescriptorConfig.relaxation is {self.relaxation}; the released convention rounds and has no soft form"
            )
        if self.convention == "released" and (self.sigma_1, self.sigma_2) != (0.1, 0.025):
            raise InputError(
                f"DescriptorConfig.sigma_1, sigma_2 are {self.sigma_1}, {self.sigma_2}; the released convention rounds "
                "to 0.1 and 0.01 and holds for 0.1 and 0.025 only"
            )

    @classmethod
    def released(cls, **changes: Any) -> "DescriptorConfig":
        """The conventions of the authors' released code, on the same aligned cloud.

        x and y rounded to 0.01 and z to 0.1 (half to even); slices are the occurring z levels, renumbered from 0; a
        strip is numbered, and born, at its upper bin edge; colour vectors are divided by their strip's number of
        points.
        """
        return cls(convention="released", **changes)

    @property
    def window(self) -> float:
        """Upper end of an image's axes: largest persistence that an image shows, in scaled units (0.775)."""
        return (self.image_size - 1) * self.sigma_2
