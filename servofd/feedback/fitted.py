"""Servos fitted to the very log that is judged: what is done where none is named or calibrated."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import numpy as np

from servofd.aircraft.schema import Surface
from servofd.aircraft.series import bus_of, cut
from servofd.core.errors import NoMeasurement
from servofd.core.evidence import ModelOrigin
from servofd.detection.causes import before_it_fell
from servofd.detection.flights import cropped
from servofd.detection.known import Line, crude_line
from servofd.detection.lasting import slow_together
from servofd.detection.own import OwnServo, fitted_to, own_servo, parts_of
from servofd.estimate.record import Record
from servofd.servo.library import ORDINARY, Servo

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.series import Series
    from servofd.core.types import Marks
    from servofd.detection.flights import Span

_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 1e-4, 0.2
"""Sample periods between which a servo is fitted [s]."""
_FAR_GAINS: Final = (1.0 / 3.0, 3.0)
"""A scale that is further from one is no servo's: the command is another unit, or reversed."""
_SCALES: Final = (0.005, 200.0)
"""A position in radians, or one of a command in them, moves by a 57th or 57 times as much."""
_PARTS: Final = 3
"""Parts of a log whose scales are compared."""
_SAME_SLOPE: Final = 0.3
"""Share by which the slopes of two parts differ that are one."""

Asked = TypeVar("Asked")
Given = TypeVar("Given")


class Found(NamedTuple):
    """What a log tells of one surface."""

    line: Line
    """By which its command becomes degrees of its position."""
    servo: OwnServo | ModelOrigin
    """Its servo; where none is found, how well the best one explains the log."""


def fitted_aircraft(
    log: FlightLog, aircraft: Aircraft, only: Iterable[str] | None = None, *, is_draft: bool = False
) -> Aircraft:
    """Return the same aircraft with servos fitted to a log; of one that is drafted, pulses have no known scale."""
    surfaces, servos, bus = dict(aircraft.surfaces), dict(aircraft.servos), bus_of(log, aircraft)
    names = list(aircraft.surfaces if only is None else only)
    free = {name for name in names if is_draft and has_free_scale(surfaces[name])}

    def found(name: str, before_s: float = np.inf) -> Found:
        return found_in(log, name, aircraft, bus, free_scale=name in free, before_s=before_s)

    each = at_once(found, names)
    since_s = slow_together([one.servo.lasting for one in each if isinstance(one.servo, OwnServo)])
    if np.isfinite(since_s):  # what came before is sound
        before = at_once(lambda name: found(name, since_s), names)
        each = [one if isinstance(one.servo, OwnServo) else was for one, was in zip(before, each, strict=True)]
    for name, one in zip(names, each, strict=True):
        line, surface = one.line, surfaces[name]
        if is_draft:
            line, surface = Line(), with_line(surface, line)
        surfaces[name], fitted = with_own_servo(surface, name, Found(line, one.servo))
        servos |= fitted
    return aircraft.model_copy(update={"surfaces": surfaces, "servos": servos})


def has_free_scale(surface: Surface) -> bool:
    """Whether a surface of an autopilot's log is asked in pulses, or shares of its travel."""
    return surface.command.unit in ("us", "norm")


def with_line(surface: Surface, line: Line) -> Surface:
    """The same surface with a command that a straight line turns into degrees of its position."""
    if line == Line():
        return surface
    if not has_free_scale(surface):
        corrected = surface.command.corrected(line.gain, line.offset_deg)
        return surface.model_copy(update={"command": corrected})
    command = _rescaled(surface.command.model_dump(exclude_none=True), line)
    return Surface.model_validate({**surface.model_dump(exclude_defaults=True), "command": command})


def _rescaled(command: dict[str, Any], line: Line) -> dict[str, Any]:
    """Command entry with the fitted straight line: gain (value - trim) + offset."""
    slope_key, trim_key = ("slope_deg_per_us", "trim_us") if command["unit"] == "us" else ("slope_deg", "trim")
    slope = command[slope_key]
    sign = int(np.sign(line.gain)) * command.get("sign", 1)
    trim = command[trim_key] - line.offset_deg / (line.gain * command.get("sign", 1) * slope)
    return {**command, "sign": sign, trim_key: round(float(trim), 4), slope_key: round(abs(line.gain) * slope, 6)}


def at_once(fitted: Callable[[Asked], Given], each: Sequence[Asked]) -> list[Given]:
    """Return what is fitted to each of several surfaces, one a core: the kernel runs without the interpreter's lock."""
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        return list(pool.map(fitted, each))


def found_in(
    log: FlightLog,
    name: str,
    aircraft: Aircraft,
    bus: Mapping[str, Marks],
    *,
    free_scale: bool = False,
    before_s: float = np.inf,
) -> Found:
    """Servo of a surface as fitted to a log, with the scale of its command where that is not known.

    What comes before a time [s] is the part that is sound, if that is known.
    """
    nothing = Found(Line(), ModelOrigin(origin="none"))
    try:
        segment = cut(log, name, aircraft, bus)
    except NoMeasurement:
        return nothing
    segment = replace(segment, context=before_it_fell(segment.context))
    if not _SHORTEST_PERIOD_S < segment.period_s < _LONGEST_PERIOD_S or segment.command_s.size < 2:
        return nothing
    line = _line_of(segment, is_free=free_scale)
    if line is None or not free_scale:
        own = own_servo(segment, log.source.name, before_s=before_s)
        share = own.origin.explained_share if isinstance(own, OwnServo) else 0.0
        if line is None or _is_usual(line) or (share or 0.0) >= line.correlation**2:
            return Found(Line(), own)
    own = own_servo(segment.with_commands(line.gain, line.offset_deg), log.source.name, before_s=before_s)
    if not isinstance(own, OwnServo):
        return Found(Line(), own)
    if free_scale:
        gain, offset_deg = own.known.parameters["gain"], own.known.offset_deg
        return Found(Line(gain * line.gain, gain * line.offset_deg + offset_deg), own.with_own_scale())
    what = "sign" if line.gain < 0.0 else "scale"
    doubt = f"its position is {line.gain:.2f}x the command throughout: check the {what} of the calibration"
    return Found(line, replace(own, known=own.known.model_copy(update={"doubt": doubt})))


def scaled_aircraft(log: FlightLog, aircraft: Aircraft, spans: tuple[Span, ...] = ()) -> Aircraft:
    """Return the same aircraft with the scales of its commands in a log that is good, and nothing of its servos.

    It is good in some spans [s]; everywhere if there are none.
    """
    surfaces, bus = aircraft.surfaces, bus_of(log, aircraft)
    names = [name for name, surface in surfaces.items() if not surface.names_servo]
    lines = at_once(lambda name: _good_line(log, name, aircraft, bus, spans), names)
    scaled = {name: with_line(surfaces[name], line) for name, line in zip(names, lines, strict=True)}
    return aircraft.model_copy(update={"surfaces": surfaces | scaled})


def _good_line(
    log: FlightLog, name: str, aircraft: Aircraft, bus: Mapping[str, Marks], spans: tuple[Span, ...]
) -> Line:
    """How the position goes with the command in parts of a log that are known to be good [s]; in all of it without.

    Where its scale is known, only a line that is no servo's counts, if no servo explains the position as well.
    """
    try:
        segment = cropped(cut(log, name, aircraft, bus), spans)
    except NoMeasurement:
        return Line()
    if segment.command_s.size < 2 or segment.measured_s.size < 2:
        return Line()
    is_free = log.is_of_autopilot and has_free_scale(aircraft.surfaces[name])
    line = _line_of(segment, is_free=is_free)
    if line is None or (not is_free and _is_usual(line)):
        return Line()
    fitted = fitted_to(segment.with_commands(line.gain, line.offset_deg) if is_free else segment)
    if not is_free:
        return line if fitted is None or fitted.explained_share < line.correlation**2 else Line()
    if fitted is None:
        return line
    gain = float(fitted.theta[0])
    return Line(gain * line.gain, gain * line.offset_deg + fitted.offset_deg)


def _line_of(segment: Series, *, is_free: bool) -> Line | None:
    """Return how the position goes with the command, in the part of a log in which it does so most.

    Of a command whose scale is known it has to be so in two parts: an autopilot answers a jam the other way.
    """
    lines = [crude_line(Record.of(part)) for _, part in parts_of(segment, _PARTS)]
    known = [line for line in lines if line is not None and _SCALES[0] <= abs(line.gain) <= _SCALES[1]]
    best = max(known, key=lambda line: line.correlation, default=None)
    alike = [line for line in known if best is not None and abs(line.gain - best.gain) < _SAME_SLOPE * abs(best.gain)]
    return best if is_free or len(alike) > 1 else None


def _is_usual(line: Line) -> bool:
    return _FAR_GAINS[0] <= line.gain <= _FAR_GAINS[1]


def with_own_servo(surface: Surface, name: str, found: Found) -> tuple[Surface, dict[str, Servo]]:
    """Return a surface with the servo that a log tells of, and that servo by its name."""
    line, own = found
    key = f"{name}-fitted"
    plain = surface.model_copy(update={"effects": {}, "calibrated": None})
    if isinstance(own, ModelOrigin):
        return plain.model_copy(update={"model": own, "servo": key}), {key: ORDINARY}
    change: dict[str, object] = {
        "servo": key,
        "threshold": "interval",
        "threshold_deg": own.threshold_deg,
        "tolerance": own.tolerance,
        "model": own.origin,
        "calibrated": own.known,
        "command": surface.command.corrected(line.gain, line.offset_deg),
    }
    if surface.command_saturation_deg is not None:
        ends = (line.gain * end + line.offset_deg for end in surface.command_saturation_deg)
        change["command_saturation_deg"] = tuple(sorted(ends))
    return plain.model_copy(update=change), {key: own.linear}
