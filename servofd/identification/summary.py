"""Intervals and sentences about an identified servo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.errors import IdentificationError
from servofd.identification.choice import is_white
from servofd.identification.fit import fit_response
from servofd.identification.merged import lowest_delay_s
from servofd.identification.output_error import Interval, MotionFit, ServoCandidate

if TYPE_CHECKING:
    from servofd.identification.choice import Choice
    from servofd.identification.frequency_response import FrequencyResponse
    from servofd.identification.rate import RateLimits
    from servofd.identification.records import Run

__all__ = ["intervals_of", "notes_on_servo", "notes_on_spread"]

_UNIDENTIFIABLE = 1.0
"""Standard deviation of the logarithm of a pole: a factor of e either way is no knowledge."""
_OTHER_BANDWIDTH, _OTHER_LAG_S = 1.4, 0.02
"""Servos of one kind differ by 10 % in bandwidth and 3 ms in delay; these are of different kinds."""
_FAR = 1.0
_COMMON = ("delay_s", "dc_gain", "bandwidth_rad_s", "lag_s", "pole_0_real_rad_s")
"""What servos of any order have."""


def intervals_of(runs: Sequence[Run], choice: Choice, servo: ServoCandidate, limits: RateLimits) -> dict[str, Interval]:
    """95 % intervals of everything that is reported, about the values of `servo`.

    Where one more pole fits as well, nobody knows which model is true: the intervals embrace both.

    Parameters
    ----------
    runs : sequence of Run
        Tests the choice rests on.
    choice : Choice
        Fits with the dc gain free: what is fixed afterwards makes nothing more certain.
    servo : ServoCandidate
        The servo that is reported.
    limits : RateLimits
        From steps.
    """
    fit = choice.fit
    quantities: dict[str, Callable[[ServoCandidate], float]] = {
        "delay_s": lambda s: s.linear.delay_s,
        "dc_gain": lambda s: s.linear.gain,
        "bandwidth_rad_s": lambda s: s.linear.transfer.bandwidth_rad_s,
        "lag_s": lambda s: s.linear.lag_s,
    }
    for k, pole in enumerate(servo.linear.poles_rad_s):
        quantities[f"pole_{k}_real_rad_s"] = partial(_pole_part, index=k, part="real")
        if pole.imag != 0.0:
            quantities[f"pole_{k}_imag_rad_s"] = partial(_pole_part, index=k, part="imag")
    if fit.servo.rate_up_deg_s is not None:
        quantities["rate_up_deg_s"] = lambda s: s.rate_up_deg_s or 0.0
        quantities["rate_down_deg_s"] = lambda s: s.rate_down_deg_s or 0.0
    if fit.servo.dead_band_deg is not None:
        quantities["dead_band_deg"] = lambda s: s.dead_band_deg or 0.0
    found = {}
    for name, quantity in quantities.items():
        interval = fit.interval(quantity)
        if choice.further is not None and name in _COMMON:
            other = choice.further.interval(quantity)
            interval = Interval(interval.value, min(interval.low, other.low), max(interval.high, other.high))
        if choice.further is not None and name == "delay_s":
            # As much below the smallest delay that a far pole leaves possible.
            lowest = lowest_delay_s(runs, fit) - (interval.value - interval.low)
            interval = Interval(interval.value, min(interval.low, lowest), interval.high)
        found[name] = _bounded(interval, quantity(servo), positive="pole" not in name and name != "dc_gain")
    for name, limit in (("rate_up_deg_s", limits.up), ("rate_down_deg_s", limits.down)):
        if limit is not None and name not in found:
            found[name] = limit
    return found


def _pole_part(servo: ServoCandidate, index: int, part: Literal["real", "imag"]) -> float:
    return float(getattr(servo.linear.poles_rad_s[index], part))


def _bounded(interval: Interval, value: float, *, positive: bool) -> Interval:
    """The same interval about the value that is reported; what cannot be negative ends at zero."""
    low, high = min(interval.low, value), max(interval.high, value)
    return Interval(value, max(0.0, low) if positive else low, high)


def notes_on_servo(choice: Choice, highest_rad_s: float | None) -> list[str]:
    """What must be said about the numbers.

    Parameters
    ----------
    choice : Choice
        The fit, and whether one more pole would do as well.
    highest_rad_s : float or None
        Highest frequency with coherence [rad/s].
    """
    notes, linear = [], choice.fit.servo.linear
    if not is_white(choice.fit):
        notes.append(
            f"errors have a memory (von Neumann ratio {choice.fit.whiteness:.2f}, noise has 2): the servo does more "
            "than this model; intervals are widened for it"
        )
    poles = linear.poles_rad_s
    vague = [
        f"{abs(pole.real):.4g}"
        for k, pole in enumerate(poles)
        if pole.imag == 0.0 and _log_deviation(choice.fit, k) > _UNIDENTIFIABLE
    ]
    lag = f"total lag {1e3 * linear.lag_s:.2f} ms is"
    if vague:
        notes.append(
            f"far pole not identifiable ({', '.join(vague)} rad/s is a guess), merged into delay; {lag} well known"
        )
    elif linear.order == 1 or choice.further is not None:
        which = "far pole" if linear.order == 1 else f"a pole beyond these {linear.order}, if there is one, is"
        notes.append(f"{which} not identifiable, merged into delay; {lag} well known")
    bandwidth = linear.transfer.bandwidth_rad_s
    if highest_rad_s is not None and bandwidth > _FAR * highest_rad_s:
        notes.append(f"bandwidth {bandwidth:.4g} rad/s lies beyond the tested {highest_rad_s:.4g} rad/s: extrapolated")
    if highest_rad_s is None and choice.fit.servo.rate_up_deg_s is not None:
        notes.append(
            "poles and delay rest on motion at the rate limit alone: a chirp of small amplitude shows them better"
        )
    if linear.delay_s < 1e-6:
        notes.append("delay came out as zero: it is shorter than the data can tell")
    if linear.gain < 0.0:
        notes.append("the position runs against the command: a sign is reversed in the calibration")
    return notes


def notes_on_spread(responses: Sequence[FrequencyResponse], order: int, names: Sequence[str]) -> tuple[str, ...]:
    """How far several servos differ, from a fit to the response of each.

    Parameters
    ----------
    responses : sequence of FrequencyResponse
        Of each servo.
    order : int
        Number of poles.
    names : sequence of str
        What to call them.

    Raises
    ------
    IdentificationError
        If they differ by more than servos of one kind do.
    """
    if len(responses) < 2:
        return ()
    bands = [response.band_rad_s() for response in responses]
    linear = [fit_response(r.within(band), order) for r, band in zip(responses, bands, strict=True) if band]
    if len(linear) < 2:
        return ()
    bandwidths = np.array([one.transfer.bandwidth_rad_s for one in linear])
    delays, gains = np.array([one.delay_s for one in linear]), np.array([one.gain for one in linear])
    lags = np.array([one.lag_s for one in linear])
    slow, fast = int(np.argmin(bandwidths)), int(np.argmax(bandwidths))
    if bandwidths[fast] > _OTHER_BANDWIDTH * bandwidths[slow] or np.ptp(lags) > _OTHER_LAG_S:
        raise IdentificationError(
            f"these are servos of different kinds: bandwidth {bandwidths[slow]:.4g} rad/s ({names[slow]}) and "
            f"{bandwidths[fast]:.4g} rad/s ({names[fast]}); identify each on its own"
        )
    return (
        f"{len(linear)} servos: bandwidth {bandwidths[slow]:.4g} to {bandwidths[fast]:.4g} rad/s, delay "
        f"{1e3 * delays.min():.2f} to {1e3 * delays.max():.2f} ms, dc gain {gains.min():.4f} to {gains.max():.4f}",
    )


def _log_deviation(fit: MotionFit, index: int) -> float:
    """Standard deviation of the logarithm of a real pole."""
    interval = fit.interval(lambda servo: float(np.log(abs(servo.linear.poles_rad_s[index].real))))
    return (interval.high - interval.low) / (2.0 * 1.96)
