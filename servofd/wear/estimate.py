"""What one flight tells of one servo: one output-error fit, and the residual of the model as it stands.

The model is the aircraft file's servo with a zone of width :math:`w` in which the surface rests: before the servo (dead
band, thesis 4.2.1) or behind it (backlash of the linkage). A single flight may not tell which; all flights of a surface
together do, so both are fitted. Taken for a dead band, a backlash seems wider by a fifth.

For a width near zero the fit must be free to go to the other side, or noise would bias it upwards: where :math:`P_w u`
is the command :math:`u` after a play of width :math:`w`, the command for :math:`-w` is :math:`2u - P_w u` (of a
backlash the same with the servo's deflection), which continues :math:`P_w u` smoothly through :math:`w = 0`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from logparsers.units import S_PER_MS
from servofd.aircraft.priors import SIGMAS
from servofd.core.errors import NoMeasurement
from servofd.core.fitting import Noise, Problem, fit
from servofd.core.statistics import MAD_TO_SIGMA, Estimate, correlation_factor, line
from servofd.detection.flights import Flight, busiest
from servofd.detection.residual import ResidualGenerator, Simulator, noise_deg, prepared
from servofd.detection.threshold import constant_threshold, interval_threshold
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import Servo
from servofd.servo.loops import play
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.series import Series
    from servofd.core.fitting import Solution
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import Residuals

_POLE_RAD_S = 30.0
"""Of a filter that only serves to find gaps and starts: gaps beyond 0.17 s, blanking of 0.27 s."""
_RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "bandwidth_hz": (0.1, 200.0),
        "damping_scale": (0.2, 5.0),
        "delay_s": (0.0, 0.5),
        "rate_limit_deg_s": (5.0, 1e4),
    }
)
"""What is fitted beside scale and offset of the position, in this order, and what no servo is beyond."""


def _x(name: str, value: float) -> float:
    """A number as it is fitted: the logarithm of what must stay positive, delays in milliseconds."""
    return value / S_PER_MS if name == "delay_s" else float(np.log(value))


def _flown(model: ServoModel, x: Mapping[str, float]) -> ServoModel:
    """A servo with other numbers of `_RANGES`, given as they are fitted."""
    values = {name: S_PER_MS * each if name == "delay_s" else float(np.exp(each)) for name, each in x.items()}
    changes = {"delay_s": values["delay_s"]}
    if "rate_limit_deg_s" in values:
        changes |= dict.fromkeys(_LIMITS, values["rate_limit_deg_s"])
    model = model.with_physics(model.physics._replace(damping_scale=values.get("damping_scale", 1.0), **changes))
    scale = 2.0 * np.pi * values["bandwidth_hz"] / model.transfer.bandwidth_rad_s
    return model.with_physics(model.physics._replace(bandwidth_scale=scale))


_LIMITS = RateLimit.parameters[0].fields
"""Sizes of a limit of the speed that is the same both ways."""


_FORGOTTEN_S = 1.0
"""Left out after a start [s], since where the servo was before is not known: the slowest ones of the library need
that long to forget it."""
_FORGOTTEN_SHARE = 0.1
"""Of a short test, which begins at rest."""
_MEMORY_S = 1.0
_NEVER = 0.999
"""Share of the speeds among which the largest is looked for: single samples are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Flights of one surface, ready to be compared with a simulation."""

    simulators: tuple[Simulator, ...]
    used: tuple[BoolArray, ...]
    """Rows of each flight with a position that a simulation can be held against."""

    @classmethod
    def of(cls, flights: Sequence[Flight], model: ServoModel) -> Motion:
        """Find the rows; they do not depend on the numbers of the servo."""
        generator = ResidualGenerator(model, _POLE_RAD_S)
        simulators = tuple(Simulator.of(generator, flight.segment) for flight in flights)
        return cls(simulators, tuple(_usable(each) for each in simulators))

    @property
    def measured_deg(self) -> FloatArray:
        """Position in all used rows [deg], shape (n,)."""
        return np.concatenate([each.segment.measured_deg[rows] for each, rows in self._pairs()])

    def with_commands(self, changed: Callable[[FloatArray], FloatArray]) -> Motion:
        """The same flights with commands [deg] that a function has changed."""
        return replace(self, simulators=tuple(r.with_commands(changed(r.segment.command_deg)) for r in self.simulators))

    def simulated_deg(self, model: ServoModel) -> FloatArray:
        """Deflection of a servo in all used rows [deg], shape (n,)."""
        return np.concatenate([each.simulated_deg(model)[rows] for each, rows in self._pairs()])

    def split(self, values: FloatArray) -> list[FloatArray]:
        """What belongs to each flight of an array of shape (n,)."""
        return np.split(values, np.cumsum([np.count_nonzero(rows) for rows in self.used])[:-1])

    def top_speed_deg_s(self, model: ServoModel) -> float:
        """Largest speed that a servo without its rate limit would have [deg/s], single samples left out."""
        unlimited = model.physics._replace(**dict.fromkeys(_LIMITS, np.inf))
        parts = self.split(self.simulated_deg(model.with_physics(unlimited)))
        speeds = [
            np.abs(np.diff(part) / np.diff(each.segment.measured_s[rows]))
            for part, (each, rows) in zip(parts, self._pairs(), strict=True)
        ]
        every = np.concatenate(speeds)
        return float(np.quantile(every, _NEVER)) if every.size else 0.0

    @property
    def period_s(self) -> float:
        """Median sample time of the first flight [s]."""
        return self.simulators[0].segment.period_s

    def correlation_factor(self, error_deg: FloatArray) -> float:
        """Long-run variance of an error over its variance, at least 1."""
        return correlation_factor(self.split(error_deg), max(1, round(_MEMORY_S / self.period_s)))

    def _pairs(self) -> Iterable[tuple[Simulator, BoolArray]]:
        """Each flight with its rows."""
        return zip(self.simulators, self.used, strict=True)


def _usable(simulator: Simulator) -> BoolArray:
    from servofd.detection.residual import RESTART_ALL

    time_s, starts = simulator.segment.measured_s, simulator.starts
    begins = np.flatnonzero(starts.restart == RESTART_ALL)
    if begins.size == 0:
        return np.zeros(time_s.size, dtype=bool)
    last = np.searchsorted(begins, np.arange(time_s.size), side="right") - 1
    since_s = time_s - time_s[begins[np.maximum(last, 0)]]
    forgotten_s = min(_FORGOTTEN_S, _FORGOTTEN_SHARE * simulator.segment.duration_s)
    usable: BoolArray = starts.settled & (last >= 0) & (since_s >= forgotten_s)
    return usable


def noise_of(measured_deg: FloatArray, error_deg: FloatArray) -> float:
    """Standard deviation of the measurement noise [deg], that of rounding included."""
    steps = np.diff(np.unique(measured_deg))
    step_deg = float(np.median(steps)) if steps.size > 1 else 0.0
    return float(max(noise_deg(error_deg), step_deg / np.sqrt(12.0)))


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
    of_axis: bool = False
    """Found by the motion of an aircraft whose servos report nothing."""


QUANTITIES: Mapping[str, Quantity] = MappingProxyType(
    {
        one.name: one
        for one in (
            Quantity("dead_band_deg", "dead band or backlash, full width", "deg", "up"),
            Quantity("bias_deg", "bias", "deg", "away"),
            Quantity("delay_s", "delay", "ms", "up", 1e3, 1),
            Quantity("bandwidth_hz", "bandwidth", "Hz", "down"),
            Quantity("rate_limit_deg_s", "rate limit", "deg/s", "down", digits=0),
            Quantity("rate_per_volt_deg_s_v", "rate limit per volt", "deg/s/V", "down", digits=1),
            Quantity("noise_deg", "noise of the position", "deg", "up", digits=3),
            Quantity("residual_p95_deg", "residual, 95th percentile", "deg", "up", digits=3),
            Quantity("margin", "threshold margin", "%", "down", 100.0, 0),
            Quantity("effect", "effect that is left", "%", "down", 100.0, 0, of_axis=True),
            Quantity("offset_us", "offset", "us", "away", digits=0, of_axis=True),
        )
    }
)
"""By name, in the order in which they are shown."""


@dataclass(frozen=True, slots=True)
class FlightEstimate:
    """One servo in one flight."""

    path: str
    run: str
    surface: str
    start_utc: datetime | None
    duration_s: float
    values: Mapping[str, Estimate]
    """Of `QUANTITIES`, with 95 % intervals; what the flight does not show is left out."""
    missing: Mapping[str, str]
    """Why, for those that are left out."""
    linkage: Mapping[str, Estimate] = field(default_factory=dict)
    """What differs if the zone of rest is not the servo's dead band but backlash of the linkage."""
    evidence: float = 0.0
    """Logarithm of how much better backlash explains the flight."""
    alarm: str = ""
    """What was found at fault in this flight; empty if nothing."""

    @property
    def name(self) -> str:
        """Path, and the run where there are several."""
        return f"{self.path} (run {self.run})" if self.run else self.path


_MOST_SAMPLES = 12_000
"""Two minutes at 100 Hz tell the width to 0.01 deg, which is less than it varies from flight to flight."""
_LEAST_SAMPLES = 300
"""Judged samples that a flight needs."""
_LEAST_MOTION_NOISES = 10.0
"""Less motion than ten times the noise tells nothing of delay and bandwidth."""
_WIDTHS_DEG = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Widths of dead band and play at which fits begin [deg]."""
_ANYTHING = (-np.inf, np.inf)
_WIDTH_STEP_DEG, _STEP = 0.02, 0.01
"""For slopes, in degrees and in the units of `_x`."""
_ORDINARY, _CLOSE = 3.0, 0.1
"""Standard deviations beyond which an error counts by its size: a glitch bends nothing; and the misfit, of which one
standard deviation of a number makes 1 or more, by which a step must improve."""
_LIMIT_REACHED = 0.5
"""Motion that would take the linear servo to half of its limit may show a limit that has fallen."""
_LEAST_RATE_SURENESS = 0.1
"""Deviation of the logarithm of a rate limit: more, and the flight hardly shows it."""
_SURE_SHARE, _BLOCKS = 0.999, 10
"""Quantile of the residual over its threshold that is the margin, and the blocks that give its uncertainty."""
_KNOWN: Mapping[str, float] = MappingProxyType(
    {"delay_s": 1e3 * SIGMAS["delay_s"], "bandwidth_hz": SIGMAS["ln_bandwidth"]}
)
"""How far any servo may differ from the usual one, in the units of `_x`: a flight that tells no more
tells nothing."""
_NOT_SHOWN = "its motion shows no more of it than is known of any servo"


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    names: tuple[str, ...]
    found: Solution
    """Of width, the numbers of the servo, gain and offset."""
    deviation: FloatArray
    correlation_factor: float
    """Samples that tell as much as one."""


class ServoEstimate(NamedTuple):
    """What a flight tells of a servo, with 95 % intervals."""

    values: dict[str, Estimate]
    """Of `servofd.wear.estimate.QUANTITIES`, if the zone of rest is a dead band."""
    missing: dict[str, str]
    """Why others are not among them."""
    linkage: dict[str, Estimate]
    """What differs if it is backlash of the linkage."""
    evidence: float
    """Logarithm of how much better backlash explains the flight."""


def estimate_flight(
    segment: Series, aircraft: Aircraft, voltage_v: float | None = None, *, unfit: str = ""
) -> ServoEstimate:
    """Estimate what `servofd.wear.estimate.QUANTITIES` lists, as far as the flight shows it.

    Where the surface did not follow its servo (`unfit` says why), only the residual is measured.
    """
    surface = aircraft.surfaces[segment.surface]
    generator = ResidualGenerator.fitting(aircraft.model(segment.surface), segment, surface.filter_pole_rad_s)
    segment, residuals, _ = prepared(generator, segment)
    if np.count_nonzero(residuals.settled) < _LEAST_SAMPLES:
        raise NoMeasurement(
            f"only {np.count_nonzero(residuals.settled)} samples that can be judged; too short a flight"
        )
    threshold = interval_threshold(generator, segment, residuals, surface.tolerances, surface.threshold_sigmas)
    if surface.threshold == "constant":
        threshold = constant_threshold(threshold, surface.threshold_deg)
    values = _of_residual(residuals, threshold.level_deg)
    servo, model = aircraft.servo(segment.surface), generator.model
    motion = Motion.of(busiest(Flight("", segment), _MOST_SAMPLES), model)
    problem = unfit or _too_calm(motion)
    if problem:
        of_servo = (name for name, what in QUANTITIES.items() if not what.of_axis)
        return ServoEstimate(values, {name: problem for name in of_servo if name not in values}, {}, 0.0)
    dead_band = _fitted(motion, servo, model)
    sigma_deg = float(dead_band.found.problem.noise.sigma)
    backlash = _descended(motion, model, dead_band.names, dead_band.found.x, sigma_deg, behind=True)
    values |= _of_fit(dead_band, motion, voltage_v)
    missing = {name: _NOT_SHOWN for name in _KNOWN if name not in values}
    if "rate_limit_deg_s" not in values:
        missing["rate_limit_deg_s"] = "never moved fast enough to show it"
    if "rate_per_volt_deg_s_v" not in values:
        missing["rate_per_volt_deg_s_v"] = missing.get("rate_limit_deg_s", "no supply voltage in the log")
    return ServoEstimate(values, missing, _of_fit(backlash, motion, voltage_v), _evidence(dead_band, backlash))


def _evidence(dead_band: _Fit, backlash: _Fit) -> float:
    """Logarithm of the odds for backlash, with the correlation of the errors taken into account."""
    return 0.5 * (dead_band.found.misfit - backlash.found.misfit) / backlash.correlation_factor


def _of_residual(residuals: Residuals, level_deg: FloatArray) -> dict[str, Estimate]:
    """Size of the residual, and how much of the threshold is left."""
    judged = residuals.settled & np.isfinite(residuals.residual_deg)
    size_deg = np.abs(residuals.residual_deg[judged])
    value, low, high = _quantile(size_deg / level_deg[judged], _SURE_SHARE)
    return {"residual_p95_deg": _quantile(size_deg, 0.95), "margin": Estimate(1.0 - value, 1.0 - high, 1.0 - low)}


def _quantile(values: FloatArray, share: float) -> Estimate:
    """Quantile; its deviation comes from those of ten parts of the flight."""
    parts = [float(np.quantile(part, share)) for part in np.array_split(values, _BLOCKS)]
    return Estimate.of(float(np.quantile(values, share)), float(np.std(parts, ddof=1)) / np.sqrt(_BLOCKS))


def _too_calm(motion: Motion) -> str:
    """Why this flight tells nothing of the servo's dynamics, or nothing."""
    measured_deg = motion.measured_deg
    if measured_deg.size < _LEAST_SAMPLES:
        return "too few samples with command and position"
    low_deg, high_deg = np.percentile(measured_deg, [5.0, 95.0])
    if high_deg - low_deg < _LEAST_MOTION_NOISES * noise_deg(measured_deg):
        return "too little motion"
    return ""


def _fitted(motion: Motion, servo: Servo, model: ServoModel) -> _Fit:
    """Downhill from the width that fits best with the servo as it is known."""
    known = {"bandwidth_hz": model.transfer.bandwidth_rad_s / (2.0 * np.pi), "delay_s": model.delay_s}
    if servo.damping is not None:
        known["damping_scale"] = 1.0
    limit_deg_s = servo.rate_limit_deg_s
    if limit_deg_s is not None and motion.top_speed_deg_s(model) > _LIMIT_REACHED * limit_deg_s:
        known["rate_limit_deg_s"] = limit_deg_s
    names = tuple(name for name in _RANGES if name in known)
    measured_deg = motion.measured_deg
    starts = []
    for width_deg in _WIDTHS_DEG:
        simulated_deg = _simulated(motion, model, width_deg, behind=False)
        gain, offset_deg = line(simulated_deg, measured_deg)
        left_deg = float(np.median(np.abs(measured_deg - gain * simulated_deg - offset_deg)))
        starts.append((left_deg, width_deg, gain, offset_deg))
    left_deg, width_deg, gain, offset_deg = min(starts)
    begin = np.array([width_deg, *(_x(name, known[name]) for name in names), gain, offset_deg])
    return _descended(motion, model, names, begin, MAD_TO_SIGMA * max(left_deg, 1e-6), behind=False)


def _descended(
    motion: Motion, model: ServoModel, names: tuple[str, ...], begin: FloatArray, sigma_deg: float, *, behind: bool
) -> _Fit:
    """Least squares from one starting point, of the zone of rest before or behind the servo."""
    measured_deg = motion.measured_deg

    def error(x: FloatArray) -> FloatArray:
        flown = _flown(model, dict(zip(names, x[1:-2].tolist(), strict=True)))
        simulated_deg = _simulated(motion, flown, float(x[0]), behind=behind)
        left_deg: FloatArray = measured_deg - x[-2] * simulated_deg - x[-1]
        return left_deg

    inside = [tuple(_x(name, end) for end in _RANGES[name]) for name in names]
    low, high = np.array([_ANYTHING, *inside, _ANYTHING, _ANYTHING]).T
    steps = np.array([_WIDTH_STEP_DEG, *(_STEP for _ in names), _STEP, _STEP])
    noise = Noise(huber=_ORDINARY, sigma=sigma_deg)
    found = fit(Problem.free(error, (low, high), noise, steps), begin, close=_CLOSE)
    remembered = motion.correlation_factor(found.error)
    deviation = np.sqrt(np.diag(found.covariance(remembered)))
    return _Fit(names, found, deviation, remembered)


def _simulated(motion: Motion, servo: ServoModel, width_deg: float, *, behind: bool) -> FloatArray:
    """Deflection of a servo with a zone of rest, in all used rows [deg], shape (n,)."""
    if behind:
        return np.concatenate([_rested(part, width_deg) for part in motion.split(motion.simulated_deg(servo))])
    return motion.with_commands(lambda command_deg: _rested(command_deg, width_deg)).simulated_deg(servo)


def _rested(values_deg: FloatArray, width_deg: float) -> FloatArray:
    """What is left of a motion behind a play, of a width that may be negative."""
    if values_deg.size == 0:
        return values_deg
    followed_deg = play(values_deg, abs(width_deg), float(values_deg[0]))
    return followed_deg if width_deg >= 0.0 else 2.0 * values_deg - followed_deg


def _of_fit(fitted: _Fit, motion: Motion, voltage_v: float | None) -> dict[str, Estimate]:
    """What was fitted, in the units of `QUANTITIES`."""
    width, *numbers, _, offset = (Estimate.of(*pair) for pair in zip(fitted.found.x, fitted.deviation, strict=True))
    noise = noise_of(motion.measured_deg, fitted.found.error)
    values = {
        "dead_band_deg": width,
        "bias_deg": offset,
        "noise_deg": Estimate.of(noise, noise / np.sqrt(fitted.found.error.size)),
    }
    for name, estimate in zip(fitted.names, numbers, strict=True):
        if estimate.deviation > _KNOWN.get(name, np.inf):
            continue
        if name == "delay_s":
            values[name] = Estimate(*(S_PER_MS * end for end in estimate))
        elif name == "bandwidth_hz" or (name == "rate_limit_deg_s" and estimate.deviation < _LEAST_RATE_SURENESS):
            values[name] = Estimate(*np.exp(np.clip(estimate, -50.0, 50.0)).tolist())
    if voltage_v is not None and "rate_limit_deg_s" in values:
        values["rate_per_volt_deg_s_v"] = Estimate(*(end / voltage_v for end in values["rate_limit_deg_s"]))
    return values
