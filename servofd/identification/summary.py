"""Intervals and sentences about an identified servo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from logparsers.units import MS_PER_S
from servofd.core.errors import IdentificationError
from servofd.core.evidence import USUAL_GAINS
from servofd.core.statistics import Estimate
from servofd.identification.choice import Choice, choose_linear
from servofd.identification.motion import LARGEST_LOG, LONGEST_DELAY_S, MotionFit, ServoCandidate, fit_motion
from servofd.identification.records import Run

_UNIDENTIFIABLE = 1.0
"""Standard deviation of the logarithm of a pole: a factor of e either way is no knowledge."""
_OTHER_BANDWIDTH, _OTHER_LAG_S = 1.4, 0.02
"""Servos of one kind differ by 10 % in bandwidth and 3 ms in delay; these are of different kinds."""
_KNOWN_SHARE, _KNOWN_LAG_S = 0.1, 1e-3
"""Width of the interval of a lag that may be called known, of the lag or in seconds."""
_NO_DELAY_S = 2e-6
"""Delay below which none is printed [s]."""
_LATER_S, _GAIN = 0.05, 0.95
"""Positions are tried so much later if the best delay is none; they come early if that takes 5 % off the error."""
_COMMON = ("delay_s", "dc_gain", "bandwidth_rad_s", "lag_s", "pole_0_real_rad_s")
"""What servos of any order have."""


def intervals_of(choice: Choice, servo: ServoCandidate) -> dict[str, Estimate]:
    """95 % intervals of everything that is reported, about the values of `servo`.

    Where one more pole fits as well, either model may be true: the intervals embrace both.
    """
    fit = choice.fit
    quantities: dict[str, Callable[[ServoCandidate], float]] = {
        "delay_s": lambda s: s.linear.delay_s,
        "dc_gain": lambda s: s.linear.gain,
        "bandwidth_rad_s": lambda s: float(np.log(s.linear.transfer.bandwidth_rad_s)),
        "lag_s": lambda s: s.linear.lag_s,
    }
    for k, pole in enumerate(servo.linear.poles_rad_s):
        quantities[f"pole_{k}_real_rad_s"] = _of_pole(k, lambda p: p.real)
        if pole.imag != 0.0:
            quantities[f"pole_{k}_imag_rad_s"] = _of_pole(k, lambda p: p.imag)
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
            interval = Estimate(interval.value, min(interval.low, other.low), max(interval.high, other.high))
        value = quantity(servo)
        if name == "delay_s":
            interval = interval._replace(high=min(interval.high, LONGEST_DELAY_S))
        if name == "bandwidth_rad_s":  # fitted by its logarithm, of which the interval is symmetric
            value, interval = float(np.exp(value)), Estimate(*np.exp(np.minimum(interval, LARGEST_LOG)).tolist())
        low, high = min(interval.low, value), max(interval.high, value)
        can_be_negative = "pole" in name or name == "dc_gain"
        found[name] = Estimate(value, low if can_be_negative else max(0.0, low), high)
    return found


def _of_pole(index: int, part: Callable[[complex], float]) -> Callable[[ServoCandidate], float]:
    return lambda servo: part(complex(servo.linear.poles_rad_s[index]))


def notes_on_servo(
    choice: Choice, runs: Sequence[Run], intervals: dict[str, Estimate], band_rad_s: tuple[float, float] | None
) -> list[str]:
    """What must be said about the numbers."""
    notes, linear = [], choice.fit.servo.linear
    if not choice.fit.is_white:
        notes.append(
            f"errors are correlated (von Neumann ratio {choice.fit.whiteness:.2f}, noise has 2): something that the "
            "servo or its sensor does is not in the model; intervals are widened for it, and the truth may lie beyond"
        )
    vague = []
    for k in np.flatnonzero(linear.poles_rad_s.imag == 0.0).tolist():
        interval = choice.fit.interval(_of_pole(k, lambda p: float(np.log(abs(p.real)))))
        if interval.deviation > _UNIDENTIFIABLE:
            vague.append(f"{abs(linear.poles_rad_s[k].real):.4g}")
    lag = intervals.get("lag_s")
    known = lag is not None and lag.high - lag.low <= max(_KNOWN_SHARE * linear.lag_s, _KNOWN_LAG_S)
    total = f"total lag {MS_PER_S * linear.lag_s:.2f} ms is {'well known' if known else 'not well known either'}"
    if vague:
        notes.append(f"far pole not identifiable ({', '.join(vague)} rad/s is a guess), merged into delay; {total}")
    elif linear.order == 1 or choice.further is not None:
        which = "far pole" if linear.order == 1 else f"a pole beyond these {linear.order}, if there is one, is"
        notes.append(f"{which} not identifiable, merged into delay; {total}")
    bandwidth = linear.transfer.bandwidth_rad_s
    if band_rad_s is not None and bandwidth > band_rad_s[1]:
        notes.append(f"bandwidth {bandwidth:.4g} rad/s lies beyond the tested {band_rad_s[1]:.4g} rad/s: extrapolated")
    if band_rad_s is None and choice.fit.servo.rate_up_deg_s is not None:
        notes.append(
            "poles and delay rest on motion at the rate limit alone: a chirp of small amplitude shows them better"
        )
    if linear.delay_s < _NO_DELAY_S:
        early_s = 0.0 if choice.fit.is_white else _early_s(runs, choice.fit)
        notes.append(
            f"position seems to come before its command, by {MS_PER_S * early_s:.1f} ms or more: two clocks, or wrong "
            "time stamps? The numbers are of no use until they agree"
            if early_s > 0.0
            else "delay came out as zero: it is shorter than the data can tell"
        )
    if linear.gain < 0.0:
        notes.append("the position runs against the command: a sign is reversed in the calibration")
    if not USUAL_GAINS[0] <= abs(linear.gain) <= USUAL_GAINS[1]:
        notes.append(f"the position moves by {abs(linear.gain):.3g} times its command: check the units of both")
    return notes


def _early_s(runs: Sequence[Run], fit: MotionFit) -> float:
    """By how much positions come before their commands [s]: what a fit gains if they are taken to come later."""
    later = [replace(run, measured_s=run.measured_s + _LATER_S) for run in runs]
    start = replace(fit.servo, linear=replace(fit.servo.linear, delay_s=_LATER_S))
    shifted = fit_motion(later, start)
    gained = shifted.rms_deg < _GAIN * fit.rms_deg
    return max(0.0, _LATER_S - shifted.servo.linear.delay_s) if gained else 0.0


def notes_on_spread(sweeps: Sequence[Run], order: int | None, names: Sequence[str]) -> tuple[str, ...]:
    """How far several servos differ, from a fit to the sweeps of each."""
    servos = sorted({run.servo for run in sweeps})
    if len(servos) < 2:
        return ()
    names = [names[servo] for servo in servos]
    each = ([replace(run, servo=0) for run in sweeps if run.servo == servo] for servo in servos)
    linear = [choose_linear(runs, order).fit.servo.linear for runs in each]
    bandwidths = np.array([one.transfer.bandwidth_rad_s for one in linear])
    delays, gains = np.array([one.delay_s for one in linear]), np.array([one.gain for one in linear])
    lags = np.array([one.lag_s for one in linear])
    slow, fast = int(np.argmin(bandwidths)), int(np.argmax(bandwidths))
    if bandwidths[fast] > _OTHER_BANDWIDTH * bandwidths[slow] or np.ptp(lags) > _OTHER_LAG_S:
        raise IdentificationError(
            f"these are servos of different kinds: bandwidth {bandwidths[slow]:.4g} rad/s ({names[slow]}) and "
            f"{bandwidths[fast]:.4g} rad/s ({names[fast]}); identify each on its own"
        )
    delays_ms = MS_PER_S * delays
    return (
        f"{len(linear)} servos: bandwidth {bandwidths[slow]:.4g} to {bandwidths[fast]:.4g} rad/s, delay "
        f"{delays_ms.min():.2f} to {delays_ms.max():.2f} ms, dc gain {gains.min():.4f} to {gains.max():.4f}",
    )
