"""Odds of an aircraft's surfaces: from the design alone, or from the residuals of healthy flights."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from logparsers.units import S_PER_HOUR
from servofd.aircraft.series import SLOWEST_RATE_HZ
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.detection.probability import Noise, SurfaceOdds, Wish, fit_tail, surface_odds
from servofd.detection.pulse import PulseFilter, design_pulse_filter, fastest_pole_rad_s

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.aircraft.schema import Aircraft
    from servofd.core.types import FloatArray
    from servofd.detection.verdict import LogAudit

_FASTEST_RATE_HZ = 10_000.0
"""Fastest rate of positions for which odds are given [Hz]."""
_LARGEST_NOISE_DEG = 10.0
"""A position that scatters more is none: surfaces move by some 25 deg."""
_APART_TIME_CONSTANTS = 7.5
"""Peaks of the residual further apart than so many time constants of its filter are independent."""
_SAME_RATE = 0.1
"""Share by which the sample times of two logs may differ to be taken together."""
_SHORTEST_S = 10.0
"""Shortest record that gives the noise [s], as in the audit."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Residual of one healthy surface in one log."""

    surface: str
    servo: str
    log: str
    threshold_deg: float
    design: PulseFilter
    residual_deg: FloatArray
    """Shape (n,) [deg]; NaN where it was not judged."""

    @property
    def judged_s(self) -> float:
        """Healthy data [s]."""
        return float(np.count_nonzero(np.isfinite(self.residual_deg))) * self.design.sample_time_s


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A surface in one log that contributes nothing, and why."""

    surface: str
    log: str
    reason: str


def parts_of(audit: LogAudit) -> list[Part | LeftOut]:
    """What one audited log can say about its healthy surfaces."""
    log = audit.log.source.name
    parts: list[Part | LeftOut] = []
    for surface in audit.surfaces:
        if surface.status != "healthy" or surface.residuals is None or surface.segment is None:
            if surface.expected:
                parts.append(LeftOut(surface.surface, log, f"{surface.status}: {surface.reason}"))
            continue
        design = _design(audit.aircraft, surface.surface, surface.segment.period_s)
        residual_deg = np.where(surface.residuals.settled, surface.residuals.residual_deg, np.nan)
        parts.append(Part(surface.surface, surface.servo, log, surface.threshold_deg, design, residual_deg))
    return parts


def odds_from_logs(parts: Iterable[Part | LeftOut], wish: Wish) -> list[SurfaceOdds | LeftOut]:
    """Odds of each surface from all its healthy residuals together.

    Parameters
    ----------
    parts : iterable of Part or LeftOut
        Of all logs of one aircraft, from `parts_of`.

    Returns
    -------
    list of SurfaceOdds or LeftOut
        One for each surface, in the order in which they were met. Records whose sample rate, filter or servo differs
        from that of the first are not mixed with it.
    """
    by_surface: defaultdict[str, list[Part | LeftOut]] = defaultdict(list)
    for part in parts:
        by_surface[part.surface].append(part)
    return [_pooled(surface, members, wish) for surface, members in by_surface.items()]


def odds_from_design(
    aircraft: Aircraft, wish: Wish, *, noise_deg: float, rate_hz: float, surfaces: tuple[str, ...] = ()
) -> list[SurfaceOdds]:
    """Odds of each surface if its position carries white Gaussian noise and the model is right.

    Parameters
    ----------
    noise_deg : float
        Standard deviation of the noise of the measured deflection [deg], at most 10.
    surfaces : tuple of str
        Which; all that are measured if empty.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> plane = plain_aircraft(["elevator"], "hs225bb-eq31")
    >>> (odds,) = odds_from_design(plane, Wish(1e-6), noise_deg=0.1, rate_hz=100.0)
    >>> round(odds.gaussian_threshold_deg, 3)
    0.292
    """
    if not SLOWEST_RATE_HZ <= rate_hz <= _FASTEST_RATE_HZ:
        raise ConfigError(
            f"{rate_hz:g} Hz is no rate of positions: give {SLOWEST_RATE_HZ:g} to {_FASTEST_RATE_HZ:g} Hz"
        )
    if not 0.0 < noise_deg <= _LARGEST_NOISE_DEG:
        raise ConfigError(
            f"{noise_deg:g} deg is no noise of positions: give more than 0 and at most {_LARGEST_NOISE_DEG:g} deg"
        )
    result = []
    for name in surfaces or [name for name, surface in aircraft.surfaces.items() if surface.measured is not None]:
        design = _design(aircraft, name, 1.0 / rate_hz)
        entry = aircraft.surfaces[name]
        note = f"designed for white noise of {noise_deg:g} deg, not measured"
        noise = Noise.designed(design, noise_deg)
        result.append(surface_odds(name, entry.servo, design, noise, entry.threshold_deg, wish, notes=(note,)))
    return result


def _design(aircraft: Aircraft, surface: str, sample_time_s: float) -> PulseFilter:
    model = aircraft.model(surface)
    pole = aircraft.surfaces[surface].filter_pole_rad_s or fastest_pole_rad_s(model.transfer, sample_time_s)
    return design_pulse_filter(model.transfer, model.delay_s, sample_time_s, pole)


def _pooled(surface: str, members: list[Part | LeftOut], wish: Wish) -> SurfaceOdds | LeftOut:
    healthy = [part for part in members if isinstance(part, Part)]
    notes = [f"{part.log} left out, {part.reason}" for part in members if isinstance(part, LeftOut)]
    if not healthy:
        return LeftOut(surface, ", ".join(part.log for part in members), "; ".join(notes))
    first = healthy[0]
    used = [part for part in healthy if _alike(part, first)]
    notes += [f"{part.log} left out, its rate, filter or servo differs" for part in healthy if part not in used]
    design = first.design
    if sum(part.judged_s for part in used) < _SHORTEST_S:
        return LeftOut(surface, first.log, f"less than {_SHORTEST_S:g} s of healthy data")
    # What lies between two logs is longer than any memory of the filter.
    lags = design.impulse_response().size // 2
    pause = np.full(2 * lags, np.nan)
    record = np.concatenate([piece for part in used for piece in (part.residual_deg, pause)])
    try:
        noise = Noise.measured(record, design.sample_time_s, lags)
    except NoMeasurement as error:
        return LeftOut(surface, first.log, str(error))
    tail = None
    apart = int(np.ceil(_APART_TIME_CONSTANTS / (design.pole_rad_s * design.sample_time_s)))
    try:
        tail = fit_tail(record, design.sample_time_s, apart)
    except NoMeasurement as error:
        notes.append(str(error))
    return surface_odds(
        surface,
        first.servo,
        design,
        noise,
        first.threshold_deg,
        wish,
        tail=tail,
        hours=sum(part.judged_s for part in used) / S_PER_HOUR,
        notes=tuple(notes),
    )


def _alike(part: Part, first: Part) -> bool:
    """Whether two residuals may be taken for one."""
    ratio = part.design.sample_time_s / first.design.sample_time_s
    return (
        abs(ratio - 1.0) <= _SAME_RATE
        and part.design.pole_rad_s == first.design.pole_rad_s
        and part.servo == first.servo
    )
