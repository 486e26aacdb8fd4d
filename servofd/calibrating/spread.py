"""How far a healthy servo strays from its own mean: tolerances from the stretches of good flights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.calibrating.stretches import NUISANCES
from servofd.tolerance import Tolerance

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.calibrating.stretches import Stretch
    from servofd.types import FloatArray

__all__ = ["FLOORS", "spread", "tolerance_from"]

FLOORS = Tolerance(gain=0.01, delay_s=0.001, bandwidth=0.033, rate=0.05, bias_deg=0.1, noise_deg=0.02)
"""A third of what a fleet of servos strays (the default `Tolerance`); half for the rate, which follows the supply.
One servo strays less than a fleet, but a flight or two do not show all temperatures, supply voltages and airloads."""
_CHI2_MEDIAN = 0.4549
_BEYOND = 1e-3
"""Chance that one more stretch strays beyond a tolerance, on either side, if strays are Gaussian."""
_NOISE_MARGIN = 1.2
_LARGEST = {"gain": 0.3, "delay_s": 0.05, "bandwidth": 0.6, "bias_deg": 1e3}


def spread(stretches: Sequence[Stretch]) -> FloatArray:
    r"""Standard deviation of each nuisance over stretches, what noise causes taken out; shape (4,).

    A stretch that tells little of a nuisance has little say; some faulty stretches do not widen it.

    Notes
    -----
    With deviations :math:`d_i` known to :math:`s_i` the spread :math:`\tau` is where the median of
    :math:`d_i^2 / (\tau^2 + s_i^2)` is that of a chi-squared variable of one degree, 0.455; zero if noise explains all.
    """
    deviation = np.array([s.deviation for s in stretches])
    doubt = np.array([s.doubt for s in stretches])
    return np.array([_spread_of(d, s) for d, s in zip(deviation.T, doubt.T, strict=True)])


def _spread_of(deviation: FloatArray, doubt: FloatArray) -> float:
    from scipy.optimize import brentq

    def excess(tau: float) -> float:
        return float(np.median(deviation**2 / (tau**2 + doubt**2 + 1e-18))) - _CHI2_MEDIAN

    most = 2.0 * float(np.max(np.abs(deviation))) + 1e-9
    return 0.0 if excess(0.0) <= 0.0 else float(brentq(excess, 0.0, most))


def tolerance_from(
    stretches: Sequence[Stretch], half_widths: Mapping[str, float], prior: Tolerance, noise_deg: float
) -> Tolerance:
    r"""Tolerances that one more stretch of the same servo will keep, as far as these tell.

    Parameters
    ----------
    stretches : sequence of Stretch
        At least one.
    half_widths : mapping of nuisance to float
        Half the 95 % interval of what was fitted; "rate" too if the rate limit was. What is missing was kept from the
        aircraft file, along with its tolerance.
    prior : Tolerance
        Of the aircraft file.
    noise_deg : float
        Standard deviation of the position measurement [deg].

    Returns
    -------
    Tolerance
        Spread times Student's factor for one more draw, plus the doubt of the fit; never below `FLOORS`.

    Notes
    -----
    With n stretches of spread s, one more lies within :math:`t_{n-1} s \sqrt{1 + 1/n}` of their mean. For fewer than
    five stretches the factor of five is used (8.6 at one in a thousand): below that it says nothing but "unknown".
    """
    from scipy.stats import t

    count = max(len(stretches), 5)
    factor = float(t.isf(_BEYOND / 2.0, count - 1)) * np.sqrt(1.0 + 1.0 / count)
    strays = dict(zip(NUISANCES, (factor * spread(stretches)).tolist(), strict=True)) if stretches else {}
    values = {}
    for name in NUISANCES:
        kept = 0.0 if name in half_widths else getattr(prior, name)
        wanted = max(getattr(FLOORS, name), kept, strays.get(name, 0.0)) + half_widths.get(name, 0.0)
        values[name] = min(wanted, max(_LARGEST[name], kept))
    rate = FLOORS.rate + half_widths["rate"] if "rate" in half_widths else prior.rate
    return Tolerance(**values, rate=min(rate, 0.9), noise_deg=max(FLOORS.noise_deg, _NOISE_MARGIN * noise_deg))
