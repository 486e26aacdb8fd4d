"""From bench tests to a servo: thesis chapter 3."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from servofd.core.errors import IdentificationError
from servofd.identification.choice import Choice, choose_linear, choose_nonlinear, steps_of, with_unity_gain
from servofd.identification.motion import MotionFit, check_saturation, evaluated, fit_motion
from servofd.identification.records import (
    Run,
    Uniform,
    check_clipping,
    check_drift,
    check_order_of_columns,
    check_segment,
    longest_uniform,
    prepared,
)
from servofd.identification.response import FrequencyResponse, average, estimate
from servofd.identification.result import Identification
from servofd.identification.summary import intervals_of, notes_on_servo, notes_on_spread

if TYPE_CHECKING:
    from servofd.aircraft.series import Series

_T = TypeVar("_T")

_SHORTEST_SWEEP_S = 10.0
"""Shortest sweep that gives a frequency response [s]."""
_NARROWEST_SWEEP = 3.0
"""Ratio of the highest to the lowest coherent frequency."""
_STEPWISE = 0.1
"""A command that changes in fewer of the samples consists of steps."""
_LEVELS = 10
"""So does one that has no more levels."""
_LARGEST_ERROR = 0.3
"""Of the position's own deviation; the worst real servo so far leaves 0.06."""
_SWAPPED_RAD = 0.05
"""Mean phase above which the position is ahead of the command [rad]: the columns are swapped."""
_FOLLOWS = 0.7
"""Share of the position's deviation that a model may leave if the servo follows."""


def identify(
    records: Series | Sequence[Sequence[Series]],
    *,
    order: int | None = None,
    labels: Sequence[str] = (),
    progress: Callable[[str], object] = str,
) -> Identification:
    """Identify a servo from chirps, steps or other motion.

    By the frequency response with the exact hold and delay, refined on the motion itself; without a sweep by the motion
    alone.

    Parameters
    ----------
    records : Series, or sequence of sequences of Series
        One test; or for each of several servos of one kind its tests. The servo is their mean, `notes` tell how far
        they differ.
    order : int, optional
        Number of poles, 1 to 3; left out, the data choose.
    labels : sequence of str
        What to call each servo in messages.
    progress : callable
        Called with what was done, after each of the three steps of the work.

    Returns
    -------
    Identification
        Poles, dc gain, delay without the hold, bandwidth, rate limits, dead band, intervals, notes.

    Raises
    ------
    IdentificationError
        If the tests do not show what the servo is like; the message is the reason.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.series import Series
    >>> from servofd.servo.library import servo_named
    >>> from servofd.simulation.commands import chirp
    >>> rng, time_s = np.random.default_rng(0), np.arange(12000) / 100.0
    >>> command_deg = chirp(time_s, rng)
    >>> measured_deg = ServoModel.of(servo_named("hs225bb-eq31")).simulate(time_s, command_deg, time_s)
    >>> measured_deg += 0.1 * rng.standard_normal(time_s.size)
    >>> found = identify(Series("elevator", time_s, command_deg, time_s, measured_deg))
    >>> found.servo.linear.order, round(1e3 * found.servo.linear.delay_s, 1), found.servo.linear.gain
    (3, 4.0, 1.0)
    """
    sets = records if isinstance(records, Sequence) else [[records]]
    names = labels or [segments[0].surface for segments in sets]
    tests = _Tests.of(sets, names)
    spread_notes = notes_on_spread(tests.small, order, tests.names)
    choice = choose_linear(tests.small or tests.runs, order)
    free, notes = choice.fit, list(tests.notes)
    progress("linear servo")
    _check_follows(free, tests)
    _check_drift(free, tests)
    everything = free if len(free.errors_deg) == len(tests.runs) else fit_motion(tests.runs, free.servo)
    if not everything.is_white:
        free = choose_nonlinear(tests.runs, everything, free.servo.linear if tests.small else None, order)
    progress("rate limits and dead band")
    unity = with_unity_gain(tests.fitted(free), free)
    if unity is not None:
        notes.append("dc gain does not differ from 1 within its interval, and is set to 1 (thesis Appendix A)")
    final = (unity or free).servo
    if final.rate_up_deg_s is None:
        notes.append(_no_rate(tests.runs))
    parts, offsets = evaluated(tests.runs, final)
    choice = Choice(free, choice.further if free is choice.fit else None)
    intervals = intervals_of(choice, final)
    progress("intervals")
    notes += notes_on_servo(choice, tests.fitted(free), intervals, tests.band_rad_s)
    result = Identification(
        surface=sets[0][0].surface,
        method="response" if tests.nominal is not None else "motion",
        servo=final,
        intervals=intervals,
        notes=(*notes, *spread_notes),
        runs=tests.runs,
        errors_deg=parts,
        offset_deg=float(offsets.mean()),
        response=tests.nominal,
        responses=tests.responses,
        band_rad_s=tests.band_rad_s,
        segments=tuple(itertools.chain(*sets)),
    )
    _check_explained(result, tests)
    if not any(is_stepwise(run) for run in tests.runs):
        named = [(run, tests.names[run.servo]) for run in tests.runs]
        _refuse_most(named, lambda run, label: check_saturation(run, final, label))
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Tests:
    """All tests, sorted into those that sweep the frequencies and others."""

    names: tuple[str, ...]
    runs: tuple[Run, ...]
    small: tuple[Run, ...]
    """Sweeps; the frequency response rests on them."""
    responses: tuple[FrequencyResponse, ...]
    nominal: FrequencyResponse | None
    band_rad_s: tuple[float, float] | None
    notes: tuple[str, ...]

    @classmethod
    def of(cls, sets: Sequence[Sequence[Series]], names: Sequence[str]) -> _Tests:
        runs, labels = [], []
        for servo, (segments, name) in enumerate(zip(sets, names, strict=True)):
            for segment in segments:
                try:
                    check_segment(segment, name)
                except IdentificationError:
                    if len(segments) == 1:
                        raise
                    continue  # of a file with many runs some may hold no test, such as those without motion
                runs.append(prepared(segment, servo))
                labels.append(name)
        if not runs:
            raise IdentificationError(f"{names[0]}: no test long enough; a chirp or steps are needed")
        uniform = [longest_uniform(run) for run in runs]
        moving = [k for k, u in enumerate(uniform) if np.ptp(u.command_deg) > 0.0]
        _refuse_most([(uniform[k], labels[k]) for k in moving], check_order_of_columns)
        _refuse_most([(runs[k], labels[k]) for k in moving if not is_stepwise(runs[k])], check_clipping)
        sweeps = [(run, u, response) for run, u in zip(runs, uniform, strict=True) if (response := _sweep(run, u))]
        responses = tuple(
            average([response for run, _, response in sweeps if run.servo == servo])
            for servo in sorted({run.servo for run, _, _ in sweeps})
        )
        notes = []
        if any(u.resampled for _, u, _ in sweeps):
            notes.append(
                "time stamps are irregular: resampled for the frequency response alone (commands held, positions "
                "interpolated); the motion was fitted on the true stamps"
            )
        if not responses:
            notes.append("no sweep long enough for a frequency response: fitted to the motion alone")
            return cls(tuple(names), tuple(runs), (), (), None, None, tuple(notes))
        nominal = average(responses)
        band = nominal.band_rad_s()
        _check_phase(nominal, band, labels[0])
        small = tuple(run for run, _, _ in sweeps)
        return cls(tuple(names), tuple(runs), small, responses, nominal, band, tuple(notes))

    def fitted(self, fit: MotionFit) -> tuple[Run, ...]:
        """The runs a fit rests on."""
        return self.runs if len(fit.errors_deg) == len(self.runs) else self.small


def _refuse_most(tests: Sequence[tuple[_T, str]], check: Callable[[_T, str], None]) -> None:
    """Refuse what most runs refuse; among many runs a single one may be odd."""
    refusals = []
    for test, label in tests:
        try:
            check(test, label)
        except IdentificationError as error:
            refusals.append(error)
    if 2 * len(refusals) > len(tests):
        raise refusals[0]


def is_stepwise(run: Run) -> bool:
    """Whether a run is steps, rather than a motion that is sampled."""
    seldom = np.count_nonzero(np.diff(run.command_deg)) < _STEPWISE * run.measured_s.size
    return bool(seldom or np.unique(run.command_deg).size <= _LEVELS)


def _sweep(run: Run, uniform: Uniform) -> FrequencyResponse | None:
    """Frequency response of a run that sweeps far enough; None if it does not."""
    duration_s = uniform.sample_time_s * uniform.command_deg.size
    if duration_s < _SHORTEST_SWEEP_S or np.ptp(uniform.command_deg) == 0.0 or is_stepwise(run):
        return None
    response = estimate(uniform.command_deg, uniform.measured_deg, uniform.sample_time_s)
    band = response.band_rad_s()
    return response if band is not None and band[1] >= _NARROWEST_SWEEP * band[0] else None


def _check_phase(response: FrequencyResponse, band: tuple[float, float] | None, label: str) -> None:
    """Refuse a position that leads its command, by less than a sample tells of a fast servo in a slow log."""
    if band is None:
        raise IdentificationError(f"{label}: the tests have no frequencies in common in which position follows command")
    phase = response.phase_rad[(response.frequency_rad_s >= band[0]) & (response.frequency_rad_s <= band[1])]
    lead_rad = float(np.mean(phase - np.pi * np.round(phase[0] / np.pi)))
    if lead_rad > _SWAPPED_RAD:
        raise IdentificationError(
            f"{label}: the position leads the command by {np.degrees(lead_rad):.0f} deg of phase on average: are the "
            "two columns swapped?"
        )


def _check_follows(fit: MotionFit, tests: _Tests) -> None:
    runs = tests.fitted(fit)
    if fit.rms_deg > _FOLLOWS * _deviation_deg(runs) and not any(is_stepwise(run) for run in runs):
        raise IdentificationError(
            f"{tests.names[0]}: the position does not follow the command: the best servo leaves {fit.rms_deg:.3g} deg "
            f"rms of a motion of {_deviation_deg(runs):.3g} deg; is this the right position channel, and was it moving?"
        )


def _check_drift(fit: MotionFit, tests: _Tests) -> None:
    swept = [
        ((run, error), tests.names[run.servo])
        for run, error in zip(tests.fitted(fit), fit.errors_deg, strict=True)
        if not is_stepwise(run)
    ]
    _refuse_most(swept, lambda pair, label: check_drift(*pair, label))


def _check_explained(result: Identification, tests: _Tests) -> None:
    deviation = _deviation_deg(result.runs)
    if result.rms_deg > _LARGEST_ERROR * deviation:
        raise IdentificationError(
            f"{tests.names[0]}: no servo model explains this motion: {result.rms_deg:.3g} deg rms are left of "
            f"{deviation:.3g} deg; data of two servos mixed, a loose sensor, or time stamps that are wrong?"
        )


def _deviation_deg(runs: Sequence[Run]) -> float:
    return float(np.std(np.concatenate([run.measured_deg - run.measured_deg.mean() for run in runs])))


def _no_rate(runs: Sequence[Run]) -> str:
    """Why no rate limit was found."""
    largest_deg = max((abs(step.jump_deg) for run in runs for step in steps_of(run)), default=0.0)
    why = "no step: a command that jumps and holds until the servo has arrived"
    if largest_deg:
        why = (
            f"steps of up to {largest_deg:.3g} deg move as fast as the linear servo would: too small to reach the rate "
            "limit, use larger ones"
        )
    return f"rate limit not identified: {why}"
