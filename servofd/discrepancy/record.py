"""What is compared: commands and positions of one surface, the samples that count, and the servo's simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from servofd.aircraft.marks import Why
from servofd.aircraft.pace import rhythm
from servofd.aircraft.series import FORGETS_S, Series
from servofd.core.series import latest
from servofd.core.types import BoolArray, FloatArray, IntArray
from servofd.discrepancy.known import A_TYPE, Known
from servofd.estimate.record import commands_at_servo
from servofd.servo.catalogue import at_run
from servofd.servo.context import Context
from servofd.servo.effects.commands import Commands
from servofd.servo.motion import NOTHING_AROUND, around_servo, machine_of, received
from servofd.servo.physics import Physics, loose_shares
from servofd.servo.servo_model import ServoModel

_DOUBTFUL = 1.45
"""Times the usual interval, from which on a lost command may hide among time stamps that jitter."""
_LARGEST_GUESS_DEG, _FORGOTTEN_S = 0.25, 0.16
"""A lost command off by this much moves an HS-225BB by 0.04 deg, for four of its time constants."""
_SPANS, _NEAR = (3, 10, 50), 25
"""Commands over which the period is measured, ever better, and to either side of those whose period is measured."""
_ON_BEAT, _STEADY = 0.4, 0.3
"""Share of a period by which a command may be off its beat (half of one is where the count goes wrong), and length of
the mean of the commands' turns on the clock: 0.5 if they are off by up to 0.3 periods, evenly; of 51 that come as they
please more than 0.3 in one of a hundred."""


def after_lost_commands(command_s: FloatArray, command_deg: FloatArray, hole_s: float, time_s: FloatArray) -> BoolArray:
    """Samples that follow a lost command that lies on no line with those around it, shape (n,).

    Commands that keep to a beat, each a little early or late, say how many were lost: the beat goes on. Where there
    is none, a lost command may hide in every interval that is merely long.
    """
    after = np.zeros(time_s.size, dtype=bool)
    if command_s.size < 4:
        return after
    step_s, period_s = np.diff(command_s), rhythm(command_s).period_s
    lost = step_s > _DOUBTFUL * period_s
    if np.isfinite(period_s):
        beats, sure = _beats(command_s, period_s)
        lost = np.where(sure, beats > 1.0, lost)
    lost &= step_s <= hole_s
    bend = np.abs(np.diff(command_deg, 2, prepend=command_deg[:1], append=command_deg[-1:]))
    for k in np.flatnonzero(lost & (np.maximum(bend[:-1], bend[1:]) > _LARGEST_GUESS_DEG)):
        first, last = np.searchsorted(time_s, (command_s[k], command_s[k + 1] + _FORGOTTEN_S))
        after[first:last] = True
    return after


def _beats(command_s: FloatArray, period_s: float) -> tuple[FloatArray, BoolArray]:
    """How many beats each interval is long, shape (m - 1,), and whether that is sure."""
    if command_s.size <= 2 * _NEAR + _SPANS[-1]:
        return np.ones(command_s.size - 1), np.zeros(command_s.size - 1, dtype=bool)
    for span in _SPANS:
        span_s = command_s[span:] - command_s[:-span]
        period_s = float(np.median(span_s / np.maximum(np.round(span_s / period_s), 1.0)))
    turns = np.exp(2j * np.pi * command_s / period_s)
    mean = np.convolve(turns, np.ones(2 * _NEAR + 1), "same") / np.convolve(
        np.ones(turns.size), np.ones(2 * _NEAR + 1), "same"
    )
    off = np.angle(turns * np.conj(mean)) / (2.0 * np.pi)
    fits = (np.abs(off) < _ON_BEAT) & (np.abs(mean) > _STEADY)
    beats = np.round(np.diff(command_s) / period_s - np.diff(off))
    return beats, fits[:-1] & fits[1:]


SLOWEST_EXPLAINED_HZ = 19.0
"""Below this, which a rate of 20 Hz that loses some frames still reaches, the effects of a servo fall between the
samples: HS-225BB, time constants 15 to 40 ms."""

BLOCK_S = 0.3
"""Length of the blocks that are fitted and held out in turn [s]: longer than a servo remembers, shorter than most
manoeuvres."""
_CYCLE, _ASIDE, _FEWEST_FOR_THREE = 10, 4, 1000
"""Of so many blocks, or runs, which one is untouched; and samples of which a tenth tells something, and can be missed:
of 560 with a load on the horn the rest no longer tells the load."""
_HOLE_PERIODS, _SHORTEST_HOLE_S = 4.0, 0.1
"""A hole is longer than so many periods, and than so many seconds."""
_TIME_CONSTANTS = 12.0
"""Time constants of the slowest pole after which a servo has forgotten where it was."""
_BETWEEN_RUNS_S = 1.0
"""Runs are laid one after the other for pictures and words; nothing is simulated across."""
_SOME_RUNS, _STEPS_OF_ZERO = 3, 1.5
"""Runs from which on a common zero is no chance, and how many converter steps their beginnings may be from it."""
FEW_RUNS = 6
"""Of fewer, half move as the others never do, and to fit those alone leads astray: of four with an XL330 of low gain,
the three slower ones are then predicted to 3.1 to 3.5 deg, and to 1.0 to 1.6 deg if blocks of all four are fitted."""
_PART_S, _SETTLED_S, _FEW_PARTS = 18.0, 0.3, 8
"""Enough for a dozen manoeuvres, and runs enough, to tell which effects come into question."""
_ENOUGH, _FASTEST_HZ = 6000, 100.0
"""Samples that are fitted, and the rate below which none is left out."""
_FEW_NEW = 0.25
"""Share of new commands from which on it takes no less time to leave the others out."""
_PER_SAMPLE = ("time_s", "measured_deg", "counts", "block", "fold")
"""What a record has of each sample."""
_FARTHEST_DEG = 1e6
"""As wrong as a servo can be: squares of more could not be summed up."""


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One surface over one log."""

    model: ServoModel
    """As the servo is known."""
    commands: Commands
    """As they leave for the servo; the delay comes on top."""
    time_s: FloatArray
    """Of the positions, shape (n,) as all that follow."""
    measured_deg: FloatArray
    """NaN where it was not measured."""
    counts: BoolArray
    """Samples that are compared."""
    block: IntArray
    """Number of the block that each sample lies in."""
    fold: IntArray
    """Which of the three folds each sample lies in: 0 and 1, each predicted from the other, and 2, which no search
    looks at."""
    logged: Mapping[str, FloatArray] = field(default_factory=dict)
    """What was logged beside it, by its column; under `airspeed_m_s` stands the dynamic pressure [Pa]."""
    pushed: Context | None = None
    """Load that was logged on the shaft."""
    step_deg: float | None = None
    """Of the converter whose whole multiples the positions are."""
    runs: tuple[Record, ...] = ()
    """Separate experiments with one servo that this record is the sequence of; none if it is one itself."""
    known: Known = A_TYPE
    """What is known of the servo's own numbers."""
    side: FloatArray | None = None
    """On which side of its play the surface rests: 1 or -1, 0 where it has none. Only of a record that is too slow to
    show more than where it rests."""
    conditions: tuple[float, ...] = ()
    """Of this run, each from -1 to 1 over all runs."""
    condition_names: tuple[str, ...] = ()

    @property
    def run(self) -> IntArray:
        """Number of the run that each sample belongs to."""
        sizes = [each.time_s.size for each in self.runs] or [self.time_s.size]
        return np.repeat(np.arange(len(sizes)), sizes)

    @property
    def period_s(self) -> float:
        """Median step [s]."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def untouched(self) -> BoolArray:
        """Samples that no search looks at; none of a record that is too short, or at rest."""
        enough = self.side is None and int(self.counts.sum()) >= _FEWEST_FOR_THREE
        untouched: BoolArray = self.counts & (self.fold == 2) & enough
        return untouched

    @property
    def searched(self) -> Record:
        """The same record, of which only the samples count that a search may look at."""
        return replace(self, counts=self.counts & ~self.untouched)


def record_of(segment: Series, model: ServoModel, *, at_rest: bool = False, known: Known = A_TYPE) -> Record:
    """Prepare a segment for comparison."""
    segment = segment.at(~segment.repeats)
    time_s, measured_deg = segment.measured_s, segment.measured_deg
    hole_s = max(_HOLE_PERIODS * segment.period_s, _SHORTEST_HOLE_S)
    seen = np.isfinite(measured_deg)
    slowest = float(np.abs(model.transfer.poles_rad_s.real).min())
    start_s = min(FORGETS_S, _TIME_CONSTANTS / slowest) + model.delay_s
    starts_s = [-np.inf] if at_rest else [time_s[seen][0], segment.command_s[0]]
    # Where only positions are missing, what was asked is known: the servo went on as its model does.
    starts_s += segment.command_s[1:][np.diff(segment.command_s) > hole_s].tolist()
    off = segment.why == Why.TORQUE_OFF
    starts_s += time_s[1:][off[:-1] & ~off[1:]].tolist()
    begin = np.sort(np.array(starts_s))
    counts = seen & (time_s - latest(begin, begin, time_s) >= start_s) & _has_command(segment.command_s, hole_s, time_s)
    if not at_rest:
        counts &= segment.counts
    if segment.command_period_s is None:
        counts &= ~after_lost_commands(segment.command_s, segment.command_deg, hole_s, time_s)
    # Fewer commands than the servo received: they run straight between, later by the mean lag of the hold.
    commands = commands_at_servo(segment, hole_s)
    block = ((time_s - time_s[0]) / BLOCK_S).astype(np.int64)
    fold = np.where(block % _CYCLE == _ASIDE, 2, block % 2)
    context = segment.context
    columns = {"airspeed_m_s": context.pressure_pa, "servo_voltage_v": context.supply_v}
    columns |= {"servo_current_a": context.drawn_a, "servo_temperature_c": context.warmth_c}
    logged = {name: values(time_s) for name, values in columns.items() if name in context.logged}
    pushed = Context(load_s=context.load_s, load=context.load) if np.ptp(context.pushed(time_s)) > 0.0 else None
    return Record(
        model.explainable(),
        commands,
        time_s,
        measured_deg,
        counts,
        block,
        fold,
        logged,
        pushed,
        comb_step_deg(measured_deg),
        known=known,
    )


def _has_command(command_s: FloatArray, hole_s: float, time_s: FloatArray) -> BoolArray:
    """Samples at which the last command is known, shape (n,): it holds for a period where a hole follows."""
    step_s = np.append(np.diff(command_s), 0.0)
    holds_s = np.where(step_s > hole_s, min(hole_s, float(np.median(step_s))), hole_s)
    last = np.searchsorted(command_s, time_s, side="right") - 1
    return (last >= 0) & (time_s - command_s[last] <= holds_s[last])


def joined(records: Sequence[Record]) -> Record:
    """Several runs of one servo as one record, each from its own rest.

    Of many, whole ones are the folds; of a few, blocks of each, as in a single one.
    """
    if len(records) == 1:
        return records[0]
    runs, later_s, count = [], 0.0, 0
    for k, each in enumerate(records):
        shift_s = later_s - float(each.time_s[0])
        moved = each.commands._replace(effective_s=each.commands.effective_s + shift_s)
        load = each.pushed and replace(each.pushed, load_s=each.pushed.load_s + shift_s)
        own = 2 if k % _CYCLE == _ASIDE else (k - (k + _CYCLE - _ASIDE) // _CYCLE) % 2
        fold = np.full_like(each.fold, own) if len(records) >= FEW_RUNS else each.fold
        there: dict[str, Any] = {"time_s": each.time_s + shift_s, "block": each.block + count, "fold": fold}
        runs.append(replace(each, commands=moved, pushed=load, **there))
        count += int(each.block[-1]) + 1
        later_s = float(runs[-1].time_s[-1]) + _BETWEEN_RUNS_S
    every: dict[str, Any] = {name: np.concatenate([getattr(each, name) for each in runs]) for name in _PER_SAMPLE}
    in_all = [name for name in runs[0].logged if all(name in each.logged for each in runs)]
    sides = [each.side for each in runs if each.side is not None]
    # Where no load was logged, nothing pushed.
    pushed = [each.pushed for each in runs if each.pushed is not None]
    loads = {name: np.concatenate([getattr(each, name) for each in pushed]) for name in ("load_s", "load") if pushed}
    return replace(
        records[0],
        commands=Commands(*map(np.concatenate, zip(*(each.commands for each in runs), strict=True))),
        **every,
        logged={name: np.concatenate([each.logged[name] for each in runs]) for name in in_all},
        side=np.concatenate(sides) if len(sides) == len(runs) else None,
        pushed=Context(**loads) if pushed else None,
        step_deg=comb_step_deg(np.concatenate([each.measured_deg for each in runs])),
        runs=tuple(runs),
        conditions=(),
    )


def thinned(record: Record) -> Record:
    """The record with no more samples than tell its servo: of samples that come very fast, one in several.

    Where most commands repeat the one before, those are left out: a servo holds its command.
    """
    first, kept, total = 0, [], record.time_s.size
    if np.mean(_is_new(record.commands)) < _FEW_NEW:
        record = replace(
            record,
            commands=_without_repeats(record.commands),
            runs=tuple(replace(run, commands=_without_repeats(run.commands)) for run in record.runs),
        )
    for run in record.runs or (record,):
        stride = min(-(-total // _ENOUGH), max(round(1.0 / (run.period_s * _FASTEST_HZ)), 1))
        kept.append(np.arange(first, first + run.time_s.size, stride))
        first += run.time_s.size
    where = np.concatenate(kept)
    return record if where.size == total else only(record, where)


def _is_new(commands: Commands) -> BoolArray:
    """Which commands change something; the last counts as one, for pulse frames run on to it."""
    deg, slope = commands.command_deg, commands.slope_deg_s
    new = np.ones(deg.size, dtype=np.bool_)
    new[1:-1] = (deg[1:-1] != deg[:-2]) | (slope[1:-1] != 0.0) | (slope[:-2] != 0.0)
    return new


def _without_repeats(commands: Commands) -> Commands:
    new = _is_new(commands)
    return Commands(*(each[new] for each in commands))


def liveliest(record: Record, error_deg: FloatArray) -> Record:
    """The stretch of a record in which a simulation is most wrong; all of a short one; of many runs the most wrong."""
    if record.runs:
        if len(record.runs) <= _FEW_PARTS:
            return record
        energy = np.bincount(
            record.run[record.counts], weights=error_deg[record.counts] ** 2, minlength=len(record.runs)
        )
        chosen = np.argsort(-energy)[:: -(-len(record.runs) // _FEW_PARTS)]
        return only(record, np.flatnonzero(np.isin(record.run, chosen)))
    if record.time_s[-1] - record.time_s[0] < 1.5 * _PART_S:
        return record
    second = (record.time_s - record.time_s[0]).astype(np.int64)
    energy = np.bincount(second, weights=np.where(record.counts, np.nan_to_num(error_deg) ** 2, 0.0))
    sums = np.concatenate([[0.0], np.cumsum(energy)])
    length = round(_PART_S)
    first = int(np.argmax(sums[length:] - sums[:-length]))
    part = only(record, np.flatnonzero((second >= first) & (second < first + length)))
    return replace(part, counts=part.counts & (part.time_s >= part.time_s[0] + _SETTLED_S))


def only(record: Record, where: IntArray) -> Record:
    """Some of the samples of a record, and what of its runs they are."""
    run = record.run[where]
    first = np.cumsum([0, *(each.time_s.size for each in record.runs)])
    runs = tuple(only(each, where[run == k] - first[k]) for k, each in enumerate(record.runs) if np.any(run == k))
    there: dict[str, Any] = {name: getattr(record, name)[where] for name in _PER_SAMPLE}
    logged = {name: values[where] for name, values in record.logged.items()}
    side = None if record.side is None else record.side[where]
    return replace(record, **there, logged=logged, side=side, runs=runs)


def per_second(record: Record, error_deg: FloatArray) -> tuple[IntArray, FloatArray]:
    """Of each second of a record: how many samples count, and their summed squared error [deg^2]."""
    second = (record.time_s - float(record.time_s[0])).astype(np.int64)[record.counts]
    energy: FloatArray = np.bincount(second, weights=error_deg[record.counts] ** 2).astype(np.float64)
    return np.bincount(second).astype(np.int64), energy


def simulate(record: Record, physics: Physics, finer: float = 1.0) -> FloatArray:
    """Position that a servo with these effects would show [deg], shape (n,).

    `finer` divides the steps that are taken where something switches.
    """
    if any(each.side is not None for each in record.runs):
        return np.concatenate([simulate(each, at_run(physics, each.conditions), finer) for each in record.runs])
    loose_deg = physics.loose_deg
    if record.side is not None:
        # What pulls the surface is not logged; that it lies at one end of its play is seen.
        tight = physics._replace(**dict.fromkeys(loose_shares(), 0.0))
        return simulate(replace(record, side=None), tight, finer) + loose_deg * record.side
    if not record.runs or physics.run_slope == 0.0:
        return _moved(record, at_run(physics, record.conditions), finer)
    moved_deg = np.empty(record.time_s.size)
    for where, alike in _by_condition(record):
        moved_deg[where] = _moved(alike, at_run(physics, alike.runs[0].conditions), finer)
    return moved_deg


@lru_cache(maxsize=64)
def _by_condition(record: Record) -> list[tuple[IntArray, Record]]:
    """Which samples are of runs under one condition, and those runs."""
    conditions = [each.conditions for each in record.runs]
    of_sample = np.array([conditions.index(each) for each in conditions])[record.run]
    return [(where, only(record, where)) for k in np.unique(of_sample) for where in [np.flatnonzero(of_sample == k)]]


@lru_cache(maxsize=256)
def _starts(record: Record) -> tuple[IntArray, BoolArray, FloatArray]:
    """Of each run: its first sample, shape (r,), the same as a mask (n,), and its first measured position [deg]."""
    runs = record.runs or (record,)
    first = np.cumsum([0, *(each.time_s.size for each in runs[:-1])])
    anew = np.zeros(record.time_s.size, dtype=bool)
    anew[first] = True
    start_deg = np.zeros(first.size)
    for k, each in enumerate(runs):
        known = np.flatnonzero(np.isfinite(each.measured_deg))
        start_deg[k] = each.measured_deg[known[0]] if known.size else 0.0
    return first, anew, start_deg


def _moved_from(record: Record, physics: Physics, finer: float, start_deg: FloatArray) -> FloatArray:
    """Positions of each run from rest at a place (r,) [deg]; all runs are one journey of the stepper, shape (n,)."""
    first, anew, _ = _starts(record)
    machine = machine_of(record.model.transfer, (physics,), finer)
    measured_deg = np.empty(record.time_s.size)
    measured_deg[first] = start_deg
    # What holds a servo until its first command comes can only have been an earlier one; the run before sent none.
    held_deg = (start_deg - physics.bias_deg) / physics.gain / machine.loops[0].gain
    pieces: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    begin_s = record.time_s[first].tolist()
    for each, held, from_s, until_s in zip(
        record.runs or (record,), held_deg.tolist(), begin_s, [*begin_s[1:], np.inf], strict=True
    ):
        effective_s, command_deg, slope_deg_s = received(physics, each.commands)
        pieces.append((np.array([from_s]), np.array([held]), np.zeros(1)))
        pieces.append((np.minimum(effective_s, until_s), command_deg, slope_deg_s))
    moved_deg = machine.run(
        machine.new_state(), Commands(*map(np.concatenate, zip(*pieces, strict=True))), record.time_s,
        anew=anew, measured_deg=measured_deg,
        around=_around(record, physics.load_late_s) if physics.needs else NOTHING_AROUND,
    )[0][:, 0]  # fmt: skip
    # A load that pushes harder the further it has pushed runs away from a motor at its limit.
    return np.fmax(np.fmin(moved_deg, _FARTHEST_DEG), -_FARTHEST_DEG)


@lru_cache(maxsize=256)
def _around(record: Record, late_s: float) -> FloatArray:
    """What was logged beside the servo, as the stepper takes it."""
    if record.runs:
        return np.concatenate([_around(each, late_s) for each in record.runs])
    return around_servo(
        record.time_s.size,
        pressure_pa=record.logged.get("airspeed_m_s", 0.0),
        supply_v=record.logged.get("servo_voltage_v", np.inf),
        current_a=record.logged.get("servo_current_a", 0.0),
        load=0.0 if record.pushed is None else record.pushed.pushed(record.time_s, late_s),
    )


def _moved(record: Record, physics: Physics, finer: float) -> FloatArray:
    """Positions of each run from rest where it was first measured [deg].

    Where all runs begin at zero, readings are counted from where the servo lay within its dead band. That is not
    logged. Once the servo has moved, it only shifts the readings: by what agrees best, in the runs that are held out
    as well.
    """
    first, _, start_deg = _starts(record)
    moved_deg = _moved_from(record, physics, finer, start_deg)
    zero_deg = _STEPS_OF_ZERO * (record.step_deg or 0.0)
    is_zeroed = all(abs(float(each.measured_deg[0])) <= zero_deg for each in record.runs)
    if physics.loose_deg == 0.0 or len(record.runs) < _SOME_RUNS or not is_zeroed:
        return moved_deg
    counts = np.concatenate([each.counts for each in record.runs])
    run, shift_deg = record.run, np.zeros(first.size)
    left = (np.abs(moved_deg - start_deg[run]) > _MOVED_DEG).astype(np.int64)
    ever = np.cumsum(left)
    there = counts & (ever > (ever[first] - left[first])[run])
    count = np.bincount(run[there], minlength=first.size)
    off_deg = np.bincount(run[there], weights=(moved_deg - record.measured_deg)[there], minlength=first.size)
    np.divide(off_deg, count, out=shift_deg, where=count > 0)
    lay_deg = np.clip(shift_deg, -physics.loose_deg, physics.loose_deg)
    if not lay_deg.any():
        return moved_deg
    return _moved_from(record, physics, finer, start_deg + lay_deg) - lay_deg[run]


_MOVED_DEG = 1e-3
"""By which a simulated servo has left its place [deg]: more than rounding."""
_OFF_COMB, _FEWEST_VALUES = 0.1, 3
"""Share of a step by which readings may be off the steps of a converter, and how many different ones there must
be."""
_NO_CHANCE = 20.0
"""How many times as far apart as by chance the two closest of many values must be."""


def comb_step_deg(values_deg: FloatArray) -> float | None:
    """Step of the converter that made some values [deg], wherever its zero is; None if they lie on no comb."""
    known = values_deg[np.isfinite(values_deg)]
    unique = np.unique(np.round(known, 6))
    if not _FEWEST_VALUES <= unique.size <= known.size / 2:
        return None
    apart = np.diff(unique)
    # Files round each value; most of the smallest differences are one step all the same.
    step_deg = float(np.median(apart[apart < 1.5 * apart.min()]))
    # Of n values without a converter the two closest are the n-th part of the mean distance apart.
    if unique.size > known.size / 4 and step_deg < _NO_CHANCE * (unique[-1] - unique[0]) / unique.size**2:
        return None
    # Gaps are rounded by the file; numbered one after the other, all values together are not.
    tooth = np.concatenate([[0.0], np.cumsum(np.round(apart / step_deg))])
    tooth -= tooth.mean()
    step_deg = float(unique @ tooth / (tooth @ tooth))
    off = np.abs(unique - unique.mean() - tooth * step_deg).max()
    return round(step_deg, 6) if off < _OFF_COMB * step_deg else None
