"""The whole way from a segment to a named effect: check, locate, select, conclude."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from servofd.aircraft.series import Series
from servofd.core.series import rms
from servofd.core.statistics import Z_95
from servofd.core.types import BoolArray, FloatArray
from servofd.discrepancy.fit import Fit, Fitter
from servofd.discrepancy.known import A_TYPE, Known
from servofd.discrepancy.locate import Block, Oscillation, blocks, oscillation, sentences
from servofd.discrepancy.noise import at_rest, noise_floor_deg, rest_sentence
from servofd.discrepancy.record import Record, joined, per_second, record_of, simulate
from servofd.discrepancy.search import STEPS_OF_TWO_SIZES, step_size_deg
from servofd.discrepancy.select import Selection, select
from servofd.discrepancy.separate import Separation, separations
from servofd.discrepancy.validity import Undriven, check, clear_of, driven, share_followed
from servofd.discrepancy.varying import Varying
from servofd.servo.catalogue import effects_named, is_law, plain, told_apart
from servofd.servo.effect import Effect
from servofd.servo.loop import AFTER, BEFORE, scaled, split
from servofd.servo.physics import Physics
from servofd.servo.registry import is_built_in
from servofd.servo.servo_model import ServoModel

_HEALTHY_S = 3.0
"""Seconds at the beginning in which no fault is looked for."""
_RATIO = 3.0
"""How many times as large the variance of the error must become for a fault."""
_BEYOND = 6.0
"""A sample this many noise floors away is no noise: one in a billion."""


def fault_start_s(record: Record, selection: Selection) -> float | None:
    """Where the error of the nominal servo grows [s]; None if it does nowhere.

    The split into two stretches of constant variance that is most likely for Gaussian errors, taken second by second,
    of those after which it is larger: a jam that passes leaves a servo that is well behind it, too.
    """
    error = selection.nominal.error_deg
    start_s, (count, energy) = float(record.time_s[0]), per_second(record, error)
    sums, counts = np.cumsum(energy), np.cumsum(count)
    edge = np.arange(int(_HEALTHY_S) - 1, sums.size - 2)
    if not edge.size:
        return None
    floor = selection.sigma_deg**2
    before = np.maximum(sums[edge] / np.maximum(counts[edge], 1.0), floor)
    after = np.maximum((sums[-1] - sums[edge]) / np.maximum(counts[-1] - counts[edge], 1.0), floor)
    likely = counts[edge] * np.log(before) + (counts[-1] - counts[edge]) * np.log(after)
    grows = after >= _RATIO * before
    if not grows.any():
        return None
    best = int(np.argmin(np.where(grows, likely, np.inf)))
    from_s = start_s + float(edge[best]) - 1.0
    limit = _BEYOND * float(np.sqrt(before[best]))
    late = record.counts & (record.time_s >= from_s) & (np.abs(error) > limit)
    return float(record.time_s[late][0]) if late.any() else start_s + float(edge[best]) + 1.0


_MOST_FOLDS = 8
"""Runs that are held out at the same time, where there are many."""


class RunErrors(NamedTuple):
    """Error of one run, by models that were fitted to other runs."""

    run: int
    nominal_rms_deg: float
    held_out_rms_deg: float


def run_errors(record: Record, fitter: Fitter, final: Fit) -> tuple[RunErrors, ...]:
    """Fit the servo with its effects again without each run, and judge that run; empty for a single run."""
    if not record.runs:
        return ()
    left_out = [fitter.record.run % _MOST_FOLDS == k for k in range(min(len(record.runs), _MOST_FOLDS))]
    before, after = (fitter.without(fit, left_out) for fit in (fitter.nominal(), final))
    return tuple(
        RunErrors(
            k, *(rms(fits[k % _MOST_FOLDS].error_deg[(record.run == k) & record.counts]) for fits in (before, after))
        )
        for k in range(len(record.runs))
    )


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """Errors on a flight to which nothing was fitted [deg]."""

    path: str
    nominal_rms_deg: float
    extended_rms_deg: float
    noise_floor_rms_deg: float


def judged_elsewhere(path: str, segment: Series, model: ServoModel, physics: Physics) -> Elsewhere:
    """Errors of the servo as it was known, and with the effects that were found in another flight."""
    record = record_of(segment, model)
    before, after = (record.measured_deg - simulate(record, each) for each in (record.model.physics, physics))
    floor_deg = noise_floor_deg(record, after)
    before_deg, after_deg = rms(before[record.counts]), rms(after[record.counts])
    return Elsewhere(path, before_deg, after_deg, min(floor_deg, after_deg))


Conclusion = Literal["nothing_missing", "explained", "partly_explained", "unexplained"]

_MUCH_WORSE, _NO_NOISE = 4.0, 5.5
"""How many times the variance of the noise, or of the part before, a fault leaves; and how many usual errors from the
model no noise is."""
_SLOWLY_WORSE = 2.0
"""Times the variance of the healthy part, up to the first sample that is no noise: a drift, which has no beginning."""
_SOON_S = 15.0
"""Time after a change in which an unknown servo must have stopped to follow its command."""
_STILL_FOLLOWS = 0.2
"""Share of the position that the command tells, above which an unknown servo still follows it."""
_MARGINS_S = (0.0, 1.0, 2.5, 5.0)
"""How long before a change of the error's size a fault may have begun without much to do."""
_FEWEST_SAMPLES = 100
"""Samples that a part of a record needs to be fitted alone."""
_WORTH_SAVING = 0.9
"""A model that leaves more of the error than this is no better."""
_SAME_POLE = 1e-4
"""Relative difference of a pole from itself after its polynomial was multiplied out and split again."""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Why a servo and its model disagree."""

    surface: str
    model: ServoModel
    """The servo as it was known."""
    record: Record
    selection: Selection
    where: tuple[str, ...]
    notes: tuple[str, ...]
    fault_s: float | None = None
    """When a fault sets in, which is none of the model's business [s]."""
    separating: tuple[Separation, ...] = ()
    """What would tell effects apart that these data do not."""
    also: tuple[Elsewhere, ...] = ()
    """How the model does on other flights, to which nothing was fitted."""
    runs: tuple[RunErrors, ...] = ()
    """Each of several runs as the others predict it."""
    undriven: tuple[Undriven, ...] = ()
    """Where it was not driven, which was left out."""
    varying: tuple[Varying, ...] = ()
    """Values that go with a condition of the runs."""
    oscillation: Oscillation | None = None
    """What most of the rest is."""

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Every second of the log: how large the gap is there, and whether that is more than noise."""
        return blocks(self.record, self.selection.nominal.error_deg, self.selection.sigma_deg)

    @property
    def conclusion(self) -> Conclusion:
        """The conclusion in a word."""
        # How what only rests moves is not judged, and a fault is no effect.
        left = bool(self.selection.adequacy.reasons) or self.record.side is not None or self.fault_s is not None
        if self.selection.steps:
            return "partly_explained" if left else "explained"
        return "unexplained" if left else "nothing_missing"

    @property
    def answer(self) -> str:
        """The answer in a few sentences: what it is, how much, whether that is a fault, and what to do next."""
        (before, after), reasons, steps = self.held_out_deg, self.selection.adequacy.reasons, self.selection.steps
        parts = []
        if self.fault_s is not None:
            parts.append(f"FAULT from {self.fault_s:.1f} s on: the servo no longer does what its command asks")
        elif self.undriven:
            parts.append("The servo was not driven for part of the record (times below); that part was left out")
        if self.oscillation is not None:
            parts.append(self.oscillation.sentence)
        if not steps and not reasons:
            text = "Nothing is missing" if self.fault_s is None else "Before that, nothing is missing"
            parts.append(f"{text}: what is left is noise of {self.selection.sigma_deg:.3g} deg")
        elif not steps:
            lacks = "and no effect that is known accounts for it"
            parts.append(f"Unexplained: the model is wrong by {after:.3g} deg, {lacks}")
            if not self.has_fault:
                parts.append("That alone is no sign of a fault")
        else:
            mostly = self.is_mostly_left
            named = [_named(self, k, judged=not mostly) for k in range(len(steps))]
            if mostly:
                parts.append(f"Mostly unexplained: {after:.3g} of {before:.3g} deg remain on data not fitted")
                parts.append(f"A part of it looks like {' and '.join(named)}")
            else:
                parts += [each[:1].upper() + each[1:] for each in named]
                parts.append(f"With this the error falls from {before:.3g} to {after:.3g} deg on data not fitted")
                parts += [f"Not all is explained: {reason}" for reason in reasons[:1]]
        advice = _advice(self)
        return ". ".join(parts) + (f". Next: {'; '.join(advice)}." if advice else ".")

    @property
    def has_fault(self) -> bool:
        """Whether a fault sets in, or the answer calls an effect more than a sound servo has."""
        worn = not (self.record.known.starts or self.is_mostly_left) and bool(_beyond_sound(self))
        return self.fault_s is not None or worn or self.oscillation is not None

    @property
    def is_mostly_left(self) -> bool:
        """Whether the names account for less than half of what was wrong."""
        before, after = self.held_out_deg
        return bool(self.selection.adequacy.reasons) and after**2 > _MOSTLY * before**2

    @property
    def held_out_deg(self) -> tuple[float, float]:
        """Error on data that were not fitted, of the servo as it was known and with everything that was found [deg]."""
        return float(np.sqrt(self.selection.nominal.held_out)), float(np.sqrt(self.selection.final.held_out))

    @property
    def physics(self) -> Physics:
        """The servo with everything that was found."""
        return self.selection.final.physics

    @property
    def is_own_fit(self) -> bool:
        """Whether the servo was fitted to the log, and nothing in it contradicts the fit."""
        return bool(self.record.known.starts) and self.conclusion != "unexplained"

    @property
    def not_saved(self) -> str:
        """Why no effect of it is written to a file; empty if all are."""
        effects = self.selection.final.effects
        if self.record.side is not None:
            return "the log shows only where it rests, not how it moves"
        if not effects:
            return "no effect was found, so there is no better model"
        own = [effect.name for effect in effects if not is_built_in(plain(effect))]
        if own:
            return f"{', '.join(own)} comes from a file of your own, which an audit does not run"
        by_run = [effect.spoken for effect in effects if is_law(effect)]
        if by_run:
            condition = self.record.condition_names[int(self.physics.run_condition)]
            return f"{by_run[0]} changes with {condition}, which a file cannot hold: explain runs of one {condition}"
        before, after = self.held_out_deg
        # Where the servo itself was fitted to the log, it has taken up most of what the effects would explain.
        if after > (1.0 if self.is_own_fit else _WORTH_SAVING) * before:
            return f"{after:.3g} of {before:.3g} deg rms would stay"
        return ""

    @property
    def is_servo_of_its_own(self) -> bool:
        """Whether the poles that were found make a servo whose slow pole is the one that was fitted as such.

        Of three real poles the slowest is taken for it: where the fit has another, the servo is that which the search
        began with, and how its poles differ.
        """
        model = self.record.model
        if not (self.record.known.starts and model.has_places):
            return bool(self.record.known.starts)
        known, _ = split(np.array(model.transfer.denominator) / model.transfer.denominator[0])
        there = np.array(scaled(model.transfer, self.physics.scales).denominator)
        slow_rad_s = known * self.physics.slow_scale
        return bool(np.isclose(split(there / there[0])[0], slow_rad_s, rtol=_SAME_POLE))

    def rms_deg(self, fit: Fit) -> dict[str, Any]:
        """Error of a fit [deg]: fitted, each of two folds predicted from the other, and on the fold no search used.

        The last is None if there is no such fold.
        """
        untouched = self.record.untouched
        return {
            "train_rms_deg": float(np.sqrt(fit.train)),
            "held_out_rms_deg": float(np.sqrt(fit.held_out)),
            "untouched_rms_deg": rms(fit.error_deg[untouched]) if untouched.any() else None,
        }

    def step_errors(self, index: int) -> dict[str, Any]:
        """Errors of a step [deg], and whether that on the untouched fold falls as well."""
        fits = self.selection.nominal, *(step.fit for step in self.selection.steps)
        before, after = map(self.rms_deg, fits[index : index + 2])
        there, here = before["untouched_rms_deg"], after["untouched_rms_deg"]
        return {**after, "confirmed": None if here is None else here < there}

    def document(self) -> dict[str, Any]:
        """Plain dictionaries and lists, schema servofd.explain/1."""
        selection = self.selection
        final = selection.final
        return {
            "schema": "servofd.explain/1",
            "surface": self.surface,
            "conclusion": self.conclusion,
            "noise_floor_rms_deg": selection.sigma_deg,
            "nominal": self.rms_deg(selection.nominal),
            "where": list(self.where),
            "bad_seconds": [block.start_s for block in self.blocks if block.bad],
            "steps": [
                {
                    "effect": step.fit.names[-1],
                    "form": _form_of(step.fit.effects[-1], step.fit.place),
                    "parameters": _effect_values(selection, len(step.fit.effects) - 1),
                    **self.step_errors(k),
                    "rivals": [
                        {"effect": rival.names[-1], "held_out_rms_deg": float(np.sqrt(rival.held_out))}
                        for rival in step.rivals
                    ],
                }
                for k, step in enumerate(selection.steps)
            ],
            "indistinguishable": [list(tie) for tie in selection.ties],
            "separating": [each.document() for each in self.separating],
            "final": {
                **self.rms_deg(final),
                "model": {
                    effect.name: {name: each["value"] for name, each in _effect_values(selection, k).items()}
                    for k, effect in enumerate(final.effects)
                },
            },
            "also": [asdict(each) for each in self.also],
            "notes": list(self.notes),
            "fault_s": self.fault_s,
            "not_driven": [asdict(each) for each in self.undriven],
            "answer": self.answer,
            "not_saved": self.not_saved or None,
            "runs": [each._asdict() for each in self.runs],
            "varying": [each.document() for each in self.varying],
            "oscillation": self.oscillation and self.oscillation._asdict(),
            "simulations": selection.fitter.simulations,
        }


def explain_gap(
    segment: Series | Sequence[Series],
    model: ServoModel,
    *,
    on_bench: bool = False,
    known: Known = A_TYPE,
    off: Sequence[Undriven] = (),
    conditions: Mapping[str, FloatArray] | None = None,
    progress: Callable[[str], None] = lambda _step: None,
) -> Explanation:
    """Find where a servo and its model disagree, name what is missing, and show how the gap shrinks.

    Parameters
    ----------
    segment : Series or sequence of Series
        Commands and measurements of one surface; of several runs, every other one is held out whole. Effects that need
        what its context does not hold (airspeed, supply) cannot be judged, and the result says so.
    model : ServoModel
        The servo as it is known.
    on_bench : bool
        Whether each run begins at rest, so that all of it counts.
    known : Known
        What is known of the servo: that it is of the type of the model, or nothing, so that its poles are searched.
    off : sequence of Undriven
        Where the log itself says that the servo was not driven.
    conditions : mapping of str to ndarray, shape (r,), optional
        Of each run: a load, a supply, a temperature, with which the size of an effect may go.
    progress : callable
        Called with the name of each effect that was tried.

    Raises
    ------
    NoMeasurement
        If the segment cannot show what is missing; the message says why.
    DesignError
        If the model has more than three poles, or zeros.

    Examples
    --------
    >>> from servofd.servo.effects.commands import Delay
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> command = 5.0 * np.sin(0.5 * t**2)
    >>> known = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> noise = 0.1 * np.random.default_rng(0).standard_normal(t.size)
    >>> measured = (known + Delay(0.024)).simulate(t, command, t) + noise
    >>> found = explain_gap(Series("rudder", t, command, t, measured), known)
    >>> found.conclusion, found.selection.final.names
    ('explained', ('delay',))
    >>> round(float(found.selection.final.values[0]), 3)  # 4 ms were known
    0.024
    """
    segments = [segment] if isinstance(segment, Series) else list(segment)
    records = [record_of(each, model, at_rest=on_bench, known=known) for each in segments]
    apart = told_apart(conditions or {})
    records = [
        replace(each, conditions=tuple(float(of[k]) for of in apart.values()), condition_names=tuple(apart))
        for k, each in enumerate(records)
    ]
    check(joined([at_rest(each) for each in records]))
    record, stood, begun = driven_part(records)
    whole, undriven = record, [*off, *stood]
    selection = select(record, progress, begun)
    notes = [each.sentence(several=len(records) > 1) for each in undriven]
    notes += [
        f"run {k + 1} is too short: nothing of it counts" for k, each in enumerate(records) if each.counts.sum() == 0
    ]
    fault_s = undriven[0].start_s if len(records) == 1 and undriven and not off else None
    if fault_s is None and selection.adequacy.reasons and not (record.runs or record.side is not None):
        healthy = _healthy_part(record, selection, progress)
        if healthy is not None:
            record, selection, fault_s = healthy
            notes.append(
                f"after {fault_s:.1f} s this is a fault, not a missing effect: only what came before is explained"
            )
    notes += _notes(record, selection)
    is_left = fault_s is not None or bool(selection.adequacy.reasons)
    wave = oscillation(whole, selection.final.error_deg, selection.sigma_deg) if is_left and not record.runs else None
    where = sentences(record, selection.nominal.error_deg, selection.sigma_deg)
    errors = run_errors(record, selection.fitter, selection.final)
    found = Explanation(
        segments[0].surface,
        model,
        record,
        selection,
        tuple(where),
        tuple(notes),
        fault_s,
        # Manoeuvres are simulated, and how the servo moves must be known for that.
        () if record.side is not None else separations(selection),
        runs=errors,
        undriven=tuple(undriven),
        oscillation=wave,
    )
    unconfirmed = [step for k, step in enumerate(selection.steps) if found.step_errors(k)["confirmed"] is False]
    said = "is not confirmed: on a tenth of the log that was left out the error does not fall"
    return replace(found, notes=(*found.notes, *(f"{step.fit.names[-1]} {said}" for step in unconfirmed)))


def driven_part(records: Sequence[Record]) -> tuple[Record, list[Undriven], Fitter | None]:
    """Runs as one record in which only what was driven counts, where that was not so, and what has begun to fit it."""
    record = joined([at_rest(each) for each in records])
    if record.side is not None:
        return record, [], None
    fitter = Fitter(record.searched)
    kept, stood = driven(records, fitter.linear[0].physics)
    if not stood:
        return record, [], fitter
    # The servo had been fitted to what no servo does.
    clear = joined([at_rest(each) for each in clear_of(records, stood)])
    if int(clear.counts.sum()) >= _FEWEST_SAMPLES:
        again = driven(records, Fitter(clear).linear[0].physics)
        kept, stood = again if len(again[1]) >= len(stood) else (kept, stood)
    part = joined([at_rest(each) for each in kept])
    return (part, stood, None) if int(part.counts.sum()) >= _FEWEST_SAMPLES else (record, [], fitter)


def _notes(record: Record, selection: Selection) -> list[str]:
    """What else has to be known of an explanation."""
    notes = []
    if record.side is not None:
        notes.append(_only_rests_sentence(record))
    elif record.known.starts:
        notes.append(_linear_sentence(record, selection))
        if step_size_deg(record) is not None:
            alike = "all steps are of one size: a slow servo and one whose speed is limited look alike in them"
            notes.append(f"{alike}; {STEPS_OF_TWO_SIZES}, would tell")
    notes += [f"left over: {reason}" for reason in selection.adequacy.reasons]
    return [*notes, _unjudged_sentence(selection)] if selection.unjudged else notes


def _healthy_part(
    record: Record, selection: Selection, progress: Callable[[str], None]
) -> tuple[Record, Selection, float] | None:
    """What comes before a fault, its explanation, and when the fault begins [s]; None if there is no such part."""
    change_s = fault_start_s(record, selection)
    if change_s is None:
        return None
    for margin_s in _MARGINS_S:
        before = replace(record, counts=record.counts & (record.time_s < change_s - margin_s))
        if int(before.counts.sum()) < 2 * _FEWEST_SAMPLES:
            break
        later = record.counts & ~before.counts
        if record.known.starts and not _stands_out(before, later, selection.final):
            continue
        healthy = select(before, progress)
        if healthy.adequacy.reasons:
            continue
        error, usual_deg = healthy.final.error_deg, healthy.sigma_deg
        wrong = later & (np.abs(error) > _NO_NOISE * usual_deg)
        if not wrong.any():
            continue
        start_s = float(record.time_s[wrong][0])
        quiet = later & (record.time_s < start_s)
        slowly = bool(quiet.any()) and float(np.mean(error[quiet] ** 2)) > _SLOWLY_WORSE * usual_deg**2
        if not slowly and float(np.mean(error[later] ** 2)) > _MUCH_WORSE * usual_deg**2:
            # An unknown servo that is fitted to a part may be wrong elsewhere, without any fault: it still follows.
            there = later & (record.time_s >= start_s) & (record.time_s < start_s + _SOON_S)
            followed = share_followed(record, simulate(record, record.model.physics), there)
            if not (record.known.starts and followed > _STILL_FOLLOWS):
                return before, healthy, start_s
    return None


def _stands_out(before: Record, later: BoolArray, final: Fit) -> bool:
    """Whether a servo fitted to one part of a record is far worse on the other, or a search there is in vain."""
    fitter = Fitter(before)
    for fit in (fitter.descended(final.effects, final.physics), fitter.linear[0]):
        error_deg = fitter.judged(fit.effects, fit.physics).error_deg
        if np.mean(error_deg[later] ** 2) > _MUCH_WORSE * np.mean(error_deg[before.counts] ** 2):
            return True
    return False


_CONTEXT = {
    "airspeed_m_s": "airspeed (column airspeed_m_s)",
    "servo_voltage_v": "supply voltage (servo_voltage_v)",
    "servo_current_a": "current (servo_current_a)",
    "servo_load": "load (servo_load)",
}


def _effect_values(selection: Selection, index: int) -> dict[str, dict[str, float]]:
    """Parameters of one of the final effects, with 95 % intervals; infinite where the data do not show them."""
    final = selection.final
    first = sum(len(effect.parameters) for effect in final.effects[:index])
    result = {}
    for k, parameter in enumerate(final.effects[index].parameters, start=first):
        if parameter.aside:
            continue
        value, deviation = float(final.values[k]), float(np.sqrt(max(selection.covariance[k, k], 0.0)))
        if not np.isfinite(deviation):
            value = float("nan")
        result[parameter.name] = {
            "value": value,
            "low": max(value - Z_95 * deviation, parameter.low),
            "high": min(value + Z_95 * deviation, parameter.high),
        }
    return result


def _unjudged_sentence(selection: Selection) -> str:
    """Which effects cannot be judged, and what would have to be logged."""
    names = ", ".join(dict.fromkeys(effect.name for effect in selection.unjudged))
    if selection.fitter.record.side is not None:
        return f"cannot be judged: {names}; the log comes too slowly"
    needs = " and ".join(_CONTEXT[need] for need in dict.fromkeys(n for e in selection.unjudged for n in e.needs))
    return f"cannot be judged: {names}; the log holds no {needs}"


def _only_rests_sentence(record: Record) -> str:
    """What a slow log does not tell, and what it does."""
    rate_hz = min(1.0 / each.period_s for each in record.runs or (record,))
    return (
        f"position comes at {rate_hz:.3g} Hz: only rests are judged, and not how the surface moves, which takes "
        f"20 Hz; {rest_sentence(record)}, now at one end and now at the other, which is hysteresis"
    )


def _linear_sentence(record: Record, selection: Selection) -> str:
    """Which linear servo was fitted, as none was known."""
    said = []
    for fit in (selection.nominal, selection.final):
        transfer = scaled(record.model.transfer, fit.physics.scales)
        monic = np.array(transfer.denominator) / transfer.denominator[0]
        words = []
        if record.model.has_places:
            slow, pair = split(monic)
            monic = np.array([1.0, *pair])
            words.append(f"a pole at {slow:.3g} rad/s")
        natural = float(np.sqrt(monic[2]))
        words.insert(0, f"{natural / (2.0 * np.pi):.3g} Hz, damping ratio {monic[1] / (2.0 * natural):.2g}")
        said.append(" and ".join(words))
    return f"no servo was known: one was fitted, by itself {said[0]}; beside the effects {said[1]}"


def _form_of(effect: type[Effect], place: float) -> str | None:
    """Which machine an effect is, and on which side of the servo's slow pole it acts, where that matters."""
    where = {BEFORE: "behind the slow pole", AFTER: "ahead of the slow pole"}.get(place) if effect.places else None
    return "; ".join(filter(None, (effect.form, where))) or None


_UNITS = (("deg_s_per_v", " deg/s per V"), ("deg_s", " deg/s"), ("_deg", " deg"), ("_s", " s"), ("_hz", " Hz"))
_OTHER_WAY = {"rate_up_deg_s": ("rate_down_deg_s", " up", " down"), "lower_deg": ("upper_deg", " below", " above")}
"""Of what acts apart in either direction, the other size, and in which direction each acts."""
_MOSTLY = 0.5
"""Share of the mean square that, left over, is most of it."""
_ANOTHER = "compare it with a second servo of its kind"
_TELLING = "record steps of two sizes, a slow triangle and a sine of 3 Hz"


KEEP = "keep the model"
"""Advice where the model that was found may be used by an audit."""


def _advice(found: Explanation) -> list[str]:
    """What to do next."""
    steps, is_unknown, mostly = found.selection.steps, bool(found.record.known.starts), found.is_mostly_left
    beyond = [] if mostly else _beyond_sound(found)
    advice = [effect.advice for effect in beyond if effect.advice]
    if is_unknown and (beyond or (not steps and found.selection.adequacy.reasons)):
        advice.append(_ANOTHER)
    if found.fault_s is None and found.selection.adequacy.reasons and (not steps or mostly):
        advice.append(_TELLING)
    if found.separating and (manoeuvre := found.separating[0].manoeuvre):
        advice.append(f"record {manoeuvre}, which tells {' from '.join(found.separating[0].effects).replace('_', ' ')}")
    if not found.not_saved and found.fault_s is None and not mostly:
        advice.append(KEEP)
    return advice


def _named(found: Explanation, index: int, *, judged: bool) -> str:
    """One effect with its size, what it may be instead, and, if judged, whether a sound servo may have it."""
    effect = found.selection.final.effects[index]
    values = _effect_values(found.selection, index)
    name, value = next(iter(values.items()))
    unit = next((words for end, words in _UNITS if name.endswith(end)), "")
    law = next((each for each in found.varying if (each.effect, each.parameter) == (effect.name, name)), None)
    if law:
        (low, first), (high, last) = law.ends
        way = "falls" if last < first else "rises"
        size = f"{first:.3g}{unit} at {law.conditions[0]} {low:.3g} that {way} to {last:.3g}{unit} at {high:.3g}"
    else:
        other, *ways = _OTHER_WAY.get(name, ("", ""))
        each = [values[key] for key in (name, other) if key in values]
        sizes = [f"{one['value']:.3g}{unit} ({one['low']:.3g} to {one['high']:.3g})" for one in each]
        size = " and ".join(map("".join, zip(sizes, ways, strict=True)))
    ties = next((tie[1:] for tie in found.selection.ties if tie[0] == effect.name), ())
    instead = (
        f", or else {' or '.join(effects_named(n)[0].spoken for n in ties)} (the data cannot tell which)"
        if ties
        else ""
    )
    sound = ""
    limit = effect.sound
    if judged and limit is not None:
        if abs(value["value"]) <= limit:
            sound = f": acceptable, a sound hobby servo has up to {limit:g} deg"
        elif found.record.known.starts:  # an unknown servo may have been made so
            sound = f": more than the {limit:g} deg of a sound hobby servo, which may be how this one is made"
        else:
            sound = f": FAULT, a sound hobby servo has at most {limit:g} deg"
    return f"{effect.spoken} of {size}{instead}{sound}"


def _beyond_sound(found: Explanation) -> list[type[Effect]]:
    """Effects that are larger than a sound servo has them."""
    effects = found.selection.final.effects
    sizes = [next(iter(_effect_values(found.selection, k).values()))["value"] for k in range(len(effects))]
    limits = [math.inf if effect.sound is None else effect.sound for effect in effects]
    return [effect for effect, size, limit in zip(effects, sizes, limits, strict=True) if abs(size) > limit]
