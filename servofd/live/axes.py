"""Axes of a flying aircraft, judged once a second on what every autopilot sends."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from logparsers.records import Channel, FlightLog
from servofd.aircraft.axes import MotionModel
from servofd.axes.judge import judge_motion
from servofd.axes.read import motion_of
from servofd.axes.verdict import AxisAudit, AxisEvent, named
from servofd.core.errors import NoMeasurement
from servofd.detection.event import Event

STREAMED = {
    "SERVO_OUTPUT_RAW": tuple(f"servo{number}_raw" for number in range(1, 17)),
    "RAW_IMU": ("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc"),
    "ATTITUDE": ("roll", "pitch"),
    "VFR_HUD": ("airspeed",),
}
"""Messages that every autopilot sends, and what motion needs of them."""
_LOGGED = (
    *(f"{imu}.{what}{axis}" for imu in ("IMU[0]", "IMU") for what in ("Gyr", "Acc") for axis in "XYZ"),
    *("ATT.Roll", "ATT.Pitch", "ARSP[0].Airspeed", "ARSP.Airspeed", "CTUN.As"),
)
_EVERY_S = 1.0
_KEPT_S, _LONGEST_S = 150.0, 300.0
"""What is judged grows to the longer, then falls back to the shorter: several times the longest window."""
_NAMED_S = 2.0
"""So long after an alarm it is said which axis is the cause, and whether it acts late or too little."""


@dataclass(slots=True)
class AxisWatch:
    """What is known of one flying aircraft's axes.

    `model`: from calibration; it holds the mixer as well, so that no parameter need be asked for.
    """

    model: MotionModel
    audits: tuple[AxisAudit, ...] = ()
    """Of the latest judgement."""
    problem: str = "no message of its motion came"
    """Why nothing is judged; empty once something is."""
    has_fault: bool = False
    has_suspect: bool = False
    _samples: dict[str, tuple[list[float], list[float]]] = field(default_factory=dict)
    _judged_s: float = -math.inf
    _begun_s: float = math.nan
    _standing: dict[str, float] = field(default_factory=dict)
    """Alarms that stand: when each was raised [s]."""

    @property
    def channels(self) -> list[str]:
        """Names of the channels that a log may give it."""
        outputs = {int(name.removeprefix("SERVO").partition("_")[0]) for name in self.model.parameters}
        return [*(f"RCOU.C{number}" for number in sorted(outputs)), *_LOGGED]

    def receive(self, message: str, fields: Mapping[str, object], time_s: float) -> None:
        """Take a message of a stream."""
        for name in STREAMED.get(message, ()):
            value = fields.get(name)
            if isinstance(value, int | float):
                self.add(f"{message}.{name}", time_s, float(value))

    def add(self, channel: str, time_s: float, value: float) -> None:
        """Take one sample."""
        times, values = self._samples.setdefault(channel, ([], []))
        if not times or time_s > times[-1]:
            times.append(time_s)
            values.append(value)

    def restart(self) -> None:
        """The aircraft has booted: its clock begins anew."""
        self._samples.clear()
        self._judged_s = -math.inf

    def due(self, now_s: float) -> list[Event]:
        """Judge what is known, once a second, and tell what changed."""
        if not now_s - self._judged_s >= _EVERY_S:
            return []
        self._judged_s = now_s
        self._forget(now_s)
        try:
            motion = motion_of(self._log(), self.model.rate_hz, self.model.parameters)
        except NoMeasurement as error:
            self.problem = str(error).partition(": ")[2] or str(error)
            return []
        if motion.time_s.size < self.model.rate_hz:
            return []
        self.audits, self.problem = judge_motion(self.model, motion), ""
        return [event for audit in self.audits for event in self._changes(audit, now_s)]

    def _changes(self, audit: AxisAudit, now_s: float) -> Iterable[Event]:
        axis = audit.axis
        if axis == "thrust":
            return
        raised_s = self._standing.get(axis)
        ongoing = [event for event in audit.events if event.end_s is None and event.is_own]
        if raised_s is None:
            new = next((event for event in ongoing if now_s - event.alarm_s < _KEPT_S), None)
            if new is not None:
                self._standing[axis] = new.alarm_s
                self.has_suspect = True
                yield Event(now_s, axis, "alarm", "unknown", text=f"{named(audit.members, axis)}: alarm of its motion")
            return
        event = max(audit.events, key=lambda one: one.score, default=None)
        if event is not None and now_s - raised_s >= _NAMED_S:
            yield Event(now_s, axis, "named", _kind(event, audit), text=audit.reason)
        self.has_fault |= audit.status == "fault"
        if audit.score.size and not ongoing and not any(event.cause for event in audit.events if event.end_s is None):
            del self._standing[axis]
            yield Event(now_s, axis, "clear", text="answers its command again")

    def _forget(self, now_s: float) -> None:
        if math.isnan(self._begun_s):
            self._begun_s = now_s
        elif now_s - self._begun_s > _LONGEST_S:
            self._begun_s = now_s - _KEPT_S
            for channel, (times, values) in self._samples.items():
                keep = int(np.searchsorted(times, self._begun_s))
                self._samples[channel] = (times[keep:], values[keep:])

    def _log(self) -> FlightLog:
        channels = {
            name: Channel(name, np.array(times), np.array(values), "", name)
            for name, (times, values) in self._samples.items()
            if len(times) > 1
        }
        kind = "tlog" if any(name.startswith("SERVO_OUTPUT_RAW") for name in channels) else "dataflash"
        return FlightLog(Path("live"), kind, channels)


def _kind(event: AxisEvent, audit: AxisAudit) -> str:
    if event.cause:
        return "unknown"
    if event.lag_s is not None:
        return "slow"
    return "bias" if event.lost_share.high < 0.25 and audit.is_expected else "loss_of_effectiveness"
