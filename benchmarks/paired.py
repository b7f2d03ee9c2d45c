"""Paired comparison of two methods on the same instances: difference of their accuracies with confidence interval.

The interval and the test use placements instead of instances, since neighbouring frames of a video are nearly equal. A
placement is an object that does not move. The interval is a bootstrap over placements, and McNemar's exact test counts
the placements on which one of the methods is better.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

__all__ = ["PairedDifference", "paired_difference"]

RESAMPLES = 9999
LEVEL = 0.95
SIGNIFICANCE = 0.05


@dataclasses.dataclass(frozen=True)
class PairedDifference:
    """The accuracy of one method minus the accuracy of another method.

    Attributes:
        difference: difference over the instances, as the mean over the folds.
        low: lower end of the 95 % interval.
        high: upper end of the 95 % interval.
        better: number of placements on which the first method is better, in the mean over the folds.
        worse: number of placements on which the first method is worse.
        p_value: p-value of McNemar's exact test, two-sided; 1 if no placement differs.
        instances: number of instances.
        placements: number of placements.
    """

    difference: float
    low: float
    high: float
    better: int
    worse: int
    p_value: float
    instances: int
    placements: int

    @property
    def verdict(self) -> str:
        """Return "holds" or "does not hold" if the whole interval is above or below 0 and the test agrees.

        Otherwise, return "undecided". The test is needed, since the interval is too narrow if a few placements all
        differ in the same way.
        """
        if self.p_value >= SIGNIFICANCE or self.low <= 0 <= self.high:
            return "undecided"
        return "holds" if self.low > 0 else "does not hold"


def _ratio(total: NDArray[Any], count: NDArray[Any], axis: int = -1) -> NDArray[Any]:
    return np.asarray(total.sum(axis=axis) / count.sum(axis=axis))


def paired_difference(
    first: NDArray[Any], second: NDArray[Any], placement: NDArray[np.integer[Any]], seed: int = 0
) -> PairedDifference:
    """Compare two methods on the same instances.

    Args:
        first: [F, N], whether the first method is correct on each of N instances, for each of F folds.
        second: [F, N], whether the second method is correct.
        placement: [N] int, the placement of each instance; at least one instance.
        seed: seed for the bootstrap.
    """
    difference = np.mean(first, axis=0) - np.mean(second, axis=0)
    numbers = np.unique(placement, return_inverse=True)[1].ravel()
    total, count = np.bincount(numbers, difference), np.bincount(numbers).astype(float)
    low = high = float(difference.mean())
    if np.ptp(total / count) > 0:
        interval = stats.bootstrap(
            (total, count), _ratio, paired=True, vectorized=True, n_resamples=RESAMPLES, confidence_level=LEVEL,
            method="percentile", rng=np.random.default_rng(seed),
        ).confidence_interval  # fmt: skip
        low, high = float(interval.low), float(interval.high)
    # Means over folds are sums of multiples of 1/F, so smaller differences are rounding errors.
    better, worse = int((total > 1e-9).sum()), int((total < -1e-9).sum())
    p_value = float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0
    return PairedDifference(float(difference.mean()), low, high, better, worse, p_value, len(difference), len(count))
