"""Odds of an aircraft's surfaces: from the design alone, or from the residuals of healthy flights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from logparsers.units import S_PER_HOUR
from servofd.aircraft.pace import SLOWEST_RATE_HZ
from servofd.core.errors import ConfigError
from servofd.detection.probability import Noise, crossings
from servofd.detection.pulse import PulseFilter, design_pulse_filter, fastest_pole_rad_s

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.detection.verdict import LogAudit, SurfaceAudit

_FASTEST_RATE_HZ = 10_000.0
"""Fastest rate of positions for which odds are given [Hz]."""
_LARGEST_NOISE_DEG = 10.0
"""A position that scatters more is none: surfaces move by some 25 deg."""
_SAME_RATE = 0.1
"""Share by which the sample times of two logs may differ to be taken together."""
_SHORTEST_S = 10.0
"""Shortest record that gives the noise [s], as in the audit."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceOdds:
    """What noise does to the residual of one surface."""

    surface: str
    servo: str
    design: PulseFilter
    noise: Noise
    threshold_deg: float
    """Threshold in force [deg]."""
    hours: float = 0.0
    """Healthy data behind the noise [h]; 0 if it comes from the design."""
    alarms: int | None = None
    """Times that it crossed the threshold in these hours; None if it comes from the design."""
    notes: tuple[str, ...] = ()


def odds_from_logs(audits: Iterable[LogAudit]) -> tuple[list[SurfaceOdds], dict[str, str]]:
    """Odds of each surface from its residuals in all logs in which it is healthy, and why others have none.

    A log whose sample rate, filter or servo differs from that of the first is left out, which a note says.
    """
    met: dict[str, list[tuple[LogAudit, SurfaceAudit]]] = {}
    for audit in audits:
        for surface in audit.surfaces:
            if surface.expected or surface.status == "healthy":
                met.setdefault(surface.surface, []).append((audit, surface))
    found, missing = [], {}
    for name, each in met.items():
        odds = _pooled(name, each)
        if isinstance(odds, str):
            missing[name] = odds
        else:
            found.append(odds)
    return found, missing


def odds_from_design(
    aircraft: Aircraft, *, noise_deg: float, rate_hz: float, surfaces: tuple[str, ...] = ()
) -> list[SurfaceOdds]:
    """Odds of each surface if its position carries white Gaussian noise and the model is right.

    `noise_deg`: standard deviation of the noise of the measured deflection [deg], at most 10. `surfaces`: which; all
    that are measured if empty.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> plane = plain_aircraft(["elevator"], "hs225bb-eq31")
    >>> (odds,) = odds_from_design(plane, noise_deg=0.1, rate_hz=100.0)
    >>> round(odds.noise.threshold_deg(1e-6), 3)
    0.292
    """
    if not SLOWEST_RATE_HZ <= rate_hz <= _FASTEST_RATE_HZ:
        usual = f"give {SLOWEST_RATE_HZ:g} to {_FASTEST_RATE_HZ:g} Hz"
        raise ConfigError(f"{rate_hz:g} Hz is no rate of positions: {usual}")
    if not 0.0 < noise_deg <= _LARGEST_NOISE_DEG:
        usual = f"give more than 0 and at most {_LARGEST_NOISE_DEG:g} deg"
        raise ConfigError(f"{noise_deg:g} deg is no noise of positions: {usual}")
    note = f"designed for white noise of {noise_deg:g} deg, not measured"
    result = []
    for name in surfaces or [name for name, surface in aircraft.surfaces.items() if surface.measured is not None]:
        design, entry = _design(aircraft, name, 1.0 / rate_hz), aircraft.surfaces[name]
        noise = Noise.designed(design, noise_deg)
        result.append(SurfaceOdds(name, entry.servo, design, noise, entry.threshold_deg, notes=(note,)))
    return result


def _design(aircraft: Aircraft, surface: str, sample_time_s: float) -> PulseFilter:
    model = aircraft.model(surface)
    pole = aircraft.surfaces[surface].filter_pole_rad_s or fastest_pole_rad_s(model.transfer, sample_time_s)
    return design_pulse_filter(model.transfer, model.delay_s, sample_time_s, pole)


def _pooled(name: str, met: list[tuple[LogAudit, SurfaceAudit]]) -> SurfaceOdds | str:
    """The odds of one surface from all its logs, or why there are none."""
    notes, records = [], []
    design, servo, threshold_deg = None, "", 0.0
    for audit, surface in met:
        log = audit.log.source.name
        if surface.status != "healthy" or surface.residuals is None or surface.segment is None:
            notes.append(f"{log} left out, {surface.status}: {surface.reason}")
            continue
        own = _design(audit.aircraft, name, surface.segment.period_s)
        if design is None:
            design, servo, threshold_deg = own, surface.servo, surface.threshold_deg
        ratio = own.sample_time_s / design.sample_time_s
        if abs(ratio - 1.0) > _SAME_RATE or own.pole_rad_s != design.pole_rad_s or surface.servo != servo:
            notes.append(f"{log} left out, its rate, filter or servo differs")
            continue
        judged = np.where(surface.residuals.settled, surface.residuals.residual_deg, np.nan)
        records.append(np.append(judged, np.nan))  # no sample of one log is the neighbour of one of another
    if design is None:
        return "; ".join(notes)
    residual_deg = np.concatenate(records)
    judged_s = np.count_nonzero(np.isfinite(residual_deg)) * design.sample_time_s
    if judged_s < _SHORTEST_S:
        return f"less than {_SHORTEST_S:g} s of healthy data"
    noise = Noise.measured(residual_deg, design.sample_time_s)
    if not noise.sigma_deg > 0.0:
        return "the residual never changes: there is no noise to judge by"
    alarms = crossings(residual_deg, threshold_deg)
    hours = judged_s / S_PER_HOUR
    return SurfaceOdds(name, servo, design, noise, threshold_deg, hours, alarms=alarms, notes=tuple(notes))
