"""What one flight tells of one servo: its healthy servo fitted to it, and how large the residual is.

The healthy servo is that of the audit, calibrated or named, and so is the prior: how far it may be from what the
aircraft file says is what good servos differ by. So no interval is wider than what was known before the flight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from servofd.aircraft.priors import NAMES, PRIORS
from servofd.aircraft.series import Series
from servofd.core.errors import NoMeasurement
from servofd.core.fitting import Noise, Problem, fit
from servofd.core.statistics import Estimate, correlation_factor
from servofd.core.types import FloatArray
from servofd.detection.moving import Watched
from servofd.detection.residual import noise_deg
from servofd.detection.seen import Healthy, Seen
from servofd.estimate.fit import WIDTHS, bandwidth, reading, residual
from servofd.estimate.record import usual_supply_v

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft


@dataclass(frozen=True, slots=True)
class Quantity:
    """One number of a servo."""

    name: str
    """With its unit as the last word."""
    title: str
    unit: str
    worse: Literal["up", "down", "away"]
    """Which way wear goes; ``away`` from zero to either side."""
    scale: float = 1.0
    """From the number to what is shown in `unit`."""
    digits: int = 2
    of: Literal["position", "current", "motion"] = "position"
    """What tells it; the motion of an aircraft whose servos report nothing is that of an axis."""


QUANTITIES: Mapping[str, Quantity] = MappingProxyType(
    {
        one.name: one
        for one in (
            Quantity("dead_band_deg", "dead band, friction and play together, full width", "deg", "up"),
            Quantity("play_deg", "play", "deg", "up"),
            Quantity("friction_deg", "friction", "deg", "up"),
            Quantity("bias_deg", "bias", "deg", "away"),
            Quantity("gain", "gain beside that of the aircraft file", "%", "down", 100.0, 1),
            Quantity("delay_s", "delay", "ms", "up", 1e3, 1),
            Quantity("bandwidth_hz", "bandwidth", "Hz", "down"),
            Quantity("rate_limit_deg_s", "rate limit", "deg/s", "down", digits=0),
            Quantity("rate_per_volt_deg_s_v", "rate limit per volt", "deg/s/V", "down", digits=1),
            Quantity("noise_deg", "noise of the position", "deg", "up", digits=3),
            Quantity("residual_p95_deg", "residual, 95th percentile", "deg", "up", digits=3),
            Quantity("margin", "threshold margin", "%", "down", 100.0, 0),
            Quantity("effect", "effect that is left", "%", "down", 100.0, 0, of="motion"),
            Quantity("offset_us", "offset", "us", "away", digits=0, of="motion"),
            Quantity(
                "current_ratio", "current of motion beside that of good flights", "%", "up", 100.0, 0, of="current"
            ),
            Quantity("current_spread_a", "spread of the current in motion", "A", "up", digits=3, of="current"),
            Quantity("idle_current_a", "current at rest", "A", "up", digits=3, of="current"),
        )
    }
)
"""By name, in the order in which they are shown."""


_MOST_SAMPLES = 12_000
"""Four minutes at 50 Hz tell the width to 0.01 deg, which is less than it varies from flight to flight."""
_ORDINARY, _CLOSE = 3.0, 0.1
"""Standard deviations beyond which an error counts by its size: a glitch bends nothing; and the misfit, of which one
standard deviation of a number makes 1 or more, by which a step must improve."""
_MEMORY_S, _PARTS, _LASTING, _LEAST = 1.0, 8, 3.4, 2.0
"""Time over which errors are correlated [s], parts of the flight whose disagreement shows the model's own error, and by
how much it is enlarged for what they have in common, and where noise may be all that it is: chosen on even seeds of
`benchmarks/intervals.py calibrate`."""
_SHOWN = 0.9
"""Share of what was known before, below which the interval of a number must be: else the flight tells nothing of it."""
_LEAST_SAMPLES = 300
"""Judged samples that a flight needs."""
_SURE_SHARE, _BLOCKS = 0.999, 10
"""Quantile of the residual over its threshold that is the margin, and the blocks that give its uncertainty."""
_NOT_SHOWN = "its motion shows no more of it than is known of any servo"
_RESTING = {"deadband_deg": "deadband_deg", "play_deg": "backlash_deg", "friction_deg": "friction_deg"}
"""The same of a model."""


class ServoEstimate(NamedTuple):
    """What a flight tells of a servo, or of an axis."""

    values: Mapping[str, Estimate]
    """Of `QUANTITIES`, with 95 % intervals; what the flight does not show is left out."""
    missing: Mapping[str, str]
    """Why, for those that are left out."""
    alarm: str = ""
    """What was found at fault in this flight; empty if nothing."""


def estimate_flight(segment: Series, aircraft: Aircraft, *, unfit: str = "") -> ServoEstimate:
    """Estimate what `QUANTITIES` lists, as far as the flight shows it.

    Where the surface did not follow its servo (`unfit` says why), only the residual is measured.

    Raises `NoMeasurement` if hardly anything of the flight can be judged.
    """
    surface = aircraft.surfaces[segment.surface]
    model = aircraft.model(segment.surface)
    seen = Healthy(surface, model).beside(segment)
    count = np.count_nonzero(seen.flight.judged)
    if count < _LEAST_SAMPLES:
        raise NoMeasurement(f"only {count} samples that can be judged; too short a flight")
    values = _of_residual(seen)
    of_servo = [name for name, what in QUANTITIES.items() if what.of == "position" and name not in values]
    if unfit:
        return ServoEstimate(values, dict.fromkeys(of_servo, unfit))
    found = _Servo.of(seen.flight)
    # A named servo rests as its own model does, and not as the one of the family that is most like it.
    usual: dict[str, float] = {}
    if seen.flight.own is not None:
        usual = {name: float(getattr(model.physics, field)) for name, field in _RESTING.items()}
    width_deg = sum(WIDTHS[name] * size for name, size in usual.items()) if usual else None
    own = {
        "dead_band_deg": found.shown(WIDTHS, width_deg),
        "play_deg": found.shown({"play_deg": 1.0}, usual.get("play_deg")),
        "friction_deg": found.shown({"friction_deg": 1.0}, usual.get("friction_deg")),
        "bias_deg": found.shown({"bias_deg": 1.0}),
        "gain": found.shown({"gain": 1.0}, 1.0),
        "delay_s": found.shown({"delay_s": 1.0}, model.delay_s),
        "bandwidth_hz": found.shown(bandwidth(found.known)[1], np.log(model.transfer.bandwidth_rad_s / (2.0 * np.pi))),
        "rate_limit_deg_s": found.shown({"ln_rate": 1.0}),
    }
    for name, estimate in own.items():
        if estimate is not None:
            is_log = name in ("bandwidth_hz", "rate_limit_deg_s")
            values[name] = Estimate(*np.exp(estimate).tolist()) if is_log else estimate
    supply_v = usual_supply_v(segment.context)
    if supply_v and "rate_limit_deg_s" in values:
        values["rate_per_volt_deg_s_v"] = Estimate(*(end / supply_v for end in values["rate_limit_deg_s"]))
    values["noise_deg"] = found.noise_deg
    return ServoEstimate(values, {name: _NOT_SHOWN for name in of_servo if name not in values})


def _of_residual(seen: Seen) -> dict[str, Estimate]:
    """Size of the residual, and how much of the threshold is left."""
    residuals = seen.residuals
    judged = residuals.settled & np.isfinite(residuals.residual_deg)
    size_deg = np.abs(residuals.residual_deg[judged])
    value, low, high = _quantile(size_deg / seen.threshold.level_deg[judged], _SURE_SHARE)
    return {"residual_p95_deg": _quantile(size_deg, 0.95), "margin": Estimate(1.0 - value, 1.0 - high, 1.0 - low)}


def _quantile(values: FloatArray, share: float) -> Estimate:
    """Quantile; its deviation comes from those of ten parts of the flight."""
    parts = [float(np.quantile(part, share)) for part in np.array_split(values, _BLOCKS)]
    return Estimate.of(float(np.quantile(values, share)), float(np.std(parts, ddof=1)) / np.sqrt(_BLOCKS))


@dataclass(frozen=True, slots=True, eq=False)
class _Servo:
    """The healthy servo fitted to a flight."""

    known: FloatArray
    """Parameters as the aircraft file has them, shape (13,) as all."""
    x: FloatArray
    before: FloatArray
    """Standard deviations of what is known without the flight."""
    covariance: FloatArray
    """With it, shape (parameters, parameters)."""
    noise_deg: Estimate

    @classmethod
    def of(cls, flight: Watched) -> _Servo:
        """Fit it."""
        known, rows = flight.known, _rows(flight)
        record = flight.record
        used = np.flatnonzero(flight.judged[rows])
        measured_deg = record.measured_deg[rows]
        before = np.sqrt(np.diag(known.covariance))

        def error_deg(x: FloatArray) -> FloatArray:
            return residual(measured_deg, _moved_deg(flight, x, rows), known.reach_deg)[0][used]

        low, high = (np.array([getattr(prior, end) for prior in PRIORS]) for end in ("low", "high"))
        white = Noise(huber=_ORDINARY, sigma=flight.noise_deg[rows][used])
        steps = np.array([prior.step for prior in PRIORS])
        problem = Problem(low, high, error_deg, white, 1.0 / before, known.theta, steps)
        found = fit(problem, known.theta, close=_CLOSE)
        # Samples count as few as what was left of them is correlated.
        kappa = correlation_factor([found.error], max(1, round(_MEMORY_S / record.period_s)))
        found = fit(replace(problem, noise=replace(white, kappa=np.array([kappa]))), found.x, close=_CLOSE)
        covariance = found.covariance(count=_PARTS, lasting=_LASTING, least=_LEAST)
        # The disagreement of parts makes no number less known than before, and what changes nothing is no number.
        share = np.minimum(1.0, before / np.sqrt(np.diag(covariance))) * found.slopes.any(axis=0)
        noise = noise_deg(found.error)
        return cls(
            known.theta, found.x, before * (share > 0.0), covariance * np.outer(share, share),
            Estimate.of(noise, noise / np.sqrt(used.size)),
        )  # fmt: skip

    def shown(self, slopes: Mapping[str, float], usual: float | None = None) -> Estimate | None:
        """A sum of parameters, in place of the usual one; None if the flight tells no more than was known before."""
        slope = np.array([slopes.get(name, 0.0) for name in NAMES])
        deviation = float(np.sqrt(slope @ self.covariance @ slope))
        if not deviation < _SHOWN * float(np.linalg.norm(slope * self.before)):
            return None
        start = float(slope @ self.known) if usual is None else usual
        return Estimate.of(start + float(slope @ (self.x - self.known)), deviation)


def _rows(flight: Watched) -> slice:
    """The stretch of a flight in which its servo would have moved most, of as many samples as are fitted."""
    moved_deg = np.cumsum(np.abs(np.diff(flight.reading_deg, prepend=flight.reading_deg[:1])))
    length = min(_MOST_SAMPLES, moved_deg.size)
    first = int(np.argmax(moved_deg[length - 1 :] - moved_deg[: moved_deg.size - length + 1]))
    return slice(first, first + length)


def _moved_deg(flight: Watched, theta: FloatArray, rows: slice) -> FloatArray:
    """Reading of the healthy servo with other parameters at some samples [deg]."""
    record = flight.record
    if flight.own is not None:
        return flight.own(record, theta, rows, float(record.measured_deg[rows][0]))
    part = replace(
        record, time_s=record.time_s[rows], load=record.load[rows], power=record.power[rows],
        start_deg=np.append(record.measured_deg[rows][:1], record.start_deg[rows][1:]),
    )  # fmt: skip
    return reading(theta, part, flight.known.reach_deg)[0]
