"""Bench tests in logs: which channels they are, and the servo they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from logparsers import FlightLog, LogFile
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import Series, cut
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.core.types import FloatArray
from servofd.feedback.flown import log_files, logs_of, surfaces_of
from servofd.identification.identify import identify as identify_records
from servofd.identification.result import Identification

if TYPE_CHECKING:
    from typing_extensions import TypeIs

    from servofd.feedback.flown import Log

_CHIRP_COMMAND, _CHIRP_POSITION = "SCRP.PWM", "SCRP.Pos"
"""Written by ArduPilot's applet ``actuator_chirp.lua``: pulse [us] and position of the servo's telemetry [deg]."""
_NO_POSITION = -1.0
"""What the applet writes while the servo has sent none."""
_CHIRP_SURFACE = "servo"


@dataclass(frozen=True, slots=True)
class BenchTest:
    """One test, and where it comes from."""

    segment: Series
    source: str
    """Channels and how they were read, in words."""
    pulse_us: FloatArray | None = None
    """Commands as pulses [us], shape (n,), if it is not known how many degrees they ask for."""


def bench_tests(path: LogFile, aircraft: Aircraft | None = None, surface: str | None = None) -> tuple[BenchTest, ...]:
    """Take the tests of one servo out of a log; several if the file holds several runs."""
    found, reasons = [], []
    for log in logs_of(path, aircraft):
        if aircraft is None and _CHIRP_COMMAND in log.channels:
            found.append(_chirp_script(log))
            continue
        try:
            only = () if surface is None else (surface,)
            found.append(_of_surface(log, surfaces_of(log, aircraft, fitted=only), surface))
        except NoMeasurement as error:
            reasons.append(error)
    if not found:
        raise reasons[0]
    return tuple(found)


def identify(
    tests: Log | Sequence[Log] | Series | Sequence[Sequence[Series]],
    aircraft: Aircraft | None = None,
    *,
    surface: str | None = None,
    order: int | None = None,
    progress: Callable[[str], object] = str,
) -> Identification:
    """Identify a servo from chirps, steps or other motion; of several of one kind, their mean.

    Parameters
    ----------
    tests : str, Path, DataFrame, Series, or sequence of them
        Logs of bench tests, or what was asked of a servo and what it did: of one, or of each servo a sequence.
    aircraft : Aircraft, optional
        Which channels they are, of logs that do not say.
    surface : str, optional
        Which surface of the logs.
    order, progress
        As of `servofd.identification.identify.identify`.

    Raises
    ------
    IdentificationError
        If a test does not show what a servo is like.

    Examples
    --------
    >>> found = identify("sample_logs/faser_healthy_chirp.mat", surface="aileron_right")
    >>> found.servo.linear.order, abs(found.servo.linear.transfer.bandwidth_rad_s / 28.49 - 1.0) < 0.05
    (3, True)
    """
    if isinstance(tests, Series) or _are_segments(tests):
        return identify_records(tests, order=order, progress=progress)
    paths = log_files(tests)
    found = [bench_tests(path, aircraft, surface) for path in paths]
    labels = [label_of(path) for path in paths]
    sources = tuple(dict.fromkeys(test.source for one in found for test in one))
    segments = [[test.segment for test in one] for one in found]
    result = identify_records(segments, order=order, labels=labels, progress=progress)
    if not any(test.pulse_us is not None for one in found for test in one):
        return replace(result, notes=(*sources, *result.notes))
    gain, pulse_us, first = result.servo.linear.gain, found[0][0].pulse_us, segments[0][0]
    slope = gain if pulse_us is None else gain * float(np.polyfit(pulse_us, first.command_deg, 1)[0])
    scaled = [
        [replace(test, command_deg=gain * test.command_deg + result.offset_deg) for test in one] for one in segments
    ]
    result = identify_records(scaled, order=order, labels=labels)
    scale = f"pulses were converted with the scale that gives a dc gain of 1: {slope:.5f} deg/us"
    return replace(result, notes=(*sources, scale, *result.notes))


def _are_segments(tests: object) -> TypeIs[Sequence[Sequence[Series]]]:
    return isinstance(tests, list | tuple) and bool(tests) and all(isinstance(one, list | tuple) for one in tests)


def label_of(log: object) -> str:
    """Path of a log; of an open one its name."""
    return str(log if isinstance(log, str | Path) else getattr(log, "name", "log"))


def _of_surface(log: FlightLog, aircraft: Aircraft, surface: str | None) -> BenchTest:
    if surface is not None:
        aircraft.check_names([surface], log.label)
    segments: dict[str, Series] = {}
    reasons = []
    for name in [surface] if surface is not None else aircraft.surfaces:
        try:
            segments[name] = cut(log, name, aircraft)
        except NoMeasurement as error:
            reasons.append(f"{log.label}: {name}: {error}")
    if not segments:
        raise NoMeasurement(reasons[0])
    if len(segments) > 1:
        names = ", ".join(segments)
        raise ConfigError(f"{log.label}: {len(segments)} servos were measured: choose one of {names} with -s")
    ((name, segment),) = segments.items()
    entry = aircraft.surfaces[name]
    measured = entry.measured.channel if entry.measured is not None else ""
    return BenchTest(segment, f"command from {entry.command.channel}, position from {measured}")


def _chirp_script(log: FlightLog) -> BenchTest:
    """Test of ArduPilot's chirp applet: its telemetry comes more seldom than its rows, and repeats meanwhile."""
    command, position = log[_CHIRP_COMMAND], log[_CHIRP_POSITION]
    values = np.where(position.values == _NO_POSITION, np.nan, position.values)
    fresh = np.isfinite(values) & (np.diff(values, prepend=np.nan) != 0.0)
    if np.count_nonzero(fresh) < 2:
        raise NoMeasurement(
            f"{log.label}: SCRP holds no position (Pos is {_NO_POSITION:g} throughout): the applet needs a servo with "
            "telemetry (DroneCAN, Volz, ...) and ACHRP_TYPE = 1"
        )
    measured_deg = values[fresh]
    sign = np.sign(np.corrcoef(np.interp(position.time_s[fresh], command.time_s, command.values), measured_deg)[0, 1])
    slope = float(sign or 1.0) * float(np.std(measured_deg)) / max(float(np.std(command.values)), 1e-9)
    command_deg = slope * (command.values - float(np.mean(command.values)))
    rate_hz = np.count_nonzero(fresh) / max(log.duration_s, 1e-9)
    return BenchTest(
        Series(_CHIRP_SURFACE, command.time_s, command_deg, position.time_s[fresh], measured_deg),
        f"command from {_CHIRP_COMMAND} [us], position from {_CHIRP_POSITION} (ArduPilot actuator_chirp.lua); rows "
        f"that repeat a position were left out, which leaves {rate_hz:.0f} Hz",
        pulse_us=command.values,
    )
