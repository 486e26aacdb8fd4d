"""Tolerances under which good runs of a servo that was identified or explained are healthy."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.aircraft.series import Series, cut
from servofd.core.errors import DesignError, NoMeasurement
from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.tolerance import Tolerance
from servofd.detection.changes import STATISTICS, exceeded
from servofd.detection.faults import watched_segment
from servofd.detection.moving import Watched
from servofd.detection.named import NamedMoving, with_hold
from servofd.detection.residual import ResidualGenerator, ThresholdKind, noise_deg
from servofd.servo.servo_model import ServoModel

PERSISTENCE = 3
"""Judged samples in a row that make an alarm: a reading may be as old as the interval since the one before it, and so
may a command, and for as many samples a step of the command contradicts no servo."""
_ALIKE_S = 2.0
"""Samples within so long tell one thing."""
_MARGIN, _UNSURE = 1.25, 2.0
"""A threshold is so many times the largest statistic, and more where few blocks were seen."""
_LEAST_NOISE_DEG = 0.02
"""Smallest noise that is stated of a position [deg]."""
_STEP, _MOST_STEPS = 1.25, 24
"""Tolerances grow by this factor until a run is healthy under them, up to 200 times the usual ones."""


class Drafted(NamedTuple):
    """Tolerances under which the run that they come from raises no alarm."""

    tolerance: Tolerance
    level_deg: float
    """Median of the threshold that follows from it [deg]; the constant threshold where no tolerance is wide enough."""
    flight: Watched
    largest_deg: float
    """Largest residual of the run [deg]."""
    blocks: int
    """Stretches of the run that tell different things."""
    threshold: ThresholdKind = "interval"


def good_levels(aircraft: Aircraft, name: str, logs: Iterable[FlightLog]) -> dict[str, Any]:
    """Entries of a surface that make good runs healthy: tolerances drafted from them, and the origin of its model."""
    segments = []
    for log in logs:
        with suppress(NoMeasurement):
            segments.append(cut(log, name, aircraft))
    return levels_of(aircraft.model(name), segments)


def levels_of(model: ServoModel, segments: Iterable[Series]) -> dict[str, Any]:
    """Entries of a surface that this servo turns, under which good runs are healthy; empty if none can be judged."""
    drafts = []
    for segment in segments:
        with suppress(DesignError):
            drafts.append(draft_tolerance(model, segment))
    known = [drafted for drafted in drafts if drafted is not None]
    if not known:
        return {}
    each = [drafted.tolerance.model_dump() for drafted in known]
    error_deg = np.concatenate([drafted.flight.error_deg[drafted.flight.judged] for drafted in known])
    moved_deg = np.concatenate([drafted.flight.record.measured_deg[drafted.flight.judged] for drafted in known])
    power = float(np.mean(error_deg**2))
    threshold: ThresholdKind = "constant" if any(drafted.threshold == "constant" for drafted in known) else "interval"
    level_deg = max(drafted.level_deg for drafted in known)
    if threshold == "constant":  # the level of an interval says nothing of it, and all runs together tell more than one
        largest_deg = max(drafted.largest_deg for drafted in known)
        level_deg = round(_unsure(sum(drafted.blocks for drafted in known)) * largest_deg, 3)
    explained = 1.0 - power / max(float(np.var(moved_deg)), LEAST_DIVISOR)
    return {
        "threshold": threshold,
        "threshold_deg": level_deg,
        "tolerance": {key: max(one[key] for one in each) for key in each[0]},
        "persistence": PERSISTENCE,
        "suspicions": False,
        "model": {
            "origin": "fitted",
            "held_out_rms_deg": round(float(np.sqrt(power)), 4),
            "explained_share": round(min(explained, 1.0), 4),
            "good_runs": len(known),
        },
    }


def draft_tolerance(model: ServoModel, segment: Series) -> Drafted | None:
    """Tolerances drafted from a good run: the smallest under which no statistic of it comes near its threshold.

    None if nothing of it can be judged. The fewer blocks there are, the wider they become. Where the model is wrong by
    more than any tolerance allows, the run is healthy under a constant threshold above its largest residual.

    Raises `DesignError` if no residual filter suits the servo at this pace.
    """
    segment, _ = with_hold(model, segment)
    residuals = ResidualGenerator.fitting(model, segment.period_s).run(segment)
    usual = residuals.settled & np.isfinite(residuals.residual_deg)
    if not usual.any():
        return None
    base = Tolerance(noise_deg=max(round(noise_deg(residuals.error_deg[usual]), 4), _LEAST_NOISE_DEG))
    blocks = int(np.count_nonzero(np.diff(np.floor(residuals.time_s[usual] / _ALIKE_S), prepend=-np.inf)))
    unsure, largest_deg = _unsure(blocks), float(np.max(np.abs(residuals.residual_deg[usual])))
    flights = (_under(model, _scaled(base, _STEP**step), segment) for step in range(_MOST_STEPS))
    for step, flight in enumerate(flights):
        if unsure * _nearest(flight) < 1.0:
            level_deg = round(flight.shown.threshold.typical_deg, 3)
            return Drafted(_scaled(base, _STEP**step), level_deg, flight, largest_deg, blocks)
    return Drafted(base, round(unsure * largest_deg, 3), flight, largest_deg, blocks, "constant")


def _unsure(blocks: int) -> float:
    """Times the largest statistic of so many blocks that a threshold is."""
    return _MARGIN + _UNSURE / float(np.sqrt(blocks))


def _under(model: ServoModel, tolerance: Tolerance, segment: Series) -> Watched:
    """A run beside a servo that may differ by so much from its model."""
    plain = plain_aircraft(["surface"]).surfaces["surface"]
    surface = plain.model_copy(update={"tolerance": tolerance, "threshold": "interval", "persistence": PERSISTENCE})
    moving = NamedMoving(surface, model, segment.period_s, segment.context)
    return watched_segment(moving.known, segment, moving)


def _nearest(flight: Watched) -> float:
    """The largest statistic of a run over its threshold."""
    limits = flight.tests.limits
    by_windows = exceeded(limits, np.zeros(limits.size), flight.tested.statistics[:, : len(STATISTICS)])
    return max(float(by_windows.max(initial=0.0)), float(flight.shown.passed.max(initial=0.0)))


def _scaled(base: Tolerance, scale: float) -> Tolerance:
    """Every tolerance so many times as wide; lags, not bandwidths, grow with the scale."""
    lags = scale * base.bandwidth / (1.0 - base.bandwidth)
    return Tolerance(
        gain=round(min(scale * base.gain, 0.9), 4),
        delay_s=round(scale * base.delay_s, 5),
        bandwidth=round(lags / (1.0 + lags), 4),
        rate=round(min(scale * base.rate, 0.9), 4),
        bias_deg=round(scale * base.bias_deg, 4),
        noise_deg=base.noise_deg,
    )
