"""What one flight says by itself, check by check: pure functions of its columns, each with one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servofd.axes.px4 import Control
from servofd.core.series import stretches
from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.types import BoolArray, FloatArray
from servofd.flight.change import AxisChange, Status, first_turns
from servofd.flight.columns import Flight


@dataclass(frozen=True, slots=True)
class Check:
    """One question to one flight.

    `text`: one sentence. `since_s`: from when on [s]; None where that means nothing. `name`: as in the report.
    """

    status: Status
    text: str
    since_s: float | None = None
    name: str = ""


_NO_OUTPUTS = (
    "no output of a surface in this log (SERVOn_FUNCTION, MIN and MAX; PX4: actuator_servos with CA_SV_CSk_TYPE)"
)
_NEVER_FLEW = "this log does not show when the aircraft flew"

_AT_END = 0.99
"""Share of its travel from which on an output is at its end."""
_LONG_AT_END_S = 3.0
"""An output that stays at its end for longer has nothing left: in nine healthy flights of ArduPlane in wind none
stayed there for 1 s. A pilot who holds full aileron through a roll takes about two."""


def saturation(flight: Flight) -> Check:
    """Whether a command stood at its end, and so could ask for no more."""
    if not flight.outputs:
        return Check("unknown", _NO_OUTPUTS)
    if not np.isfinite(flight.span_s[0]):
        return Check("unknown", _NEVER_FLEW)
    longest_s, begin_s, which = 0.0, 0.0, flight.outputs[0]
    for output in flight.outputs:
        at_end = (np.abs(output.values) >= _AT_END) & (output.time_s >= flight.span_s[0])
        for first, last in stretches(at_end):
            end_s = float(output.time_s[min(last, output.time_s.size - 1)])
            lasted_s = end_s - float(output.time_s[first])
            if lasted_s > longest_s and output.time_s[first] <= flight.span_s[1] + _LONG_AT_END_S:
                longest_s, begin_s, which = lasted_s, float(output.time_s[first]), output
    if longest_s < _LONG_AT_END_S:
        seen = "for no longer than a moment" if longest_s == 0.0 else f"for {longest_s:.1f} s at most ({which.name})"
        return Check("ok", f"commands stood at their ends {seen}")
    late = begin_s + longest_s >= flight.span_s[1]
    then = f", up to the end of the flight{_answer(flight, which, begin_s, begin_s + longest_s)}" if late else ""
    return Check("look", f"{which.name} stood at its end for {longest_s:.1f} s from {begin_s:.0f} s on{then}", begin_s)


_OBEYS_DEG_S = 5.0
"""Rate below which an aircraft does not obey full travel: a hundredth of what it gives an aerobatic one [deg/s]."""


def _answer(flight: Flight, output: Control, begin_s: float, end_s: float) -> str:
    """How the aircraft turned meanwhile, about the axis of this output that was asked for most."""
    motion = flight.motion
    if motion is None:
        return ""
    at = (motion.time_s >= begin_s) & (motion.time_s <= end_s)
    if not at.any() or not motion.commands_us:
        return ""
    asked = {axis: float(np.mean(us[at])) for axis, us in motion.commands_us.items() if axis in output.axes}
    if not asked:
        return ""
    axis = max(asked, key=lambda each: abs(asked[each]))
    place, does = _TURNS[axis]
    rate_deg_s = float(np.mean(motion.rates_deg_s[place][at])) * np.sign(asked[axis])
    if rate_deg_s < _OBEYS_DEG_S:
        return f": it was asked for all it has, and the aircraft did not {does} that way ({rate_deg_s:+.0f} deg/s)"
    return f": the aircraft did {does} that way, by {rate_deg_s:.0f} deg/s"


_TURNS = {"roll": (0, "roll"), "pitch": (1, "pitch"), "yaw": (2, "yaw")}
"""Place of an axis among the body rates, and what an aircraft does about it."""
_FAR_TRIM = 0.4
"""Of half the travel: twice as far as ArduPilot's automatic trim goes (SRV_Channel::adjust_trim stops at 40 and 60 % of
the range)."""
_LEVEL_DEG = 10.0
"""Bank below which flight is level [deg]."""


def trim(flight: Flight) -> Check:
    """Where the commands stand in level flight."""
    means = _level_means(flight)
    if not means:
        return Check("unknown", _NO_OUTPUTS if not flight.outputs else "no level flight that shows the trim")
    name, mean = max(means.items(), key=lambda each: abs(each[1]))
    text = f"in level flight {name} stands at {mean:+.0%} of its half travel"
    return Check("look" if abs(mean) > _FAR_TRIM else "ok", f"{text}, the furthest of {len(means)}")


def _level_means(flight: Flight) -> dict[str, float]:
    if flight.motion is None or not flight.flies.any():
        return {}
    level = flight.flies & (np.abs(flight.motion.roll_deg) < _LEVEL_DEG)
    found = {}
    for output in flight.outputs:
        at = flight.at(output.time_s, level)
        if np.count_nonzero(at) > _FEW:
            found[output.name] = float(np.mean(output.values[at]))
    return found


_FEW = 50
"""Samples of an output that a check needs."""
_LEAST_SPAN_US, _LEAST_SIDE = 400.0, 0.5
"""Travel that leaves less than 18 deg to either side of a servo of 90 deg a millisecond, and a side with less than half
of what an even split would give it, cut commands that the autopilot means to give."""


def travel(flight: Flight) -> Check:
    """How much of its travel each output used, and whether its limits cut commands."""
    if not flight.outputs:
        return Check("unknown", _NO_OUTPUTS)
    narrow = [one.name for one in flight.outputs if one.span_us < _LEAST_SPAN_US]
    uneven = [one.name for one in flight.outputs if 1.0 - abs(one.trim) < _LEAST_SIDE]
    used = {one.name: float(np.ptp(one.values)) / 2.0 for one in flight.outputs}
    least = min(used, key=lambda name: used[name])
    most = max(used, key=lambda name: used[name])
    shares = f"outputs used {used[least]:.0%} ({least}) to {used[most]:.0%} ({most}) of their travel"
    if narrow or uneven:
        which = ", ".join(dict.fromkeys([*narrow, *uneven]))
        return Check(
            "look", f"MIN, MAX and TRIM of their outputs leave {which} too little travel to one side; {shares}"
        )
    return Check("ok", shares)


_UNEVEN = 0.15
"""Of half the travel. Healthy ArduPlanes with uneven wings (c_l_0 up to 0.006) hold 0.06 at most."""


def asymmetry(flight: Flight) -> Check:
    """Whether left and right need different commands to fly straight."""
    means = _level_means(flight)
    by_name = {one.name: one for one in flight.outputs}
    rolls = [
        by_name[name].axes["roll"] * (mean - by_name[name].trim)
        for name, mean in means.items()
        if "roll" in by_name[name].axes
    ]
    if not rolls:
        return Check("unknown", "no level flight with the commands of ailerons or elevons")
    held = float(np.mean(rolls))
    side = "right" if held > 0.0 else "left"
    text = f"it takes {abs(held):.0%} of roll to the {side} to fly level"
    if abs(held) > _UNEVEN:
        return Check("look", f"{text}: a wing, its load, or one of the surfaces is not as the other")
    return Check("ok", text)


_CYCLE_S = 10.0
"""Length of the windows in which a limit cycle is looked for [s]."""
_SLOWEST_CYCLE_HZ, _NARROW, _CYCLE_SHARE, _CYCLE_DEG_S = 1.0, 0.2, 0.75, 5.0
"""Gusts and manoeuvres are broad: in 39 flights (ALFA, ArduPlane in wind, with their faults) no two windows in a row
held more than 0.62 of the power of both command and rate within a fifth of one frequency (benchmarks/one_flight.py)."""
_CYCLE_WINDOWS = 3
"""A limit cycle stays. Logged at PX4's 10 Hz, one of the healthy flights in wind swung so for two windows: gusts had
set off its short period."""


def limit_cycle(flight: Flight) -> Check:
    """Whether command and rate swing at one frequency, in some windows in a row, each from the middle of another."""
    motion = flight.motion
    if motion is None or not flight.flies.any():
        return Check("unknown", flight.lacking or _NEVER_FLEW)
    rows = round(_CYCLE_S * motion.rate_hz)
    begins = [b for b in range(0, motion.time_s.size - rows + 1, rows // 2) if flight.flies[b : b + rows].all()]
    if not begins:
        return Check("unknown", f"no {_CYCLE_S:.0f} s of flight in one piece")
    for axis, rate in zip(("roll", "pitch"), motion.rates_deg_s[:2], strict=True):
        if axis not in motion.commands_us:
            continue
        row: list[tuple[int, float]] = []
        for begin in begins:
            part = slice(begin, begin + rows)
            share, peak_hz = _narrow(motion.commands_us[axis][part], rate[part], motion.rate_hz)
            swing_deg_s = float(np.std(rate[part])) * np.sqrt(2.0)
            if share <= _CYCLE_SHARE or swing_deg_s < _CYCLE_DEG_S:
                row = []
                continue
            goes_on = row and begin == row[-1][0] + rows // 2 and abs(peak_hz - row[-1][1]) <= _NARROW * peak_hz
            row = [*row, (begin, peak_hz)] if goes_on else [(begin, peak_hz)]
            if len(row) == _CYCLE_WINDOWS:
                since_s = float(motion.time_s[row[0][0]])
                text = (
                    f"{axis} swings at {peak_hz:.1f} Hz by ±{swing_deg_s:.0f} deg/s with its command from "
                    f"{since_s:.0f} s on: play, a slow servo, gains too high, or a pilot's own hand"
                )
                return Check("look", text, since_s)
    return Check("ok", f"no swing at one frequency in {len(begins)} windows of {_CYCLE_S:.0f} s")


def _narrow(command: FloatArray, rate: FloatArray, rate_hz: float) -> tuple[float, float]:
    """Share of the power of both within a fifth of the frequency at which the rate swings most, and that [Hz]."""
    frequency_hz = np.fft.rfftfreq(rate.size, 1.0 / rate_hz)
    hann = np.hanning(rate.size)
    power = [np.abs(np.fft.rfft((each - each.mean()) * hann)) ** 2 for each in (command, rate)]
    fast = frequency_hz >= _SLOWEST_CYCLE_HZ
    peak_hz = float(frequency_hz[fast][np.argmax(power[1][fast])])
    near = np.abs(frequency_hz - peak_hz) <= _NARROW * peak_hz
    return min(float(each[near].sum() / max(each.sum(), LEAST_DIVISOR)) for each in power), peak_hz


_LOWEST_V, _DIP_SHARE = 4.5, 0.15
"""Hobby servos are specified from 4.8 V on (Hitec, Futaba); a rail that sags by a seventh has too weak a supply."""


def supply(flight: Flight) -> Check:
    """Whether the rail of the servos held its voltage."""
    if flight.supply_v is None:
        return Check("unknown", "no voltage of the servos' rail in this log (of ArduPilot: POWR.VServo)")
    volts, time_s = flight.supply_v.values, flight.supply_v.time_s
    usual_v, lowest_v = float(np.median(volts)), float(volts.min())
    since_s = float(time_s[int(np.argmin(volts))])
    text = f"the servos' rail held {usual_v:.1f} V, {lowest_v:.1f} V at least"
    if lowest_v < min(usual_v, _LOWEST_V) or lowest_v < (1.0 - _DIP_SHARE) * usual_v:
        return Check("look", f"{text}, at {since_s:.0f} s", since_s)
    return Check("ok", text)


_BEFORE_TAKEOFF_S = 60.0
"""Time before take-off in which surfaces are checked [s]."""
_FULL, _SOME = 0.8, 0.2
"""Shares of the travel that a full check reaches, and that a surface moves at all."""
_FOLLOWS, _STICK_US = 0.7, 100.0
"""Correlation of stick and output that shows a reversed surface, and the least motion of the stick [us]."""


def surface_check(flight: Flight) -> Check:
    """What was moved in the minute before take-off, how far and which way, and which way the aircraft answered."""
    if not flight.outputs:
        return Check("unknown", _NO_OUTPUTS)
    wrong = [] if flight.motion is None else first_turns(flight.motion)
    return _wrong_way(wrong) if wrong else _on_the_ground(flight)


def _wrong_way(turns: Sequence[tuple[str, str, float]]) -> Check:
    said = " and ".join(
        f"{axis} turned against its command: reversed" if axis == by else f"{axis} turned with the command of {by}"
        for axis, by, _ in turns
    )
    after_s = max(flown_s for *_, flown_s in turns)
    swapped = any(axis != by for axis, by, _ in turns)
    which = ": outputs swapped, or one surface of a pair reversed" if swapped else ""
    return Check("look", f"in the first {after_s:.0f} s of flight {said}{which}")


def _on_the_ground(flight: Flight) -> Check:
    if not np.isfinite(flight.span_s[0]):
        return Check("unknown", _NEVER_FLEW)
    takeoff_s = flight.span_s[0]
    ground = [
        (one, (one.time_s < takeoff_s - _ROLLING_S) & (one.time_s >= takeoff_s - _BEFORE_TAKEOFF_S - _ROLLING_S))
        for one in flight.outputs
    ]
    if not all(np.count_nonzero(at) > _FEW for _, at in ground):
        return Check("unknown", "the log begins in the air, or just before: no minute on the ground")
    reversed_ = [one.name for one, at in ground if _against_stick(flight, one, at)]
    if reversed_:
        text = f"{' and '.join(reversed_)} moved against the stick before take-off"
        return Check("look", text, takeoff_s - _BEFORE_TAKEOFF_S)
    full = [one.name for one, at in ground if one.values[at].max() >= _FULL and one.values[at].min() <= -_FULL]
    some = [one.name for one, at in ground if np.ptp(one.values[at]) >= 2.0 * _SOME and one.name not in full]
    still = [one.name for one, _ in ground if one.name not in (*full, *some)]
    if not some and not still:
        return Check("ok", f"done: {', '.join(full)} moved to both ends before take-off")
    grade = "partly done" if full or some else "not done"
    parts = [f"{', '.join(some)} moved part of the way"] * bool(some) + [f"{', '.join(still)} not moved"] * bool(still)
    return Check("unknown", f"{grade}: {'; '.join(parts)} before take-off")


_ROLLING_S = 8.0
"""What counts as flight begins some seconds after the wheels have left the ground, and those roll for some more."""


def _against_stick(flight: Flight, output: Control, at: BoolArray) -> bool:
    """Whether an output moved the other way than the sticks that it serves."""
    stick = np.zeros(int(np.count_nonzero(at)))
    for axis, sign in output.axes.items():
        if axis in flight.sticks:
            asked = flight.sticks[axis]
            values = np.interp(output.time_s[at], asked.time_s, asked.values)
            stick += sign * (values - np.median(values))
    share: FloatArray = output.values[at]
    if np.ptp(stick) < _STICK_US or np.ptp(share) < 2.0 * _SOME:
        return False
    return float(np.corrcoef(stick, share)[0, 1]) < -_FOLLOWS


def axis_change(axes: Mapping[str, AxisChange]) -> Check:
    """Whether an axis stopped answering as it had before."""
    looks = [one for one in axes.values() if one.status == "look"]
    if looks:
        looks.sort(key=lambda one: one.alarm_s or np.inf)
        return Check("look", "; ".join(one.text for one in looks), looks[0].since_s)
    judged = [one for one in axes.values() if one.status == "ok"]
    if judged:
        return Check("ok", "; ".join(one.text for one in judged))
    why: dict[str, list[str]] = {}
    for one in axes.values():
        why.setdefault(one.text.removeprefix(f"{one.axis}: "), []).append(one.axis)
    reasons = "; ".join(f"{' and '.join(names)}: {reason}" for reason, names in why.items())
    return Check("unknown", reasons or "no axis could be judged")
