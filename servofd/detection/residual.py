r"""Residuals of real logs: ``r = Qy (y - ŷ)`` on true time stamps.

With ŷ from the full servo model this is, on uniform samples and for a linear servo, the same residual as that
of the plant-first nullspace filter (`servofd.detection.pulse`); but it stays zero for a servo that runs into
its rate limit, and it needs no resampling.

``Qy`` is :math:`g\,a(z)/M_d(z)`. Written in the lag :math:`L = (1-q)/(1 - q z^{-1})`, :math:`q = e^{-|p|\Delta t}`,
it becomes a weighted sum of :math:`L \dots L^{n+1}` whose weights are closed-form functions of the step
:math:`\Delta t`: this form carries over to irregular steps, has the right dc gain on every one of them, and has
no step length at which it fails.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.records import own
from servofd.aircraft.segment import pace_steps
from servofd.core.errors import DesignError
from servofd.core.series import latest
from servofd.detection.pulse import fastest_pole_rad_s
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.core.types import BoolArray, FloatArray, IntArray
    from servofd.detection.samples import FilterParameters, Starts
    from servofd.servo.motion import AnyServo, ExtendedMotion, PlainMotion
    from servofd.servo.servo_model import ServoModel

_GAP_TIME_CONSTANTS = 5.0
_GAP_PERIODS = 3.0
_BLANKING_TIME_CONSTANTS = 8.0
_LARGEST_GAIN_ERROR = 1e-6
_LOST_SAMPLE = (1.5, 1.75)
"""An interval at least this many times the median holds a lost sample: the more, the more the time stamps jitter."""
_LOW_QUANTILE_OF_THINNED = 10.0
"""Where one message in four arrives, as many intervals in four are whole."""
_LOW_QUANTILE, _TRIANGLE = 5.0, 1.0 - 0.1**0.5
"""Two uniform jitters make a triangular one; its lower 5 % lie beyond this share of its half width."""
_FEW_INTERVALS = 1.25
"""A quantile of a hundred intervals scatters by a tenth."""
_INTERVALS_FOR_PERIOD = 10_000
_FEWEST_COMMANDS = 3
_MOST_KEPT = 60.0
"""A log that has lost three commands in ten has the right interval in seven of ten, give or take a few."""
_REGULAR_SPREAD, _UNEVEN_SPREAD, _AT_ONCE = 0.35, 0.45, 0.4
"""From the lower quarter of all intervals to that quantile within this share of the median: a regular log. In a hundred
intervals of 10 ms it is 0.18 to 0.43 if stamps are off by up to 3 ms and a fifth is lost (400 draws), but then hardly
one is shorter than the last share of the median, as some are where commands come as they please."""


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
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.cumsum(np.random.default_rng(1).uniform(0.005, 0.015, 1000))
    >>> command_deg = 10.0 * np.sin(time_s)
    >>> measured_deg = model.simulate(time_s, command_deg, time_s)
    >>> residuals = ResidualGenerator(model, 50.0).run(
    ...     Segment("elevator", time_s, command_deg, time_s, measured_deg))
    >>> bool(np.nanmax(np.abs(residuals.residual_deg)) < 1e-9)
    True
    """

    model: ServoModel
    pole_rad_s: float

    @classmethod
    def fitting(cls, model: ServoModel, segment: Segment, pole_rad_s: float | None = None) -> ResidualGenerator:
        """Generator with the given pole, or the fastest that the segment's sample rate allows."""
        return cls.fitting_pace(model, segment.period_s, pole_rad_s)

    @classmethod
    def fitting_pace(cls, model: ServoModel, period_s: float, pole_rad_s: float | None = None) -> ResidualGenerator:
        """The same for positions that come every so many seconds."""
        generator = cls(model, pole_rad_s or fastest_pole_rad_s(model.transfer, period_s))
        generator.check(period_s)
        return generator

    def check(self, step_s: float) -> None:
        """Certify that the filter passes a constant error with the inverse dc gain, up to round-off.

        It does not if so many digits cancel that the order of the model is too high for this step.
        """
        from servofd.detection.samples import lag_weights

        parameters = self.filter_parameters()
        total = float(np.sum(lag_weights(parameters, step_s))) * parameters.dc_gain
        if not abs(total - 1.0) < _LARGEST_GAIN_ERROR:
            raise DesignError("the residual filter of this servo model loses all digits: use a model of lower order")

    @property
    def blanking_s(self) -> float:
        """Time after a start during which the residual is not judged [s]."""
        return _BLANKING_TIME_CONSTANTS / self.pole_rad_s

    def longest_gap_s(self, segment: Segment) -> float:
        """Longest interval between samples that the filter bridges; after a longer one it starts anew [s]."""
        return self.longest_gap_s_at(segment.period_s)

    def longest_gap_s_at(self, period_s: float) -> float:
        """The same for positions that come every so many seconds [s]."""
        return max(_GAP_TIME_CONSTANTS / self.pole_rad_s, _GAP_PERIODS * period_s)

    def filter_parameters(self) -> FilterParameters:
        """The filter as the kernel sees it."""
        from servofd.detection.samples import FilterParameters

        decay = self.model.transfer.modes().decay_rad_s
        pairs = decay[decay.imag != 0.0].conj()
        return FilterParameters(self.pole_rad_s, np.concatenate([decay, pairs]), self.model.transfer.dc_gain)

    def run(self, segment: Segment) -> Residuals:
        """Residual of a whole segment."""
        from servofd.detection.samples import find_starts

        longest_gap_s = self.longest_gap_s(segment)
        starts = find_starts(segment, longest_gap_s, self.blanking_s, rhythm(segment.command_s).longest_s)
        commands = commands_at_servo(segment, self.model.plan.delay_s, longest_gap_s)
        simulated = followed(
            self.model.servo(segment.context), commands, segment.measured_s, starts.measured_deg, starts.restart
        )
        residual = self.filtered(segment.measured_s, starts.measured_deg - simulated, starts.restart)
        immobile = np.where(np.isfinite(starts.measured_deg), -simulated, np.nan)
        immobile_deg = self.filtered(segment.measured_s, immobile, starts.restart)
        for array in (simulated, residual, starts.measured_deg, immobile_deg):
            array.setflags(write=False)
        return Residuals(
            segment.measured_s,
            simulated,
            starts.measured_deg,
            residual,
            starts.settled,
            immobile_deg,
            starts.restart,
            segment.context,
        )

    def without(self, residuals: Residuals, left_out: BoolArray) -> Residuals:
        """The same residuals as if some positions, marked in an array of shape (n,), had not come."""
        measured_deg = np.where(left_out, np.nan, residuals.measured_deg)
        rows = np.array([measured_deg - residuals.simulated_deg, -residuals.simulated_deg])
        residual_deg, immobile_deg = self.filtered(residuals.time_s, rows, residuals.restart)
        return replace(
            residuals,
            measured_deg=measured_deg,
            residual_deg=residual_deg,
            settled=residuals.settled & ~left_out,
            immobile_deg=immobile_deg,
        )

    def filtered(self, time_s: FloatArray, error_deg: FloatArray, restart: NDArray[np.int8]) -> FloatArray:
        """Residual of one or several simulation errors [deg], shape (n,) or (r, n); anew where `restart` is not 0."""
        from servofd.detection.samples import FilterMemory, filtered_rows

        residual_filter = self.filter_parameters()
        memory = FilterMemory.of(residual_filter, 1 if error_deg.ndim == 1 else len(error_deg))
        return filtered_rows(residual_filter, memory, time_s, error_deg, restart)


def followed(
    servo: AnyServo,
    commands: Commands,
    at_s: FloatArray,
    measured_deg: FloatArray,
    restart: NDArray[np.int8],
) -> FloatArray:
    """Deflection of a servo [deg], shape (n,), that starts anew where the surface was measured and `restart` is 2."""
    from servofd.detection.samples import RESTART_ALL
    from servofd.servo.kernel import ServoParameters
    from servofd.servo.motion import on_its_way, started_anew

    if isinstance(servo, ServoParameters):
        signal = commands.effective_s, commands.command_deg, commands.slope_deg_s
        return started_anew(servo, signal, at_s, measured_deg, restart == RESTART_ALL)
    return go_on(on_its_way(servo), commands, np.zeros(1, dtype=np.int64), at_s, measured_deg, restart)


def go_on(
    motion: PlainMotion | ExtendedMotion,
    commands: Commands,
    cursor: IntArray,
    at_s: FloatArray,
    measured_deg: FloatArray,
    restart: NDArray[np.int8],
) -> FloatArray:
    """The same for the next positions of a flight, shape (n,); `cursor[0]` counts the commands that were heard."""
    from servofd.detection.samples import RESTART_ALL

    if not at_s.size:
        return np.zeros(0)
    begins, pieces = np.union1d(np.flatnonzero(restart == RESTART_ALL), [0]), []
    ends = np.append(begins[1:], at_s.size)
    heard = np.maximum(np.searchsorted(commands.effective_s, at_s[ends - 1], side="right"), cursor[0])
    for begin, end, last in zip(begins.tolist(), ends.tolist(), heard.tolist(), strict=True):
        span = slice(int(cursor[0]), last)
        motion.receive(commands.effective_s[span], commands.command_deg[span], commands.slope_deg_s[span])
        cursor[0] = last
        if restart[begin] == RESTART_ALL:
            motion.rest(float(at_s[begin]), float(measured_deg[begin]))
        pieces.append(motion.at(at_s[begin:end]))
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def commands_at_servo(segment: Segment, delay_s: float, longest_gap_s: float) -> Commands:
    """Reconstruct what the servo received from what was logged.

    Complete logs: each command holds until the next; where single samples were lost, they are put back on the
    straight line between their neighbours. Thinned logs (`Segment.command_period_s`): the command runs
    straight between samples, later by half the real period, the mean lag of the hold.

    Examples
    --------
    One lost sample at 0.02 s:

    >>> from servofd.aircraft.segment import Segment
    >>> time_s = np.array([0.0, 0.01, 0.03, 0.04])
    >>> commands_at_servo(Segment("x", time_s, time_s * 100.0, time_s, time_s), 0.0, 0.1).command_deg
    array([0., 1., 2., 3., 4.])
    """
    time_s, command_deg = segment.command_s, segment.command_deg
    if segment.command_period_s is not None:
        step_s = np.diff(time_s)
        slope = np.append(np.where(step_s <= longest_gap_s, np.diff(command_deg) / step_s, 0.0), 0.0)
        return Commands(time_s + delay_s + segment.command_period_s / 2.0, command_deg, slope)
    time_s, command_deg = _with_lost_commands(time_s, command_deg, longest_gap_s)
    return Commands(time_s + delay_s, command_deg, np.zeros(time_s.size))


def lost_commands(command_s: FloatArray, longest_gap_s: float) -> IntArray:
    """How many commands a regular log has lost after each of its own, of shape (n,); holes are not counted."""
    step_s, beat = np.diff(command_s), rhythm(command_s)
    missing = (step_s > beat.longest_s) & (step_s <= longest_gap_s)
    lost = np.zeros(command_s.size, dtype=np.int64)
    lost[:-1][missing] = np.round(step_s[missing] / beat.period_s).astype(np.int64) - 1
    return lost


def _with_lost_commands(
    time_s: FloatArray, command_deg: FloatArray, longest_gap_s: float
) -> tuple[FloatArray, FloatArray]:
    lost = lost_commands(time_s, longest_gap_s)
    if not lost.any():
        return time_s, command_deg
    pieces = lost[:-1] + 1
    owner = np.repeat(np.arange(pieces.size), pieces)
    place = np.arange(owner.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = place / pieces[owner]
    filled_s = np.append(time_s[owner] + share * np.diff(time_s)[owner], time_s[-1])
    return filled_s, np.append(command_deg[owner] + share * np.diff(command_deg)[owner], command_deg[-1])


class Rhythm(NamedTuple):
    """Of the commands of a log."""

    period_s: float
    longest_s: float
    """A longer interval holds a lost command."""


def rhythm(command_s: FloatArray) -> Rhythm:
    """Rhythm of commands with time stamps [s] of shape (n,).

    Infinite where commands come as they please, and no interval is a loss.

    Examples
    --------
    >>> rhythm(np.arange(100) * 0.02).longest_s.__round__(3)
    0.03
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
    """Commands and starts of a segment, which do not depend on the servo; the residual, most of the cost, is left out.

    Examples
    --------
    >>> import numpy as np
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.arange(1000) / 100.0
    >>> segment = Segment("elevator", time_s, np.sin(time_s), time_s, np.zeros(1000))
    >>> generator = ResidualGenerator(model, 30.0)
    >>> simulator = Simulator.of(generator, segment)
    >>> bool(np.array_equal(simulator.simulated_deg(model), generator.run(segment).simulated_deg))
    True
    """

    segment: Segment
    commands: Commands
    """As a servo without a delay gets them."""
    starts: Starts
    longest_gap_s: float
    """Longest interval between samples that is bridged."""

    @classmethod
    def of(cls, generator: ResidualGenerator, segment: Segment) -> Simulator:
        """Make ready what the generator's filter would take: gaps and starts are found for its pole."""
        from servofd.detection.samples import find_starts

        gap_s = generator.longest_gap_s(segment)
        starts = find_starts(segment, gap_s, generator.blanking_s, rhythm(segment.command_s).longest_s)
        return cls(segment, commands_at_servo(segment, 0.0, gap_s), starts, gap_s)

    def with_commands(self, command_deg: FloatArray) -> Simulator:
        """The same part of the flight with other commands, shape (n,), at the instants of those that it has."""
        segment = replace(self.segment, command_deg=command_deg)
        return replace(self, segment=segment, commands=commands_at_servo(segment, 0.0, self.longest_gap_s))

    def simulated_deg(self, model: ServoModel) -> FloatArray:
        """Deflection of a servo [deg], shape (n,), as its residual generator would have it."""
        measured_deg, restart, _ = self.starts
        commands = replace(self.commands, effective_s=self.commands.effective_s + model.plan.delay_s)
        return followed(model.servo(self.segment.context), commands, self.segment.measured_s, measured_deg, restart)
