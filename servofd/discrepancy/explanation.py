"""The whole way from a segment to a named effect: check, locate, select, conclude."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from servofd.aircraft.segment import Segment
from servofd.discrepancy.answer import Found, answer
from servofd.discrepancy.at_rest import at_rest
from servofd.discrepancy.audit_gain import AuditGain, audit_gain
from servofd.discrepancy.break_point import fault_start_s
from servofd.discrepancy.checks import check
from servofd.discrepancy.fit import Fitter
from servofd.discrepancy.locate import Block, blocks, sentences
from servofd.discrepancy.one_size import STEPS_OF_TWO_SIZES, step_size_deg
from servofd.discrepancy.record import joined, record_of, simulate
from servofd.discrepancy.run_by_run import RunErrors, run_errors
from servofd.discrepancy.select import Selection, select
from servofd.discrepancy.separate import Separation, separations
from servofd.discrepancy.validity import clear_of, driven, share_followed
from servofd.discrepancy.words import (
    effect_values,
    form_of,
    linear_sentence,
    only_rests_sentence,
    unjudged_sentence,
)
from servofd.servo.catalogue import CATALOGUE
from servofd.servo.effects import Extension
from servofd.servo.laws import plain, told_apart

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servofd.core.types import BoolArray, FloatArray
    from servofd.discrepancy.elsewhere import Elsewhere
    from servofd.discrepancy.fit import Fit
    from servofd.discrepancy.own import OwnEffect
    from servofd.discrepancy.record import Record
    from servofd.discrepancy.validity import Undriven
    from servofd.discrepancy.varying import Varying
    from servofd.servo.physics import Physics
    from servofd.servo.servo_model import ServoModel

Conclusion = Literal["nothing_missing", "explained", "partly_explained", "unexplained"]

_MUCH_WORSE, _NO_NOISE = 4.0, 5.5
_SLOWLY_WORSE = 2.0
"""Times the variance of the healthy part, up to the first sample that is no noise: a drift, which has no beginning."""
_AT_ONCE_S, _SOON_S, _FAR_WORSE, _NOT_BUSIER, _MOST_OF_IT = 5.0, 15.0, 25.0, 2.0, 0.25
"""Where the healthy part is not explained to the noise either, a fault must stand out from what stays of it: at once,
though no more is asked, or soon and nearly as large as the motion (variances). A gap that drifts, or grows with motion,
is no fault."""
_FOLLOWS = 0.2
"""Share of the position that the command tells, beyond which a servo that nobody knows still follows it."""
_MARGINS_S = (0.0, 1.0, 2.5, 5.0)
"""How long before a change of the error's size a fault may have begun without much to do."""
_FEWEST_SAMPLES = 100


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
    gain: AuditGain | None = None
    """What an audit gains by the better model; None if it cannot simulate it, or gains nothing."""
    also: tuple[Elsewhere, ...] = ()
    """How the model does on other flights, to which nothing was fitted."""
    runs: tuple[RunErrors, ...] = ()
    """Each of several runs as the others predict it."""
    undriven: tuple[Undriven, ...] = ()
    """Where it was not driven, which was left out."""
    varying: tuple[Varying, ...] = ()
    """Values that go with a condition of the runs."""

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Every second of the log: how large the gap is there, and whether that is more than noise."""
        return blocks(self.record, self.selection.nominal.error_deg, self.selection.sigma_deg)

    @property
    def conclusion(self) -> Conclusion:
        """In a word."""
        # How what only rests moves is not judged, and a fault is no effect.
        left = bool(self.selection.adequacy.reasons) or self.record.side is not None or self.fault_s is not None
        if self.selection.rungs:
            return "partly_explained" if left else "explained"
        return "unexplained" if left else "nothing_missing"

    @property
    def answer(self) -> str:
        """The answer in a sentence or two: what it is, how much, whether that is a fault, and what to do next."""
        before, after = (
            self.rms_deg(fit)["held_out_rms_deg"] for fit in (self.selection.nominal, self.selection.final)
        )
        return answer(
            Found(
                self.record,
                self.selection,
                before,
                after,
                self.fault_s,
                bool(self.undriven),
                self.separating,
                self.is_simulated_by_audit,
                self.varying,
            )
        )

    @property
    def physics(self) -> Physics:
        """The servo with everything that was found."""
        return self.selection.final.physics

    @property
    def is_simulated_by_audit(self) -> bool:
        """Whether an audit can run the servo as it was found: not if an effect of the user's own is part of it."""
        return all(plain(effect) in CATALOGUE for effect in self.selection.final.effects)

    @property
    def better_model(self) -> ServoModel:
        """The model with what was missing, for an audit."""
        return self.model + Extension(self.physics)

    def rms_deg(self, fit: Fit) -> dict[str, float]:
        """Error of a fit on the fitted and on the held-out samples [deg]."""
        return {
            "train_rms_deg": float(np.sqrt(fit.train / max(int(self.record.trained.sum()), 1))),
            "held_out_rms_deg": float(np.sqrt(fit.held_out / max(int(self.record.held_out.sum()), 1))),
        }

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
                    "effect": rung.fit.names[-1],
                    "form": form_of(rung.fit.effects[-1], rung.fit.place),
                    "parameters": effect_values(selection, len(rung.fit.effects) - 1),
                    **self.rms_deg(rung.fit),
                    "rivals": [
                        {"effect": rival.names[-1], "held_out_rms_deg": self.rms_deg(rival)["held_out_rms_deg"]}
                        for rival in rung.rivals
                    ],
                }
                for rung in selection.rungs
            ],
            "indistinguishable": [list(tie) for tie in selection.ties],
            "separating": [each.document() for each in self.separating],
            "final": {
                **self.rms_deg(final),
                "model": {
                    effect.name: {name: each["value"] for name, each in effect_values(selection, k).items()}
                    for k, effect in enumerate(final.effects)
                },
            },
            "audit": self.gain.document() if self.gain else None,
            "also": [each.document() for each in self.also],
            "notes": list(self.notes),
            "fault_s": self.fault_s,
            "not_driven": [each.document() for each in self.undriven],
            "answer": self.answer,
            "runs": [each._asdict() for each in self.runs],
            "varying": [each.document() for each in self.varying],
            "simulations": selection.simulations,
        }


def explain_gap(
    segment: Segment | Sequence[Segment],
    model: ServoModel,
    *,
    on_bench: bool = False,
    free_poles: bool = False,
    own: OwnEffect | None = None,
    off: Sequence[Undriven] = (),
    conditions: Mapping[str, FloatArray] | None = None,
    progress: Callable[[str], None] = lambda _step: None,
) -> Explanation:
    """Find where a servo and its model disagree, name what is missing, and show how the gap shrinks.

    Parameters
    ----------
    segment : Segment or sequence of Segment
        Commands and measurements of one surface; of several runs, every other one is held out whole. Effects that need
        what its context does not hold (airspeed, supply) cannot be judged, and the result says so.
    model : ServoModel
        The servo as it is known.
    on_bench : bool
        Whether each run begins at rest, so that all of it counts.
    free_poles : bool
        Whether the poles of the model are only where the search for them starts.
    own : OwnEffect, optional
        An effect of the user's own, tried beside those of the catalogue.
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
    >>> from servofd.servo.effects import Delay
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> command = 5.0 * np.sin(0.5 * t**2)
    >>> known = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> noise = 0.1 * np.random.default_rng(0).standard_normal(t.size)
    >>> measured = (known + Delay(0.02)).simulate(t, command, t) + noise
    >>> found = explain_gap(Segment("rudder", t, command, t, measured), known)
    >>> found.conclusion, found.selection.final.names
    ('explained', ('delay',))
    >>> round(float(found.selection.final.values[0]), 3)  # 4 ms were known
    0.024
    """
    segments = [segment] if isinstance(segment, Segment) else list(segment)
    records = [record_of(each, model, at_rest=on_bench, free_poles=free_poles, own=own) for each in segments]
    known = told_apart(conditions or {})
    records = [
        replace(each, conditions=tuple(float(of[k]) for of in known.values()), condition_names=tuple(known))
        for k, each in enumerate(records)
    ]
    check(joined([at_rest(each) for each in records]))
    record, stood = driven_part(records)
    undriven = [*off, *stood]
    selection = select(record, progress)
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
    where = sentences(record, selection.nominal.error_deg, selection.sigma_deg)
    errors = run_errors(selection.fitter, selection.final)
    found = Explanation(
        segments[0].surface,
        model,
        record,
        selection,
        tuple(where),
        tuple(notes),
        fault_s,
        runs=errors,
        undriven=tuple(undriven),
    )
    gain = None
    if selection.rungs and found.is_simulated_by_audit and record.side is None:
        before = model + Extension(selection.nominal.physics) if free_poles else model
        gain = audit_gain(segments, before, found.better_model, fault_s or float("inf"))
    # Manoeuvres are simulated, and how the servo moves must be known for that.
    return replace(found, separating=() if record.side is not None else separations(selection), gain=gain)


def driven_part(records: Sequence[Record]) -> tuple[Record, list[Undriven]]:
    """Runs as one record in which only what was driven counts, and where that was not so."""
    record = joined([at_rest(each) for each in records])
    if record.side is not None:
        return record, []
    kept, stood = driven(records, Fitter(record).linear().physics)
    if not stood:
        return record, []
    # The servo had been fitted to what no servo does.
    clear = joined([at_rest(each) for each in clear_of(records, stood)])
    if int(clear.counts.sum()) >= _FEWEST_SAMPLES:
        again = driven(records, Fitter(clear).linear().physics)
        kept, stood = again if len(again[1]) >= len(stood) else (kept, stood)
    part = joined([at_rest(each) for each in kept])
    return (part, stood) if int(part.counts.sum()) >= _FEWEST_SAMPLES else (record, [])


def _notes(record: Record, selection: Selection) -> list[str]:
    """What else has to be known of an explanation."""
    notes = []
    if record.side is not None:
        notes.append(only_rests_sentence(record))
    elif record.free_poles:
        notes.append(linear_sentence(record, selection))
        if step_size_deg(record) is not None:
            alike = "all steps are of one size: a slow servo and one whose speed is limited look alike in them"
            notes.append(f"{alike}; {STEPS_OF_TWO_SIZES}, would tell")
    notes += [f"left over: {reason}" for reason in selection.adequacy.reasons]
    return [*notes, unjudged_sentence(selection)] if selection.unjudged else notes


def _healthy_part(
    record: Record, selection: Selection, progress: Callable[[str], None]
) -> tuple[Record, Selection, float] | None:
    """What comes before a fault, its explanation, and when the fault begins [s]; None if there is no such part."""
    change_s = fault_start_s(record, selection)
    if change_s is None:
        return None
    rough = None  # taken if no margin leaves a part that is explained
    for margin_s in _MARGINS_S:
        before = replace(record, counts=record.counts & (record.time_s < change_s - margin_s))
        if int(before.held_out.sum()) < _FEWEST_SAMPLES:
            break
        later = record.counts & ~before.counts
        if record.free_poles and not _stands_out(before, later, selection.final):
            continue
        healthy = select(before, progress)
        error = healthy.final.error_deg
        explained = not healthy.adequacy.reasons
        usual_deg = healthy.sigma_deg if explained else float(np.sqrt(np.mean(error[before.counts] ** 2)))
        wrong = later & (np.abs(error) > _NO_NOISE * usual_deg)
        if not wrong.any():
            continue
        start_s = float(record.time_s[wrong][0])
        quiet = later & (record.time_s < start_s)
        slowly = bool(quiet.any()) and float(np.mean(error[quiet] ** 2)) > _SLOWLY_WORSE * usual_deg**2
        if explained and not slowly and float(np.mean(error[later] ** 2)) > _MUCH_WORSE * healthy.sigma_deg**2:
            # What is fitted to a part of a servo that nobody knows may be wrong elsewhere, and no fault for that.
            if record.free_poles and _follows(record, start_s):
                continue
            return before, healthy, start_s
        # Of a servo that nobody knows, what is left is the model's as likely as a fault's.
        may_break = rough is None and not explained and not record.free_poles
        if may_break and _breaks_off(record, error, before.counts, start_s, usual_deg):
            rough = before, healthy, start_s
    return rough


def _follows(record: Record, start_s: float) -> bool:
    """Whether a servo still moves with its command after a time."""
    there = record.counts & (record.time_s >= start_s) & (record.time_s < start_s + _SOON_S)
    return share_followed(record, simulate(record, record.plant.neutral), there) > _FOLLOWS


def _stands_out(before: Record, later: BoolArray, final: Fit) -> bool:
    """Whether a servo fitted to one part of a record is far worse on the other, or a search there is in vain."""
    fitter = Fitter(before)
    for fit in (fitter.descended(final.effects, final.physics), fitter.linear()):
        error_deg = fitter.judged(fit.effects, fit.physics).error_deg
        if np.mean(error_deg[later] ** 2) > _MUCH_WORSE * np.mean(error_deg[before.counts] ** 2):
            return True
    return False


def _breaks_off(record: Record, error_deg: FloatArray, before: BoolArray, start_s: float, usual_deg: float) -> bool:
    """Whether an error becomes far larger, and not because more is asked of the servo."""
    asked_deg = simulate(record, record.plant.neutral)
    usual = float(np.var(asked_deg[before]))
    for seconds, most in ((_AT_ONCE_S, _NOT_BUSIER * usual), (_SOON_S, 0.0)):
        there = record.counts & (record.time_s >= start_s) & (record.time_s < start_s + seconds)
        energy, asked = float(np.mean(error_deg[there] ** 2)), float(np.var(asked_deg[there]))
        if energy > _FAR_WORSE * usual_deg**2 and (asked < most or energy > _MOST_OF_IT * asked):
            return True
    return False
