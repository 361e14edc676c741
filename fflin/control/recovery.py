"""Process noise of a filter, chosen for the margins of the loop: loop transfer recovery."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from fflin.base.errors import FflinError
from fflin.base.validation import Array
from fflin.control.estimator import Estimator
from fflin.control.gain import Gain
from fflin.control.lqg import compensator_of, disk_margin_with
from fflin.control.multirate import MultirateEstimator
from fflin.control.slower_weights import LEAST_DISK
from fflin.linear.model import LinearModel

Filter: TypeAlias = "Estimator | MultirateEstimator"

# Exponents of the factors on the noise at the inputs. The search begins at 10^0. If the loop has
# the margin there, smaller factors follow, otherwise larger ones.
_SMALLER, _LARGER = range(-1, -7, -1), range(1, 5)


def input_noise(gain: Gain, factor: float) -> Array:
    """Return the covariance (nu, nu) of noise at the inputs, in proportion to R^-1."""
    return factor * np.linalg.inv(gain.R)


def recovering_filter(
    gain: Gain, lin: LinearModel, filter_of: Callable[[Array], Filter]
) -> tuple[Filter, float]:
    """Return the filter with the least noise at the inputs that gives the loop its margin.

    With more noise at the inputs, the margins of the loop approach the margins of the regulator (J.
    C. Doyle and G. Stein, IEEE Trans. Automatic Control 26(1), 1981), but the estimate contains
    more measurement noise. The noise is a power of ten times R^-1, and the margin is the disk
    margin `LEAST_DISK`. If no noise gives this margin, the filter with the largest margin is
    returned.

    Parameters
    ----------
    gain : Gain
    lin : LinearModel
        Model of the gain.
    filter_of : callable
        Function that returns the filter for a covariance (nu, nu) of the noise at the inputs.

    Returns
    -------
    filter : Estimator or MultirateEstimator
    factor : float
        Factor on R^-1.
    """

    def trial(exponent: int) -> tuple[Filter, float | None]:
        estimator = filter_of(input_noise(gain, 10.0**exponent))
        compensator = compensator_of(gain, estimator, None)
        return estimator, disk_margin_with(lin, compensator)

    best, most = trial(0)
    factor = 1.0
    if most is None:
        return best, factor
    enough = most >= LEAST_DISK
    for exponent in _SMALLER if enough else _LARGER:
        try:
            estimator, disk = trial(exponent)
        except FflinError:  # the noise is so small or large that the design fails
            break
        if disk is None or (enough and disk < LEAST_DISK):
            break
        if enough or disk > most:
            best, most, factor = estimator, disk, 10.0**exponent
        if not enough and most >= LEAST_DISK:
            break
    return best, factor
