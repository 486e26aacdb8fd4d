"""Manoeuvres that would tell apart what these data do not: where two fitted servos differ most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from servofd.core.series import rms
from servofd.core.types import FloatArray
from servofd.discrepancy.record import Record, simulate
from servofd.discrepancy.search import LIMITS, STEPS_OF_TWO_SIZES
from servofd.discrepancy.select import Selection
from servofd.servo.effects.commands import Commands

_RATE_HZ, _DURATION_S = 100.0, 24.0
"""Rate [Hz] and length [s] of a manoeuvre."""
_SETTLING_S = 0.5
_TELLING_SIGMAS = 4.0
"""Less than this could be noise."""
_AS_GOOD = 0.8
"""A simpler manoeuvre is preferred if it shows this share of what the best one shows."""
_AIR_PA = (88.0, 551.0)
"""Dynamic pressure at 12 and 30 m/s."""
_CRUISE_PA, _SUPPLY_V, _SAGGING_V = 246.0, 6.0, 4.8
"""Dynamic pressure at 20 m/s [Pa], supply of a full battery and of one that sags [V]."""


class Manoeuvre(NamedTuple):
    """Something that can be flown, or done on the bench."""

    name: str
    command: Callable[[FloatArray], FloatArray]
    """Command [deg], shape (n,), at times [s], shape (n,), from 0 to 24 s."""
    air_changes: bool = False
    supply_sags: bool = False


def _levels(each_s: float, *levels_deg: float) -> Callable[[FloatArray], FloatArray]:
    """Each level for some time, over and over."""
    return lambda t: np.array(levels_deg)[(t // each_s).astype(int) % len(levels_deg)]


def _triangle(size_deg: float, period_s: float) -> Callable[[FloatArray], FloatArray]:
    corners_s, corners_deg = period_s * np.arange(5) / 4.0, size_deg * np.array([0.0, 1.0, 0.0, -1.0, 0.0])
    return lambda t: np.interp(t % period_s, corners_s, corners_deg)


def _sine(size_deg: float, frequency_hz: float) -> Callable[[FloatArray], FloatArray]:
    return lambda t: size_deg * np.sin(2.0 * np.pi * frequency_hz * t)


def _chirp(sizes_deg: tuple[float, ...], low_hz: float, high_hz: float) -> Callable[[FloatArray], FloatArray]:
    def command(t: FloatArray) -> FloatArray:
        length_s = _DURATION_S / len(sizes_deg)
        part = np.minimum((t / length_s).astype(int), len(sizes_deg) - 1)
        local_s = t - part * length_s
        growth = np.log(high_hz / low_hz) / length_s
        swept: FloatArray = np.array(sizes_deg)[part] * np.sin(
            2.0 * np.pi * low_hz * (np.exp(growth * local_s) - 1.0) / growth
        )
        return swept

    return command


MANOEUVRES: tuple[Manoeuvre, ...] = (
    *(Manoeuvre(f"a step of {size:g} deg", _levels(2.0, 0.0, size)) for size in (2.0, 5.0, 10.0, 20.0)),
    *(Manoeuvre(f"a doublet of {size:g} deg", _levels(0.5, size, -size, 0.0, 0.0, 0.0, 0.0)) for size in (5.0, 10.0)),
    *(Manoeuvre(f"a slow triangle of {size:g} deg (8 s)", _triangle(size, 8.0)) for size in (2.0, 10.0)),
    *(
        Manoeuvre(f"a sine of {size:g} deg at {rate:g} Hz", _sine(size, rate))
        for size, rate in ((1.0, 1.0), (5.0, 1.0), (15.0, 1.0), (5.0, 4.0))
    ),
    Manoeuvre("a chirp of 1, 3 and 9 deg from 0.3 to 8 Hz", _chirp((1.0, 3.0, 9.0), 0.3, 8.0)),
    Manoeuvre("sines of 10 deg at 0.5 Hz from 12 to 30 m/s", _sine(10.0, 0.5), air_changes=True),
    Manoeuvre("steps of 20 deg while the supply sags from 6 to 4.8 V", _levels(2.0, 0.0, 20.0), supply_sags=True),
)
"""Simple before complicated."""
_BY_SIZE = (Manoeuvre(STEPS_OF_TWO_SIZES, _levels(2.0, 0.0, 5.0, 0.0, 20.0)),)
"""What tells a limit of the speed from slow poles: the one takes longer for larger steps."""


@dataclass(frozen=True, slots=True)
class Separation:
    """The manoeuvre that tells two effects apart."""

    effects: tuple[str, str]
    """The named one first."""
    manoeuvre: str | None
    """None if command and position never tell them apart."""
    difference_deg: float
    """Largest difference between the two servos in it, or in any manoeuvre if none tells."""
    sigmas: float
    """The same in standard deviations of the noise."""

    @property
    def sentence(self) -> str:
        """In words."""
        one, two = (name.replace("_", " ") for name in self.effects)
        if self.manoeuvre is None:
            return f"no manoeuvre tells {one} from {two} by command and position alone"
        return f"{self.manoeuvre} tells {one} from {two} (differs by {self.sigmas:.0f} sigma)"

    def document(self) -> dict[str, Any]:
        """Plain dictionary."""
        return {**asdict(self), "effects": list(self.effects), "sentence": self.sentence}


def in_words(found: Sequence[Separation]) -> list[str]:
    """What tells effects apart, one sentence for all that a manoeuvre tells from the same one.

    Examples
    --------
    >>> tells = [Separation(("gain", other), "a step of 20 deg", 1.0, 6.0) for other in ("delay", "sensor_lag")]
    >>> in_words(tells)
    ['a step of 20 deg tells gain from delay and sensor lag (differs by 6 sigma or more)']
    """
    together: dict[tuple[str | None, str], list[Separation]] = {}
    for each in found:
        together.setdefault((each.manoeuvre, each.effects[0]), []).append(each)
    sentences = []
    for (manoeuvre, one), alike in together.items():
        if len(alike) == 1:
            sentences.append(alike[0].sentence)
            continue
        *others, last = (each.effects[1] for each in alike)
        names = f"{one} from {', '.join(others)} and {last}".replace("_", " ")
        least = min(each.sigmas for each in alike)
        sentences.append(
            f"no manoeuvre tells {names} by command and position alone"
            if manoeuvre is None
            else f"{manoeuvre} tells {names} (differs by {least:.0f} sigma or more)"
        )
    return sentences


def separations(selection: Selection) -> tuple[Separation, ...]:
    """For each pair of effects that a record cannot tell apart, what would.

    Both servos as they were fitted to the record are sent through a library of manoeuvres. The one in which they
    differ most, in the rms of 24 s, is named; a simpler one, if it shows nearly as much.
    """
    record, sigma_deg, found = selection.fitter.record, selection.sigma_deg, []
    pairs = [(name, other, rival) for name, rivals in selection.rivals.items() for other, rival in rivals.items()]
    for name, other, rival in pairs:
        library = _BY_SIZE if {name, other} & set(LIMITS) and "slow_dynamics" in (name, other) else MANOEUVRES
        flown = [_flown(record, manoeuvre) for manoeuvre in library]
        physics = selection.final.physics, rival.physics
        apart = [np.subtract(*(simulate(each, servo)[each.counts] for servo in physics)) for each in flown]
        rms_deg = np.array([rms(each) for each in apart])
        most_deg = np.array([np.max(np.abs(each)) for each in apart])
        tells = most_deg >= _TELLING_SIGMAS * sigma_deg
        shows = tells & (rms_deg >= _AS_GOOD * rms_deg.max())
        best = int(np.argmax(shows)) if shows.any() else int(np.argmax(most_deg))
        size_deg = float(most_deg[best] if tells.any() else most_deg.max())
        told_by = library[best].name if tells.any() else None
        found.append(Separation((name, other), told_by, size_deg, size_deg / sigma_deg))
    return tuple(found)


def _flown(record: Record, manoeuvre: Manoeuvre) -> Record:
    """The servo of a record in a manoeuvre."""
    time_s = np.arange(round(_DURATION_S * _RATE_HZ)) / _RATE_HZ
    share, ones = time_s / _DURATION_S, np.ones(time_s.size)
    command_deg = manoeuvre.command(time_s)
    pressure_pa = _AIR_PA[0] + share * (_AIR_PA[1] - _AIR_PA[0]) if manoeuvre.air_changes else _CRUISE_PA * ones
    supply_v = _SUPPLY_V - share * (_SUPPLY_V - _SAGGING_V) if manoeuvre.supply_sags else _SUPPLY_V * ones
    return replace(
        record,
        commands=Commands(time_s, command_deg, np.zeros(time_s.size)),
        time_s=time_s,
        measured_deg=np.full(time_s.size, record.model.transfer.dc_gain * command_deg[0]),
        counts=time_s > _SETTLING_S,
        block=np.zeros(time_s.size, dtype=np.int64),
        fold=np.zeros(time_s.size, dtype=np.int64),
        logged={"airspeed_m_s": pressure_pa, "servo_voltage_v": supply_v},
        pushed=None,
        runs=(),
        side=None,
    )
