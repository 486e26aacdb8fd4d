"""What a calibration knows of one servo: how far it may differ between good flights, and where each test alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.calibrated import CalibratedNoise, CalibratedServo, lower_triangle
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.detection.changes import STATISTICS
from servofd.detection.watch import FLOORS, MARGIN, statistics_of, watched
from servofd.estimate.fit import FAMILY, residual

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import FloatArray
    from servofd.estimate.fit import Fit
    from servofd.estimate.record import Record

_OWN_MARGIN: Final = 1.3
_ENOUGH_S: Final = 120.0
"""Flights of less in all leave more unknown: of six aircraft of even seed that were calibrated on 15, 30, 60 and 120 s,
good flights reached 3.6, 1.2, 1.2 and 1.04 times the thresholds. They widen with the third root of what is missing."""
_UNCERTAINTIES: Final = 4.0
_KNOWN_FLIGHTS: Final = 4.0
"""A stated prior counts as so many differences between flights."""
_LEAST_SHARE: Final = 0.25
_WARMTH: Final = 0.2
"""Share by which grease on a cold day and wear change friction and play."""
_PUSHED: Final = {"gain": 0.031, "bias_deg": 0.059}
"""What the usual air does to a servo (rms of 20 aircraft of even seed, calibrated with airspeed); where nobody knows
the airspeed, a share of it is part of what differs between flights."""
_NEVER_LOGGED: Final = 0.3
"""0.3 and 0.6 leave 2 of 240 good flights of even seed at fault, 0 leaves 6; 0.6 hides twice as large losses."""
SPOKEN: Final = dict(
    zip(
        NAMES,
        ("the scale", "the offset", "the delay", "the bandwidth", "the damping", "the largest speed", "the dead band",
         "the friction", "the play", "the load of the air", "the load of the air", "the bend of the reading",
         "the bend of the reading"),
        strict=True,
    )
)  # fmt: skip


def known_servo(
    fitted: Fit,
    records: Sequence[Record],
    supply_v: float,
    airspeed_m_s: float,
    *,
    fastest_m_s: float = 0.0,
    pushed: float = _NEVER_LOGGED,
) -> CalibratedServo:
    """What goes into the file, with the usual thresholds.

    Parameters
    ----------
    supply_v, airspeed_m_s : float
        Usual ones; 0 where nobody logged them.
    fastest_m_s : float
        Largest airspeed; 0 where nobody logged it.
    pushed : float
        Share of what the usual air does that differs between flights, where nobody logged the airspeed.
    """
    spread = np.array([prior.between for prior in PRIORS]) ** 2
    if not airspeed_m_s:
        for key, amount in _PUSHED.items():
            spread[NAMES.index(key)] += (pushed * amount) ** 2
    resting = [NAMES.index(name) for name in ("deadband_deg", "friction_deg", "play_deg")]
    spread[resting] += (_WARMTH * fitted.theta[resting]) ** 2
    if len(records) > 1:
        changes = changes_of(fitted, records)
        spread = (_KNOWN_FLIGHTS * spread + (changes**2).sum(axis=0)) / (_KNOWN_FLIGHTS + len(records) - 1.0)
        spread = np.maximum(spread, _LEAST_SHARE * np.array([prior.between for prior in PRIORS]) ** 2)
    between = np.diag(spread) + _UNCERTAINTIES * fitted.covariance
    noise = fitted.noise
    return CalibratedServo(
        parameters={key: float(f"{value:.6g}") for key, value in zip(NAMES, fitted.theta.tolist(), strict=True)},
        between=lower_triangle(between),
        noise=CalibratedNoise(
            still_deg=float(f"{noise.still_deg:.4g}"),
            lag_s=float(f"{noise.lag_s:.4g}"),
            colour=(round(noise.colour[0], 4), round(noise.colour[1], 4)),
            innovation=float(f"{noise.innovation:.4g}"),
            period_s=float(f"{noise.period_s:.6g}"),
        ),
        reach_deg=(round(fitted.reach_deg[0], 3), round(fitted.reach_deg[1], 3)),
        supply_v=round(supply_v, 3),
        airspeed_m_s=round(airspeed_m_s, 2),
        fastest_m_s=round(fastest_m_s, 2),
        flights=len(records),
    )


def foreseen(known: CalibratedServo, fitted: Fit) -> CalibratedServo:
    """The same after three more flights for each, if good flights differ by as little as they may."""
    vague = _UNCERTAINTIES * fitted.covariance
    between = known.covariance - 0.75 * vague
    if known.flights == 1:
        between -= (3.0 / (_KNOWN_FLIGHTS + 3.0)) * (known.covariance - vague)
    return known.model_copy(update={"between": lower_triangle(between)})


def changes_of(fitted: Fit, records: Sequence[Record]) -> FloatArray:
    """How each flight alone would change the parameters, as far as it tells; shape (flights, 13)."""
    between = np.array([prior.between for prior in PRIORS])
    out = []
    for record in records:
        reading_deg, slopes, speed = FAMILY.predicted(fitted.theta, record, fitted.reach_deg)
        error_deg, inside = residual(record.measured_deg, reading_deg, fitted.reach_deg)
        rows = record.usable & inside
        sigma = fitted.noise.sigma_deg(speed[rows])
        weight = np.minimum(1.0, 2.5 / np.maximum(np.abs(error_deg[rows]) / sigma, 1e-9)) / sigma**2 / 4.0
        block = (slopes[rows] * weight[:, None]).T @ slopes[rows] + np.diag((2.0 * between) ** -2.0)
        out.append(np.linalg.solve(block, slopes[rows].T @ (weight * error_deg[rows])))
    return np.array(out)


def thresholds_above(known: CalibratedServo, fitted: Fit, records: Sequence[Record]) -> dict[str, float]:
    """Thresholds that the flights stay below where they were left out of the fit; wider ones after short flights."""
    seconds = sum(float(np.count_nonzero(record.usable)) * record.period_s for record in records)
    margin = MARGIN * float(np.cbrt(max(_ENOUGH_S / seconds, 1.0)))
    largest = np.zeros(len(STATISTICS))
    for record, left_deg in zip(records, fitted.held_out_deg, strict=True):
        statistics = statistics_of(watched(known, record), left_deg)
        if statistics.size:
            largest = np.maximum(largest, statistics)
    return {
        key: float(f"{max(FLOORS[key], _OWN_MARGIN * value) * margin:.3g}")
        for key, value in zip(STATISTICS, largest.tolist(), strict=True)
    }
