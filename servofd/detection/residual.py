r"""Residuals of real logs: ``r = Qy (y - ŷ)`` on true time stamps.

With ŷ from the full servo model this is, on uniform samples and for a linear servo, the same residual as that
of the plant-first nullspace filter (`servofd.detection.pulse`); but it stays zero for a servo that runs into
its rate limit, and it needs no resampling.

``Qy`` is :math:`g\,a(z)/M_d(z)`. Written in the lag :math:`L = (1-q)/(1 - q z^{-1})`, :math:`q = e^{-|p|\Delta t}`,
it becomes a weighted sum of :math:`L \dots L^{n+1}` whose weights are closed-form functions of the step
:math:`\Delta t`: this form carries over to irregular steps, has the right dc gain on every one of them, and has
no step length at which it fails.

Before a log is judged, commands that were thinned out are taken as straight lines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.records import own
from servofd.aircraft.series import pace_steps
from servofd.core.errors import DesignError
from servofd.core.series import latest, subdivided
from servofd.core.types import BoolArray, ComplexArray, FloatArray
from servofd.detection.pulse import fastest_pole_rad_s
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.loops import compiled, fixed, inner

if TYPE_CHECKING:
    from servofd.aircraft.series import Series
    from servofd.core.types import IntArray
    from servofd.servo.motion import AnyServo, Motion
    from servofd.servo.servo_model import ServoModel

_GAP_TIME_CONSTANTS = 5.0
"""The filter bridges gaps of so many of its time constants, or"""
_GAP_PERIODS = 3.0
"""of so many sample periods if that is longer."""
_BLANKING_TIME_CONSTANTS = 8.0
"""Time constants after a start during which the residual is not judged."""
_LARGEST_GAIN_ERROR = 1e-6
"""Relative error of the filter's dc gain above which too many digits are lost."""
_LOST_SAMPLE = (1.5, 1.75)
"""An interval at least this many times the median holds a lost sample: the more, the more the time stamps jitter."""
_LOW_QUANTILE_OF_THINNED = 10.0
"""Where one message in four arrives, as many intervals in four are whole."""
_LOW_QUANTILE, _TRIANGLE = 5.0, 1.0 - 0.1**0.5
"""Two uniform jitters make a triangular one; its lower 5 % lie beyond this share of its half width."""
_FEW_INTERVALS = 1.25
"""A quantile of a hundred intervals scatters by a tenth."""
_INTERVALS_FOR_PERIOD = 10_000
"""Intervals between commands from which the period is found at most."""
_FEWEST_COMMANDS = 3
"""Commands that have a period."""
_MOST_KEPT = 60.0
"""A log that has lost three commands in ten has the right interval in seven of ten, give or take a few."""
_REGULAR_SPREAD, _UNEVEN_SPREAD, _AT_ONCE = 0.35, 0.45, 0.4
"""From the lower quarter of all intervals to that quantile within this share of the median: a regular log. In a hundred
intervals of 10 ms it is 0.18 to 0.43 if stamps are off by up to 3 ms and a fifth is lost (400 draws), but then hardly
one is shorter than the last share of the median, as some are where commands come as they please."""

_SAME_STEP_S = 1e-7
"""Steps this close share their weights: a filter changes by less than 1e-5 of its input."""


@dataclass(frozen=True, slots=True, eq=False)
class Commands:
    """Commands as they reach the servo: at each instant a value, from which the command runs on at a slope."""

    effective_s: FloatArray
    command_deg: FloatArray
    slope_deg_s: FloatArray

    def at(self, time_s: FloatArray) -> FloatArray:
        """The last command that had reached the servo at some instants [deg]."""
        return latest(self.effective_s, self.command_deg, time_s)


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Residual of one surface; all arrays of shape (n,), one entry per measurement time."""

    time_s: FloatArray
    simulated_deg: FloatArray
    """Deflection of a healthy servo [deg]."""
    measured_deg: FloatArray
    """NaN where the deflection was not measured, or the command was missing."""
    residual_deg: FloatArray
    """NaN where `measured_deg` is."""
    settled: BoolArray
    """False while the filter still forgets how it was started: no verdict may use these samples."""
    immobile_deg: FloatArray
    """What the residual would be if the surface rested at 0 deg: all that the filter sees of the command [deg]."""
    restart: NDArray[np.int8]
    """Where the filter, or filter and model, started anew."""
    context: Context = NO_CONTEXT
    """Airspeed and supply."""

    def __post_init__(self) -> None:
        for name in ("time_s", "simulated_deg", "measured_deg", "residual_deg", "immobile_deg"):
            object.__setattr__(self, name, own(getattr(self, name)))

    @property
    def error_deg(self) -> FloatArray:
        """Simulation error, measured minus simulated [deg]."""
        return self.measured_deg - self.simulated_deg


@dataclass(frozen=True, slots=True)
class ResidualGenerator:
    """Healthy model and filter of one surface.

    Parameters
    ----------
    model : ServoModel
        Healthy servo.
    pole_rad_s : float
        Speed of the filter [rad/s].

    Examples
    --------
    A healthy servo has no residual, however irregular the samples:

    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.series import Series
    >>> from servofd.servo.library import servo_named
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.cumsum(np.random.default_rng(1).uniform(0.005, 0.015, 1000))
    >>> command_deg = 10.0 * np.sin(time_s)
    >>> measured_deg = model.simulate(time_s, command_deg, time_s)
    >>> residuals = ResidualGenerator(model, 50.0).run(
    ...     Series("elevator", time_s, command_deg, time_s, measured_deg))
    >>> bool(np.nanmax(np.abs(residuals.residual_deg)) < 1e-9)
    True
    """

    model: ServoModel
    pole_rad_s: float

    @classmethod
    def fitting(cls, model: ServoModel, segment: Series, pole_rad_s: float | None = None) -> ResidualGenerator:
        """Generator with the given pole, or the fastest that the segment's sample rate allows."""
        return cls.fitting_pace(model, segment.period_s, pole_rad_s)

    @classmethod
    def fitting_pace(cls, model: ServoModel, period_s: float, pole_rad_s: float | None = None) -> ResidualGenerator:
        """Generator with the fastest pole that suits positions of a given period [s]."""
        generator = cls(model, pole_rad_s or fastest_pole_rad_s(model.transfer, period_s))
        generator.check(period_s)
        return generator

    def check(self, step_s: float) -> None:
        """Certify that the filter passes a constant error with the inverse dc gain, up to round-off.

        It does not if so many digits cancel that the order of the model is too high for this step.
        """
        parameters = self.filter_parameters()
        total = float(np.sum(lag_weights(parameters, step_s))) * parameters.dc_gain
        if not abs(total - 1.0) < _LARGEST_GAIN_ERROR:
            raise DesignError("the residual filter of this servo model loses all digits: use a model of lower order")

    @property
    def blanking_s(self) -> float:
        """Time after a start during which the residual is not judged [s]."""
        return _BLANKING_TIME_CONSTANTS / self.pole_rad_s

    def longest_gap_s(self, segment: Series) -> float:
        """Longest interval between samples that the filter bridges; after a longer one it starts anew [s]."""
        return self.longest_gap_s_at(segment.period_s)

    def longest_gap_s_at(self, period_s: float) -> float:
        """Longest interval between samples that the filter bridges, for positions of a given period [s]."""
        return max(_GAP_TIME_CONSTANTS / self.pole_rad_s, _GAP_PERIODS * period_s)

    def filter_parameters(self) -> FilterParameters:
        """The filter as the kernel sees it."""
        decay = self.model.transfer.modes().decay_rad_s
        pairs = decay[decay.imag != 0.0].conj()
        return FilterParameters(self.pole_rad_s, np.concatenate([decay, pairs]), self.model.transfer.dc_gain)

    def run(self, segment: Series) -> Residuals:
        """Residual of a whole segment."""
        simulator = Simulator.of(self, segment)
        simulated_deg, (measured_deg, restart, settled) = simulator.simulated_deg(self.model), simulator.starts
        for array in (simulated_deg, measured_deg):
            array.setflags(write=False)  # so that it need not be copied
        residual_deg, rest_deg = self._both_deg(segment.measured_s, simulated_deg, measured_deg, restart)
        return Residuals(
            segment.measured_s, simulated_deg, measured_deg, residual_deg, settled, rest_deg, restart, segment.context
        )

    def _both_deg(
        self, time_s: FloatArray, simulated_deg: FloatArray, measured_deg: FloatArray, restart: NDArray[np.int8]
    ) -> tuple[FloatArray, FloatArray]:
        """Residual of what was measured, and of a surface that rests at 0 deg; of shape (n,), each with its memory."""
        residual_deg, rest_deg = measured_deg - simulated_deg, -simulated_deg
        self._filter(time_s, residual_deg, restart, rest_deg.reshape(1, -1))
        for array in (residual_deg, rest_deg):
            array.setflags(write=False)
        return residual_deg, rest_deg

    def filtered(self, time_s: FloatArray, error_deg: FloatArray, restart: NDArray[np.int8]) -> FloatArray:
        """Residual of a simulation error [deg], shape (n,); anew where `restart` is not 0."""
        residual_deg = np.array(error_deg)
        self._filter(time_s, residual_deg, restart, np.empty((0, time_s.size)))
        return residual_deg

    def _filter(
        self, time_s: FloatArray, error_deg: FloatArray, restart: NDArray[np.int8], others_deg: FloatArray
    ) -> None:
        residual_filter = self.filter_parameters()
        memory = FilterMemory.of(residual_filter, 1 + len(others_deg))
        filter_in_place(residual_filter, memory, time_s, error_deg, restart, others_deg)


def followed(
    servo: AnyServo,
    commands: Commands,
    at_s: FloatArray,
    measured_deg: FloatArray,
    restart: NDArray[np.int8],
) -> FloatArray:
    """Deflection of a servo [deg], shape (n,), that starts anew where the surface was measured and `restart` is 2."""
    from servofd.servo.motion import started_anew

    signal = commands.effective_s, commands.command_deg, commands.slope_deg_s
    return started_anew(servo, signal, at_s, measured_deg, restart == RESTART_ALL)


def go_on(
    motion: Motion,
    commands: Commands,
    cursor: IntArray,
    at_s: FloatArray,
    measured_deg: FloatArray,
    restart: NDArray[np.int8],
) -> FloatArray:
    """Simulated positions [deg] for the next measurements of a flight, shape (n,).

    `cursor[0]` counts the commands that were received.
    """
    if not at_s.size:
        return np.zeros(0)
    begins, pieces = np.union1d(np.flatnonzero(restart == RESTART_ALL), [0]), []
    ends = np.append(begins[1:], at_s.size)
    received = np.maximum(np.searchsorted(commands.effective_s, at_s[ends - 1], side="right"), cursor[0])
    for begin, end, last in zip(begins.tolist(), ends.tolist(), received.tolist(), strict=True):
        span = slice(int(cursor[0]), last)
        motion.receive(commands.effective_s[span], commands.command_deg[span], commands.slope_deg_s[span])
        cursor[0] = last
        if restart[begin] == RESTART_ALL:
            motion.rest(float(at_s[begin]), float(measured_deg[begin]))
        pieces.append(motion.at(at_s[begin:end]))
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def commands_at_servo(segment: Series, delay_s: float, longest_gap_s: float) -> Commands:
    """Reconstruct what the servo received from what was logged.

    Complete logs: each command holds until the next; where single samples were lost, they are put back on the
    straight line between their neighbours. Thinned logs (`Series.command_period_s`): the command runs
    straight between samples, later by half the real period, the mean lag of the hold.
    """
    time_s, command_deg = segment.command_s, segment.command_deg
    if segment.command_period_s is not None:
        step_s = np.diff(time_s)
        slope = np.append(np.where(step_s <= longest_gap_s, np.diff(command_deg) / step_s, 0.0), 0.0)
        return Commands(time_s + delay_s + segment.command_period_s / 2.0, command_deg, slope)
    lost = lost_commands(time_s, longest_gap_s)
    if lost.any():
        time_s, command_deg = subdivided(time_s, command_deg, lost[:-1] + 1)
    return Commands(time_s + delay_s if delay_s else time_s, command_deg, np.zeros(time_s.size))


def lost_commands(command_s: FloatArray, longest_gap_s: float) -> IntArray:
    """How many commands a regular log has lost after each of its own, of shape (n,); holes are not counted."""
    step_s, beat = np.diff(command_s), rhythm(command_s)
    lost = np.zeros(command_s.size, dtype=np.int64)
    longer = np.flatnonzero(step_s > beat.longest_s)
    missing = longer[step_s[longer] <= longest_gap_s]
    lost[missing] = np.round(step_s[missing] / beat.period_s).astype(np.int64) - 1
    return lost


class Rhythm(NamedTuple):
    """Period of the commands of a log, and which of them were lost."""

    period_s: float
    longest_s: float
    """A longer interval holds a lost command."""


def rhythm(command_s: FloatArray) -> Rhythm:
    """Rhythm of commands with time stamps [s] of shape (n,).

    Infinite where commands come as they please, and no interval is a loss.
    """
    if command_s.size < _FEWEST_COMMANDS:
        return Rhythm(float("inf"), float("inf"))
    some_s = pace_steps(command_s)
    some_s = some_s[:: 1 + some_s.size // _INTERVALS_FOR_PERIOD]
    low_s, quarter_s, period_s, upper_s = np.percentile(some_s, [_LOW_QUANTILE, 25.0, 50.0, _MOST_KEPT]).tolist()
    most = _UNEVEN_SPREAD if low_s > _AT_ONCE * period_s else _REGULAR_SPREAD
    if upper_s - quarter_s > most * period_s:
        return Rhythm(float("inf"), float("inf"))
    jitter_s = _FEW_INTERVALS * (period_s - low_s) / _TRIANGLE
    least, most = (share * period_s for share in _LOST_SAMPLE)
    return Rhythm(period_s, min(max(period_s + jitter_s, least), most))


def thinned_rhythm(command_s: FloatArray) -> Rhythm:
    """Rhythm of commands that are sent steadily, and most of which get lost; time stamps [s] of shape (n,)."""
    if command_s.size < _FEWEST_COMMANDS:
        return Rhythm(float("inf"), float("inf"))
    period_s = float(np.percentile(pace_steps(command_s), _LOW_QUANTILE_OF_THINNED))
    return Rhythm(period_s, _LOST_SAMPLE[0] * period_s)


@dataclass(frozen=True, slots=True, eq=False)
class Simulator:
    """Commands and starts of a segment, which do not depend on the servo that is simulated."""

    segment: Series
    commands: Commands
    """As a servo without a delay gets them."""
    starts: Starts
    longest_gap_s: float
    """Longest interval between samples that is bridged."""

    @classmethod
    def of(cls, generator: ResidualGenerator, segment: Series) -> Simulator:
        """Make ready what the generator's filter would take: gaps and starts are found for its pole."""
        gap_s = generator.longest_gap_s(segment)
        starts = mark_starts(
            new_starts_memory(),
            segment.command_s,
            segment.measured_s,
            segment.measured_deg,
            (gap_s, rhythm(segment.command_s).longest_s, generator.blanking_s),
        )
        starts = starts._replace(settled=starts.settled & segment.counts)
        return cls(segment, commands_at_servo(segment, 0.0, gap_s), starts, gap_s)

    def with_commands(self, command_deg: FloatArray) -> Simulator:
        """The same part of the flight with other commands, shape (n,), at the instants of those that it has."""
        segment = replace(self.segment, command_deg=command_deg)
        return replace(self, segment=segment, commands=commands_at_servo(segment, 0.0, self.longest_gap_s))

    def simulated_deg(self, model: ServoModel) -> FloatArray:
        """Deflection of a servo [deg], shape (n,), as its residual generator would have it."""
        measured_deg, restart, _ = self.starts
        commands = replace(self.commands, effective_s=self.commands.effective_s + model.delay_s)
        return followed(model.servo(self.segment.context), commands, self.segment.measured_s, measured_deg, restart)


RECENT_COMMANDS = 11
"""Commands before a loss whose curvature counts."""
PEAK_OF_LAGS = 0.224
"""Share of a change of slope that the filter's lags pass at most."""


def unmodelled(
    generator: ResidualGenerator, segment: Series, residuals: Residuals, rate_share: float
) -> tuple[FloatArray, FloatArray]:
    """What a rate limit lower by a share leaves, and what lost commands may add from each sample on [deg], (n,) each.

    Empty without a limit, and where no command was lost.
    """
    slower_deg, slower = np.zeros(0), generator.model.weaker(rate_share)
    if slower is not generator.model:
        error_deg = Simulator.of(generator, segment).simulated_deg(slower) - residuals.simulated_deg
        known = np.where(np.isfinite(residuals.measured_deg), error_deg, np.nan)
        slower_deg = generator.filtered(residuals.time_s, known, residuals.restart)
    lost = lost_commands(segment.command_s, generator.longest_gap_s(segment))
    if segment.command_period_s is not None or not lost.any():
        return slower_deg, np.zeros(0)
    before = np.flatnonzero(lost)
    size_deg = np.array([unseen_deg(segment.command_deg[max(i - RECENT_COMMANDS, 0) : i + 1], lost[i]) for i in before])
    passed = PEAK_OF_LAGS * generator.pole_rad_s * segment.period_s
    added_deg = np.zeros(residuals.time_s.size)
    # What was made up first reaches the servo then, and the log with the first position after that.
    made_up_s = segment.command_s[before] + np.diff(segment.command_s)[before] / (lost[before] + 1)
    at = np.searchsorted(residuals.time_s, made_up_s + generator.model.delay_s)
    np.add.at(added_deg, np.minimum(at, added_deg.size - 1), passed * size_deg)
    return slower_deg, added_deg


def unseen_deg(recent_deg: FloatArray, lost: int) -> float:
    """How far a straight line over lost commands may be off, by the curvature of those before [deg]."""
    curvature_deg = np.abs(np.diff(recent_deg, 2))
    # A chord over n + 1 intervals is off by ((n + 1) / 2)^2 times as much as one over two, for n commands.
    return float(0.5 * curvature_deg.max(initial=0.0) * lost * (0.5 * (lost + 1)) ** 2)


CURVATURE_TO_SIGMA = float(np.sqrt(np.pi / 2.0 / 6.0))
"""Mean absolute second difference of white noise to its standard deviation. The median would fail on coarse steps."""
_MOST, _GLITCH = 90.0, 3.0
"""Second differences count as no more than this many times the ninth decile, 5 standard deviations of white noise."""


def noise_deg(error_deg: FloatArray) -> float:
    """Standard deviation of white measurement noise in a simulation error, whatever moves slowly in it [deg]."""
    curvature = np.diff(error_deg[np.isfinite(error_deg)], 2)
    if curvature.size == 0:
        return 0.0
    size_deg = np.abs(curvature)
    glitch_deg = _GLITCH * float(np.percentile(size_deg, _MOST))
    return CURVATURE_TO_SIGMA * float(np.mean(np.minimum(size_deg, glitch_deg)))


RESTART_NONE, RESTART_FILTER, RESTART_ALL = 0, 1, 2


def new_starts_memory() -> FloatArray:
    """Whether servo and filter have started, the last position used [s], the last start [s], and the next command."""
    return np.array([0.0, 0.0, -np.inf, -np.inf, 0.0])


class Starts(NamedTuple):
    """All arrays of shape (n,), one entry per measurement time."""

    measured_deg: FloatArray
    """NaN where there was no position, or no recent command to judge it by."""
    restart: NDArray[np.int8]
    """What has to start anew at this sample: nothing, the filter, or model and filter."""
    settled: BoolArray
    """True where a position is there and the last start lies far enough back."""


def mark_starts(
    memory: FloatArray,
    command_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    limits_s: tuple[float, float, float],
) -> Starts:
    """Mark the next samples, of shape (n,); the memory moves on with them, `command_s` are all commands so far.

    Limits are the longest interval without commands or positions that is bridged, the age of a command beyond which
    the next one is known to have been lost, and for how long after a start nothing is judged.
    """
    size = measured_s.size
    starts = Starts(np.empty(size), np.empty(size, dtype=np.int8), np.empty(size, dtype=bool))
    _mark(memory, command_s, measured_s, measured_deg, limits_s, *starts)
    return starts


@compiled
def _mark(
    memory: FloatArray,
    command_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    limits_s: tuple[float, float, float],
    usable_deg: FloatArray,
    restart: NDArray[np.int8],
    settled: BoolArray,
) -> None:
    longest_gap_s, fresh_s, blanking_s = limits_s
    c = int(memory[4])
    servo_known, filter_known = memory[0] != 0.0, memory[1] != 0.0
    last_used_s, last_start_s = memory[2], memory[3]
    for k in range(measured_s.size):
        now = measured_s[k]
        while c < command_s.size and command_s[c] <= now:
            # What the servo did while no command was logged for long is not known.
            if c > 0 and command_s[c] - command_s[c - 1] > longest_gap_s:
                servo_known = False
            c += 1
        commanded = c > 0 and now - command_s[c - 1] <= longest_gap_s
        usable = commanded and np.isfinite(measured_deg[k])
        restart[k] = RESTART_NONE
        if commanded and not servo_known:
            restart[k] = RESTART_ALL
            servo_known, filter_known = True, usable
        elif usable and (not filter_known or now - last_used_s > longest_gap_s):
            restart[k] = RESTART_FILTER
            filter_known = True
        if restart[k] != RESTART_NONE:
            last_start_s = now
        if usable:
            last_used_s = now
        usable_deg[k] = measured_deg[k] if usable else np.nan
        # Inside a hole the command is made up from the one after it; at the end of a log there is none.
        made_up = c > 0 and now - command_s[c - 1] > fresh_s
        settled[k] = usable and now - last_start_s >= blanking_s and not made_up
    memory[0], memory[1], memory[2], memory[3], memory[4] = servo_known, filter_known, last_used_s, last_start_s, c


class FilterParameters(NamedTuple):
    """The measured branch ``Qy`` of a nullspace filter."""

    pole_rad_s: float
    decay_rad_s: ComplexArray
    """All poles of the servo, negated, both members of each pair, of shape (n,)."""
    dc_gain: float


class FilterMemory(NamedTuple):
    """What changes from sample to sample while several signals of the same instants are filtered."""

    lags: FloatArray
    """Of shape (r, n + 1): successive lags of each signal [deg]."""
    weights: FloatArray
    """Of shape (n + 1,): shares of the lags in the residual for the step length below."""
    step: FloatArray
    """Of shape (3,): step length [s] of the weights, its lag factor, time of the last filtered sample [s]."""
    polynomial: ComplexArray
    """Of shape (n + 1,): room for the calculation of the weights."""

    @classmethod
    def of(cls, residual_filter: FilterParameters, signals: int) -> FilterMemory:
        """Memory before the first sample."""
        lags = residual_filter.decay_rad_s.size + 1
        return cls(
            np.zeros((signals, lags)), np.zeros(lags), np.array([-1.0, 0.0, 0.0]), np.zeros(lags, dtype=np.complex128)
        )


@inner
def _weigh_lags(residual_filter: FilterParameters, memory: FilterMemory, step_s: float) -> None:
    """Shares of the lags for this step length: the servo's characteristic polynomial written in the lag."""
    lag = math.exp(-residual_filter.pole_rad_s * step_s)
    order = residual_filter.decay_rad_s.size
    polynomial = memory.polynomial
    for i in range(order + 1):
        polynomial[i] = 1.0 if i == 0 else 0.0
    free = 1.0 + 0.0j
    for i in range(order):
        factor = np.exp(-residual_filter.decay_rad_s[i] * step_s)
        ratio = factor / lag
        for j in range(i + 1, 0, -1):
            polynomial[j] = (1.0 - ratio) * polynomial[j] + ratio * polynomial[j - 1]
        polynomial[0] *= 1.0 - ratio
        free *= 1.0 - factor
    scale = 1.0 / (residual_filter.dc_gain * free.real)
    for j in range(order + 1):
        # Entry j multiplies the lag of order n + 1 - j; the lags are stored by rising order.
        memory.weights[order - j] = polynomial[j].real * scale
        scale *= 1.0 - lag
    memory.step[0] = step_s
    memory.step[1] = lag


def lag_weights(residual_filter: FilterParameters, step_s: float) -> FloatArray:
    """Shares of the lags in the residual for one step length, of shape (n + 1,)."""
    memory = FilterMemory.of(residual_filter, 1)
    filter_in_place(residual_filter, memory, np.array([0.0, step_s]), np.zeros(2), np.array([1, 0], dtype=np.int8))
    return memory.weights


def filter_in_place(
    residual_filter: FilterParameters,
    memory: FilterMemory,
    time_s: FloatArray,
    error_deg: FloatArray,
    restart: NDArray[np.int8],
    others_deg: FloatArray | None = None,
) -> None:
    """Turn a simulation error [deg], shape (n,), into its residual, and so other signals of its instants, (r, n).

    The memory moves on. A sample that is NaN in the error is left out in all of them; the filter starts anew where
    `restart` is not 0. In place, because fresh pages of memory take longer than the filter.
    """
    others_deg = np.empty((0, time_s.size)) if others_deg is None else others_deg
    _filter(residual_filter, memory, fixed(time_s), error_deg, others_deg, fixed(restart))


@compiled
def _filter(
    residual_filter: FilterParameters,
    memory: FilterMemory,
    time_s: FloatArray,
    error_deg: FloatArray,
    others_deg: FloatArray,
    restart: NDArray[np.int8],
) -> None:
    lags, last_s = memory.lags, memory.step[2]
    for k in range(time_s.size):
        if math.isnan(error_deg[k]):
            for r in range(1, lags.shape[0]):
                others_deg[r - 1, k] = math.nan
            continue
        step_s, last_s = time_s[k] - last_s, time_s[k]
        if restart[k] == 0 and abs(step_s - memory.step[0]) > _SAME_STEP_S:
            _weigh_lags(residual_filter, memory, step_s)
        lag = memory.step[1]
        for r in range(lags.shape[0]):
            value, residual = error_deg[k] if r == 0 else others_deg[r - 1, k], 0.0
            if restart[k] != 0:
                residual = value / residual_filter.dc_gain
            for j in range(lags.shape[1]):
                if restart[k] == 0:
                    value = lag * lags[r, j] + (1.0 - lag) * value
                    residual += memory.weights[j] * value
                lags[r, j] = value
            if r == 0:
                error_deg[k] = residual
            else:
                others_deg[r - 1, k] = residual
    memory.step[2] = last_s


_THIN_PERIOD_S = 0.039
"""Logs at up to 25 Hz may hold fewer commands than the servo received; autopilots command at 50 Hz and more."""
_REAL_PERIOD_S = 0.02
"""Period at which commands are given that are logged more rarely [s]."""
_CLEARLY_SMALLER = 0.7
"""Ratio of two residuals below which the smaller one decides."""


class Prepared(NamedTuple):
    """A segment that can be judged, and what was done to it."""

    segment: Series
    residuals: Residuals
    notes: tuple[str, ...]


def prepared(generator: ResidualGenerator, segment: Series) -> Prepared:
    """Run the generator with the hold that suits the commands.

    Commands that were given
    more often than the 10 to 25 Hz of the log look like steps that were not commanded: if straight lines between them
    leave a clearly smaller residual, that is what they were.
    """
    notes = []
    residuals = generator.run(segment)
    steps_s = pace_steps(segment.command_s)
    period_s = max(segment.period_s, float(np.median(steps_s)) if steps_s.size else 0.0)  # of the rarer stream
    if segment.command_period_s is None and period_s >= _THIN_PERIOD_S:
        straight = replace(segment, command_period_s=_REAL_PERIOD_S)
        by_lines = generator.run(straight)
        if _rms_deg(by_lines) < _CLEARLY_SMALLER * _rms_deg(residuals):
            segment, residuals = straight, by_lines
            notes.append("commands are logged more thinly than they were given, and taken as straight lines between")
    return Prepared(segment, residuals, tuple(notes))


def _rms_deg(residuals: Residuals) -> float:
    judged = residuals.residual_deg[residuals.settled]
    return float(np.sqrt(np.mean(judged**2))) if judged.size else float("inf")
