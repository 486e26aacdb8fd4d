"""One aircraft over many flights."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.batch.cluster import run_on_cluster
from servofd.batch.find import find_logs
from servofd.batch.local import run_local
from servofd.core.errors import NoMeasurement
from servofd.feedback.flown import layout_of
from servofd.wear.follow import SurfaceTrend, Wear, follow
from servofd.wear.logs import FlownLog, Order, check_one_aircraft, estimate_log, in_order

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from servofd.batch.find import Skipped


@dataclass(frozen=True, slots=True, eq=False)
class AircraftTrend:
    """All surfaces of one aircraft over its flights."""

    aircraft: str
    order: Order
    surfaces: tuple[SurfaceTrend, ...]
    problems: tuple[str, ...]
    """What could not be used, and why, a line each."""
    not_judged: tuple[str, ...]
    """Logs that tell nothing at all."""
    skipped: tuple[Skipped, ...] = ()
    """Files that are no logs."""

    @property
    def has_alarm(self) -> bool:
        """Whether anything is beyond its limit, or will be."""
        return any(surface.alarms for surface in self.surfaces)


def _no_progress(_count: int) -> AbstractContextManager[Callable[[], None]]:
    return nullcontext(lambda: None)


def trend_logs(
    paths: Sequence[str | Path],
    aircraft: Aircraft | str | Path,
    *,
    surfaces: tuple[str, ...] = (),
    cluster: str | None = None,
    workers: int | None = None,
    progress: Callable[[int], AbstractContextManager[Callable[[], None]]] = _no_progress,
) -> AircraftTrend:
    """Follow the servos of one aircraft over many flights.

    Parameters
    ----------
    paths : sequence of str or Path
        Logs, folders, patterns or addresses.
    aircraft : Aircraft, str or Path
        The aircraft or its file, with serial numbers, swaps and limits where there are any.
    surfaces : tuple of str
        Which to follow; all if empty.
    cluster : str, optional
        Scheduler of a Dask cluster; the processes of this machine if None.
    workers : int, optional
        Number of processes; one per core if None, 0: this one.
    progress : callable
        Called with the number of logs; gives a context with the function to call after each of them.

    Examples
    --------
    >>> seen = trend_logs(["sample_logs/faser_healthy_flight.mat"], "faser", surfaces=("rudder",), workers=0)
    >>> seen.has_alarm
    False
    """
    known = aircraft if isinstance(aircraft, Aircraft) else load_aircraft(aircraft)
    known.check_names(surfaces)
    there = find_logs([str(path) for path in paths], layout_of(known))
    task = partial(estimate_log, aircraft=known, surfaces=surfaces)
    logs: list[FlownLog] = []
    problems = list(there.problems)
    outcomes = run_on_cluster(cluster, task, there.logs) if cluster else run_local(task, there.logs, workers)
    with progress(len(there.logs)) as step:
        for source, outcome in outcomes:
            if isinstance(outcome, Exception):
                problems.append(f"{source.path}: {outcome}")
            else:
                logs += outcome
            step()
    return trend_of(logs, known, problems=problems, skipped=there.skipped)


def trend_of(
    logs: Sequence[FlownLog],
    aircraft: Aircraft,
    *,
    problems: Sequence[str] = (),
    skipped: tuple[Skipped, ...] = (),
) -> AircraftTrend:
    """Follow the servos of one aircraft over flights that are estimated already."""
    check_one_aircraft(logs)
    judged = [log for log in logs if log.flights]
    reasons = [*problems, *(f"{log.path}: {problem}" for log in logs for problem in log.problems)]
    if not judged:
        raise NoMeasurement(f"no flight tells anything of a servo: {reasons[0]}" if reasons else "no flight")
    order = in_order(judged)
    numbered = list(enumerate(order.logs, start=1))
    surfaces = []
    for name in aircraft.surfaces:
        flights = [(number, flight) for number, log in numbered for flight in log.flights if flight.surface == name]
        if flights:
            surfaces.append(follow(name, flights, _wear(aircraft, name)))
    for name in aircraft.motion.axes if aircraft.motion is not None else ():
        flights = [(number, flight) for number, log in numbered for flight in log.flights if flight.surface == name]
        if flights:
            surfaces.append(follow(name, flights, Wear(AXIS_LIMITS, {})))
    not_judged = (*problems, *(log.path for log in logs if not log.flights))
    return AircraftTrend(aircraft.name, order, tuple(surfaces), tuple(reasons), not_judged, skipped)


def _wear(aircraft: Aircraft, name: str) -> Wear:
    entry = aircraft.surfaces[name]
    swaps = tuple((swap.date, swap.removed) for swap in entry.swaps)
    return Wear(limits_of(aircraft, name), telling_steps(aircraft, name), entry.serial, swaps)


_TOLERANCES = 3.0
_DELAYS = 5.0
"""A frame of a 50 Hz autopilot is 20 ms, seven times the usual tolerance of 3 ms."""
_TELLING = 0.5
"""A servo that changed by less than half of what a healthy one may differ by has not changed."""
_TELLING_WIDTH_DEG = 0.1
AXIS_LIMITS = {"effect": 0.75, "offset_us": 60.0}
"""Of an axis: a quarter of its effect is gone, or an eighth of the usual travel goes into its trim."""


def limits_of(aircraft: Aircraft, surface: str) -> dict[str, float]:
    """Limit of each quantity of `servofd.wear.records.QUANTITIES` that has one.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> limits = limits_of(plain_aircraft(["rudder"], "hs225bb-eq31"), "rudder")
    >>> limits["dead_band_deg"], round(limits["delay_s"], 4), round(limits["bandwidth_hz"], 2)
    (2.0, 0.019, 3.17)
    """
    entry, servo = aircraft.surfaces[surface], aircraft.servo(surface)
    tolerance, given = entry.tolerances, entry.limits.model_dump(exclude_none=True)
    derived = {
        "bias_deg": entry.threshold_deg,
        "delay_s": servo.transport_delay_s + _DELAYS * tolerance.delay_s,
        "bandwidth_hz": servo.transfer.bandwidth_rad_s / (2.0 * np.pi) * (1.0 - _TOLERANCES * tolerance.bandwidth),
        "noise_deg": _TOLERANCES * tolerance.noise_deg,
        "residual_p95_deg": entry.threshold_deg,
    }
    if servo.rate_limit_deg_s is not None:
        derived["rate_limit_deg_s"] = servo.rate_limit_deg_s * (1.0 - _TOLERANCES * tolerance.rate)
    return {name: float(value) for name, value in (derived | given).items() if value > 0.0 or name == "margin"}


def telling_steps(aircraft: Aircraft, surface: str) -> dict[str, float]:
    """Smallest sudden change that is reported, of each quantity."""
    entry, servo = aircraft.surfaces[surface], aircraft.servo(surface)
    tolerance = entry.tolerances
    rate_deg_s = servo.rate_limit_deg_s or np.inf
    return {
        "dead_band_deg": _TELLING_WIDTH_DEG,
        "bias_deg": _TELLING * tolerance.bias_deg,
        "delay_s": _TELLING * tolerance.delay_s,
        "bandwidth_hz": _TELLING * tolerance.bandwidth * servo.transfer.bandwidth_rad_s / (2.0 * np.pi),
        "rate_limit_deg_s": _TELLING * tolerance.rate * rate_deg_s,
        "noise_deg": _TELLING * tolerance.noise_deg,
    }
