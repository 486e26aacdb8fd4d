"""One surface of one log as the fit needs it: commands, positions, load, supply, and which samples may be used.

Where commands were lost on a link, those between two that arrived are taken to lie on a straight line. A command that
stepped by d at an unknown instant of a gap differs from that line, at a share s of the gap, by a standard deviation of
d sqrt(s (1 - s)); so does a random walk which ends d away (a Brownian bridge of variance d^2 / gap per second). What
went on between is not only what is left of it at the end: the walk moves as much as it lately did.

The servo passes this on. A lag passes no more of the standard deviation of its input than of the input itself, so that
the same lag, driven by the standard deviation, bounds that of the position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from servofd.aircraft.pace import NO_RHYTHM, Rhythm, gap_s, rhythm
from servofd.aircraft.priors import NAMES
from servofd.aircraft.series import Series, settled_from_s
from servofd.core.series import latest, rms, subdivided
from servofd.core.types import BoolArray, FloatArray
from servofd.estimate.family import LONGEST_PAUSE_S, PRESSURE_PA
from servofd.servo.context import Context, pressure_pa
from servofd.servo.effects.commands import Commands
from servofd.servo.loops import compiled

LONGEST_S: Final = 0.25
"""Between two commands; in more a servo goes a long way and comes back, and nothing shows it."""
_MIDDLE: Final = np.pi / 8.0
"""Mean of sqrt(s (1 - s)) over the gap."""
_LATELY_S: Final = 1.0
LN_BANDWIDTH, LN_DAMPING, DELAY = (NAMES.index(name) for name in ("ln_bandwidth", "ln_damping", "delay_s"))


def put_back(
    command_s: FloatArray, command_deg: FloatArray, beat: Rhythm, longest_gap_s: float = LONGEST_S
) -> tuple[FloatArray, FloatArray]:
    """Commands with those that were lost on straight lines, at the period they are sent with; holes are left.

    Examples
    --------
    >>> sent_s, sent_deg = np.array([0.0, 0.02, 0.06, 0.5]), np.array([0.0, 1.0, 3.0, 9.0])
    >>> put_back(sent_s, sent_deg, Rhythm.of_link(0.02))[1]
    array([0., 1., 2., 3., 9.])
    """
    step_s = np.diff(command_s)
    lost = (step_s > beat.longest_s) & (step_s <= longest_gap_s)
    pieces = np.ones(step_s.size, dtype=np.int64)
    pieces[lost] = np.round(step_s[lost] / beat.period_s).astype(np.int64)
    return subdivided(command_s, command_deg, pieces)


def commands_at_servo(segment: Series, longest_gap_s: float) -> Commands:
    """Reconstruct what a servo without delay received from what was logged.

    Complete logs: each command holds until the next; where single samples were lost, they are put back on the
    straight line between their neighbours. Thinned logs (`Series.command_period_s`): the command runs
    straight between samples, later by half the real period, the mean lag of the hold.
    """
    time_s, command_deg = segment.command_s, segment.command_deg
    if segment.command_period_s is not None:
        step_s = np.diff(time_s)
        slope = np.append(np.where(step_s <= longest_gap_s, np.diff(command_deg) / step_s, 0.0), 0.0)
        return Commands(time_s + segment.command_period_s / 2.0, command_deg, slope)
    time_s, command_deg = put_back(time_s, command_deg, rhythm(time_s), longest_gap_s)
    return Commands(time_s, command_deg, np.zeros(time_s.size))


def new_memory() -> FloatArray:
    """Memory of `unknown_deg`: place among the commands, time, variance per second, and what the lag holds."""
    return np.array([0.0, np.nan, 0.0, 0.0])


def unknown_deg(
    commands: tuple[FloatArray, FloatArray],
    beat: Rhythm,
    theta: FloatArray,
    time_s: FloatArray,
    memory: FloatArray,
    longest_gap_s: float = LONGEST_S,
) -> FloatArray:
    """Standard deviation of where a servo stands, for the commands that were lost, shape (m,) [deg].

    Commands are those that arrived, up to the first after the last of the times; `theta` (13,) is the servo,
    `memory` from `new_memory` and carried on. A gap longer than the longest [s] is no loss, but a hole.
    """
    lag_s = 2.0 * np.exp(theta[LN_DAMPING] - theta[LN_BANDWIDTH])
    out = np.zeros(time_s.size)
    if commands[0].size and np.isfinite(beat.period_s):
        _unknown(*commands, beat.longest_s, longest_gap_s, theta[DELAY], lag_s, time_s, memory, out)
    return out


@compiled
def _unknown(
    command_s: FloatArray, command_deg: FloatArray, shortest_s: float, longest_s: float, delay_s: float, lag_s: float,
    time_s: FloatArray, memory: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    place, now_s, walk, held = int(memory[0]), memory[1], memory[2], memory[3]
    if np.isnan(now_s):
        now_s = command_s[place]
    last = command_s.shape[0] - 1
    for i in range(time_s.shape[0]):
        until_s = time_s[i] - delay_s
        while now_s < until_s:
            while place < last and command_s[place + 1] <= now_s:
                place += 1
            end_s, size, here = until_s, 0.0, 0.0
            if place < last:
                end_s = min(until_s, command_s[place + 1])
                gap_s = command_s[place + 1] - command_s[place]
                if gap_s <= longest_s:  # after a longer one the simulation begins anew
                    here = (command_deg[place + 1] - command_deg[place]) ** 2 / gap_s
                if shortest_s < gap_s <= longest_s:
                    size = _MIDDLE * np.sqrt(max(walk, here) * gap_s)
            kept = np.exp(-(end_s - now_s) / lag_s)
            held = size + kept * (held - size)
            walk = here + np.exp(-(end_s - now_s) / _LATELY_S) * (walk - here)
            now_s = end_s
        out[i] = held
    memory[0], memory[1], memory[2], memory[3] = float(place), now_s, walk, held


SETTLING_S = 0.45
"""After a gap in commands or positions; a servo that rested anywhere in its friction band is where it is asked to be by
then."""
_START_S = 0.3
"""After a gap: the simulation begins anew from the position."""
_FIRST_S = 1.0
_FORGETS_S = 0.16
"""What a servo that hardly moves at the beginning is ahead of one at rest (0.1 deg) is over after so long: 8 time
constants of the thesis' filter [s]."""
_APART_S = 2.0 * LONGEST_PAUSE_S
"""Between records that are simulated as one [s]: after that pause each begins anew."""
_LEAST_SUPPLY_V = 2.0
_POWERS = (0.75, 1.4)
"""Supply over its usual value, at which it is cut off."""
FINE_S = 0.01
"""Longest step between two samples over which load and supply are taken as constant [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One surface in one log; arrays of shape (m,), one entry per position, unless said."""

    command_s: FloatArray
    """Shape (n,)."""
    command_deg: FloatArray
    time_s: FloatArray
    measured_deg: FloatArray
    load: FloatArray
    """Dynamic pressure over 300 Pa."""
    power: FloatArray
    """Supply over the usual one."""
    start_deg: FloatArray
    """Where the simulation begins anew; NaN where it goes on."""
    usable: BoolArray
    period_s: float
    arrived: tuple[FloatArray, FloatArray] | None = None
    """Commands without those that were put back, times [s] and values [deg]; None where none can have been lost."""
    beat: Rhythm = NO_RHYTHM
    """In which they were given."""
    longest_gap_s: float = LONGEST_S
    """Longest time between two of them that is no hole."""
    is_lossy: bool = False
    """Whether they came over a link, which loses some."""

    @classmethod
    def of(
        cls, segment: Series, supply_v: float | None = None, airspeed_m_s: float | None = None, *, at_once: bool = False
    ) -> Record:
        """Prepare a segment; `at_once`: a servo that begins at rest is judged from there on, and not after a second.

        By the usual supply and airspeed, for flights that logged none: that of this segment if None; 0 if
        none was known.
        """
        commands = segment.command_s, segment.command_deg
        sent_s, arrived = segment.sent_period_s, None
        beat = rhythm(segment.command_s) if sent_s is None else Rhythm.of_link(sent_s)
        longest_s = gap_s(segment.command_s) if sent_s is None else LONGEST_S
        if segment.command_period_s is not None and sent_s is None:
            commands = straightened(*commands, longest_s)
        elif segment.command_s.size:
            arrived, commands = commands, put_back(*commands, beat, longest_s)
        known = np.isfinite(segment.measured_deg)
        time_s, measured_deg = segment.measured_s[known], segment.measured_deg[known]
        holds_s = None if sent_s is None else beat.longest_s
        asked_deg = segment.command_deg if at_once else None
        start_deg, usable = starts(
            segment.command_s, time_s, measured_deg, longest_s, held_s=holds_s, asked_deg=asked_deg
        )
        context = segment.context
        if supply_v is None:
            supply_v = usual_supply_v(context)
        return cls(
            *commands,
            time_s,
            measured_deg,
            loads(context, time_s, airspeed_m_s),
            powers(context, time_s, supply_v),
            start_deg,
            usable,
            segment.period_s,
            arrived,
            beat,
            longest_s,
            sent_s is not None,
        )

    def unknown_deg(self, theta: FloatArray) -> FloatArray:
        """Standard deviation of where a servo stands, for the commands that were lost, shape (m,) [deg]."""
        if self.arrived is None:
            return np.zeros(self.time_s.size)
        return unknown_deg(self.arrived, self.beat, theta, self.time_s, new_memory(), self.longest_gap_s)

    @property
    def commands(self) -> Commands:
        """Commands that hold until the next."""
        return Commands(self.command_s, self.command_deg, np.zeros(self.command_s.size))


def joined(records: Sequence[Record]) -> Record:
    """Records of one servo one after the other, far enough apart that each begins anew.

    Examples
    --------
    >>> one = Record(*(np.zeros(1) for _ in range(7)), np.ones(1, dtype=bool), 0.02)
    >>> joined([one, one]).time_s
    array([ 0., 10.])
    """
    later_s, moved = 0.0, []
    for each in records:
        edges_s = np.concatenate([each.command_s[[0, -1]], each.time_s[[0, -1]]])
        shift_s = later_s - float(edges_s.min())
        moved.append(replace(each, command_s=each.command_s + shift_s, time_s=each.time_s + shift_s))
        later_s += float(np.ptp(edges_s)) + _APART_S
    names = ("command_s", "command_deg", "time_s", "measured_deg", "load", "power", "start_deg", "usable")
    whole: dict[str, Any] = {name: np.concatenate([getattr(each, name) for each in moved]) for name in names}
    return replace(records[0], **whole)


def straightened(command_s: FloatArray, command_deg: FloatArray, longest_gap_s: float) -> tuple[FloatArray, FloatArray]:
    """Commands that were thinned out of a faster stream, on straight lines between, but for holes."""
    step_s = np.diff(command_s)
    pieces = np.where(step_s <= longest_gap_s, np.maximum(np.round(step_s / FINE_S), 1.0), 1.0).astype(int)
    return subdivided(command_s, command_deg, pieces)


def starts(
    command_s: FloatArray,
    time_s: FloatArray,
    measured_deg: FloatArray,
    longest_s: float | None = None,
    begun_s: float = float("nan"),
    held_s: float | None = None,
    asked_deg: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Where the simulation begins anew (positions, else NaN), and which samples may be judged; both (m,).

    `longest_s` is the longest time between commands that is no gap, `begun_s` when the flight began, if that is known;
    `held_s` how long a command holds for sure where the next one comes after a gap, or never: as long if left out;
    `asked_deg` what the commands ask for, if a servo that begins at rest is judged at once, and not after a second.

    Examples
    --------
    >>> t = np.arange(100) / 10.0
    >>> begin_deg, usable = starts(t[(t < 4.0) | (t > 6.0)], t, t)
    >>> begin_deg[np.isfinite(begin_deg)], t[~usable & (t > 2.0)]
    (array([0. , 6.4]), array([4.2, 4.3, 4.4, 4.5, 4.6, 4.7, 4.8, 4.9, 5. , 5.1, 5.2, 5.3, 5.4,
           5.5, 5.6, 5.7, 5.8, 5.9, 6. , 6.1, 6.2, 6.3, 6.4, 6.5]))
    """
    longest_s = gap_s(command_s) if longest_s is None else longest_s
    start_deg = np.full(time_s.size, np.nan)
    usable = np.isfinite(measured_deg)
    if not command_s.size or not time_s.size:
        return start_deg, np.zeros(time_s.size, dtype=bool)
    last = np.searchsorted(command_s, time_s, side="right") - 1
    held_s = longest_s if held_s is None else held_s
    age_s = time_s - command_s[np.maximum(last, 0)]
    usable &= (last >= 0) & (age_s <= np.where(last < command_s.size - 1, longest_s, held_s))
    breaks = np.flatnonzero(np.diff(command_s) > longest_s)
    for begin_s, end_s in zip(command_s[breaks], command_s[breaks + 1], strict=True):
        first, here, settled = np.searchsorted(time_s, (begin_s + held_s, end_s + _START_S - 1e-9, end_s + SETTLING_S))
        usable[first:settled] = False
        good = here + np.flatnonzero(np.isfinite(measured_deg[here : here + 10]))
        if good.size:
            start_deg[good[0]] = measured_deg[good[0]]
    for after in 1 + np.flatnonzero(np.diff(time_s) > LONGEST_PAUSE_S):
        start_deg[after] = measured_deg[after]
        usable[after : np.searchsorted(time_s, time_s[after] + SETTLING_S)] = False
    first = np.flatnonzero(usable)
    if not np.isfinite(begun_s) and first.size:
        begun_s = float(time_s[first[0]])
        start_deg[first[0]] = measured_deg[first[0]]
    if np.isfinite(begun_s):
        settled_s = begun_s + _FIRST_S
        if asked_deg is not None:
            settled_s = settled_from_s(begun_s, (command_s, asked_deg), time_s, measured_deg)
            settled_s = max(settled_s, begun_s + _FORGETS_S)
        usable[: np.searchsorted(time_s, settled_s)] = False
    return start_deg, usable


def loads(context: Context, time_s: FloatArray, usual_m_s: float | None = None) -> FloatArray:
    """Dynamic pressure over 300 Pa, shape (m,); each airspeed holds until the next, as in flight.

    Where none is known it is the usual one; where no usual one is known (0), what the air did is part of the servo.

    Examples
    --------
    >>> from servofd.servo.context import NO_CONTEXT
    >>> loads(NO_CONTEXT, np.zeros(1), 22.1).round(2), loads(NO_CONTEXT, np.zeros(1))
    (array([1.]), array([0.]))
    """
    airspeed_m_s = np.full(time_s.size, usual_m_s or 0.0)
    if context.airspeed_s.size and usual_m_s != 0.0:
        airspeed_m_s = latest(context.airspeed_s, context.airspeed_m_s, time_s)
    return np.clip(pressure_pa(airspeed_m_s) / PRESSURE_PA, 0.0, 20.0)


def load_at(airspeed_m_s: float) -> float:
    """Dynamic pressure over 300 Pa."""
    return float(pressure_pa(airspeed_m_s)) / PRESSURE_PA


def fastest_m_s(contexts: Sequence[Context]) -> float:
    """Largest airspeed of some flights, but for a glitch in a thousand [m/s]; 0 if none logged it."""
    return max((float(np.quantile(c.airspeed_m_s, 0.999)) for c in contexts if c.airspeed_s.size), default=0.0)


def usual_airspeed_m_s(contexts: Sequence[Context]) -> float:
    """Root mean square of the airspeed, median of the flights that logged it [m/s]; 0 if none did."""
    rms_m_s = [rms(context.airspeed_m_s) for context in contexts if context.airspeed_s.size]
    return float(np.median(rms_m_s)) if rms_m_s else 0.0


def usual_supply_v(context: Context) -> float:
    """Median supply [V]; 0 if it was never logged, or is none of a servo."""
    if not context.voltage_s.size:
        return 0.0
    volts = float(np.median(context.voltage_v))
    return volts if volts > _LEAST_SUPPLY_V else 0.0


def powers(context: Context, time_s: FloatArray, supply_v: float) -> FloatArray:
    """Supply over the usual one, shape (m,); 1 where either is not known."""
    if not supply_v or not context.voltage_s.size:
        return np.ones(time_s.size)
    return np.clip(latest(context.voltage_s, context.voltage_v, time_s) / supply_v, *_POWERS)
