"""The whole way from a segment to a named effect: check, locate, select, conclude."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from servofd.discrepancy.at_rest import at_rest
from servofd.discrepancy.audit_gain import AuditGain, audit_gain
from servofd.discrepancy.break_point import fault_start_s
from servofd.discrepancy.checks import check
from servofd.discrepancy.fit import Fitter
from servofd.discrepancy.locate import Block, blocks, sentences
from servofd.discrepancy.record import joined, record_of, simulate
from servofd.discrepancy.run_by_run import RunErrors, run_errors
from servofd.discrepancy.select import Selection, select
from servofd.discrepancy.separate import Separation, separations
from servofd.discrepancy.validity import clear_of, driven
from servofd.discrepancy.words import (
    effect_values,
    form_of,
    linear_sentence,
    only_rests_sentence,
    unjudged_sentence,
)
from servofd.models.catalogue import CATALOGUE
from servofd.models.effects import Extension
from servofd.models.laws import plain, told_apart
from servofd.segment import Segment

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servofd.discrepancy.elsewhere import Elsewhere
    from servofd.discrepancy.fit import Fit
    from servofd.discrepancy.own import OwnEffect
    from servofd.discrepancy.record import Record
    from servofd.discrepancy.validity import Undriven
    from servofd.discrepancy.varying import Varying
    from servofd.models.physics import Physics
    from servofd.models.servo_model import ServoModel
    from servofd.types import BoolArray, FloatArray

__all__ = ["Conclusion", "Explanation", "explain_gap"]

Conclusion = Literal["nothing_missing", "explained", "partly_explained", "unexplained"]

_MUCH_WORSE, _NO_NOISE = 4.0, 5.5
_SLOWLY_WORSE = 2.0
"""Times the variance of the healthy part, up to the first sample that is no noise: a drift, which has no beginning."""
_AT_ONCE_S, _SOON_S, _FAR_WORSE, _NOT_BUSIER, _MOST_OF_IT = 5.0, 15.0, 25.0, 2.0, 0.25
"""Where the healthy part is not explained to the noise either, a fault must stand out from what stays of it: at once,
though no more is asked, or soon and nearly as large as the motion (variances). A gap that drifts, or grows with motion,
is no fault."""
_MARGINS_S = (0.0, 1.0, 2.5, 5.0)
"""How long before a change of the error's size a fault may have begun without much to do."""
_FEWEST_SAMPLES = 100
_NAMES = {
    "delay": "a longer delay",
    "clock_offset": "positions stamped late",
    "slow_dynamics": "slower dynamics",
    "rate_limit": "a rate limit",
    "voltage_rate": "a rate limit that falls with the supply",
    "position_limit": "a stop",
    "deadband": "a dead band",
    "backlash": "play",
    "friction": "friction",
    "load_friction": "friction under load",
    "gain": "another gain",
    "bias": "an offset",
    "airload": "a surface that yields to the airload",
    "gravity_load": "a load that hangs on it",
    "pwm_frame": "commands that wait for pulse frames",
    "sensor_lag": "a sensor that lags",
    "quantization": "coarse steps",
    "current_limit": "a supply that limits its current",
    "resonance": "a flexible linkage",
    "damping": "another damping",
    "supply_coupling": "a reading that moves with the current",
    "linkage_nonlinearity": "a crooked linkage",
}
_UNITS = (("deg_s_per_v", " deg/s per V"), ("deg_s", " deg/s"), ("_deg", " deg"), ("_s", " s"), ("_hz", " Hz"))
_SOUND = {
    "backlash": (0.3, "check horn, rod and gear for play"),
    "deadband": (0.4, "check the servo's electronics and its dead band setting"),
    "friction": (0.3, "check for binding, and the gear"),
    "bias": (1.0, "trim it, and check whether the horn slipped"),
}
"""Width or size that a sound hobby servo may have [deg], and what to do beyond: HS-225BB has 0.3 deg of free play."""


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
        return _answer(self)

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
    airspeed_m_s: FloatArray | None = None,
    voltage_v: FloatArray | None = None,
    own: OwnEffect | None = None,
    off: Sequence[Undriven] = (),
    conditions: Mapping[str, FloatArray] | None = None,
    progress: Callable[[str], None] = lambda _step: None,
) -> Explanation:
    """Find where a servo and its model disagree, name what is missing, and show how the gap shrinks.

    Parameters
    ----------
    segment : Segment or sequence of Segment
        Commands and measurements of one surface; of several runs, every other one is held out whole.
    model : ServoModel
        The servo as it is known.
    on_bench : bool
        Whether each run begins at rest, so that all of it counts.
    free_poles : bool
        Whether the poles of the model are only where the search for them starts.
    airspeed_m_s, voltage_v : ndarray, shape (m,), optional
        At the measurements: airspeed [m/s] and supply of the servo [V]; left out, those of the segment. Effects that
        need what is not there cannot be judged, and the result says so.
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
    >>> from servofd.models.effects import Delay
    >>> from servofd.models.servo_model import ServoModel
    >>> from servofd.segment import Segment
    >>> from servofd.servos import servo_named
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
    if airspeed_m_s is not None or voltage_v is not None:
        segments = [_with_context(each, airspeed_m_s, voltage_v) for each in segments]
    records = [record_of(each, model, at_rest=on_bench, free_poles=free_poles, own=own) for each in segments]
    known = told_apart(conditions or {})
    records = [
        replace(each, conditions=tuple(float(of[k]) for of in known.values()), condition_names=tuple(known))
        for k, each in enumerate(records)
    ]
    record = joined([at_rest(each) for each in records])
    check(record)
    undriven = list(off)
    if record.side is None:
        kept, stood = driven(records, Fitter(record).linear().physics)
        if stood:  # the servo had been fitted to what no servo does
            clear = joined([at_rest(each) for each in clear_of(records, stood)])
            if int(clear.counts.sum()) >= _FEWEST_SAMPLES:
                again = driven(records, Fitter(clear).linear().physics)
                kept, stood = again if len(again[1]) >= len(stood) else (kept, stood)
        part = joined([at_rest(each) for each in kept]) if stood else record
        if stood and int(part.counts.sum()) >= _FEWEST_SAMPLES:
            records, record = kept, part
            undriven += stood
    selection = select(record, progress)
    notes = [each.sentence(several=len(records) > 1) for each in undriven]
    fault_s = undriven[0].start_s if len(records) == 1 and undriven and not off else None
    if fault_s is None and selection.adequacy.reasons and not (record.runs or record.side is not None):
        healthy = _healthy_part(record, selection, progress)
        if healthy is not None:
            record, selection, fault_s = healthy
            notes.append(
                f"after {fault_s:.1f} s this is a fault, not a missing effect: only what came before is explained"
            )
    if record.side is not None:
        notes.append(only_rests_sentence(record))
    elif free_poles:
        notes.append(linear_sentence(record, selection))
    notes += [f"left over: {reason}" for reason in selection.adequacy.reasons]
    if selection.unjudged:
        notes.append(unjudged_sentence(selection))
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
        gain = audit_gain(segments, model, found.better_model, fault_s or float("inf"))
    # Manoeuvres are simulated, and how the servo moves must be known for that.
    return replace(found, separating=() if record.side is not None else separations(selection), gain=gain)


def _with_context(segment: Segment, airspeed_m_s: FloatArray | None, voltage_v: FloatArray | None) -> Segment:
    context = segment.context
    if airspeed_m_s is not None:
        context = replace(context, airspeed_s=segment.measured_s, airspeed_m_s=airspeed_m_s)
    if voltage_v is not None:
        context = replace(context, voltage_s=segment.measured_s, voltage_v=voltage_v)
    return replace(segment, context=context)


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
        healthy = select(before, progress)
        later = record.counts & ~before.counts
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
            return before, healthy, start_s
        # Of a servo that nobody knows, what is left is the model's as likely as a fault's.
        may_break = rough is None and not explained and not record.free_poles
        if may_break and _breaks_off(record, error, before.counts, start_s, usual_deg):
            rough = before, healthy, start_s
    return rough


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


def _answer(found: Explanation) -> str:
    """A few sentences, the most important first."""
    before, after = (found.rms_deg(fit)["held_out_rms_deg"] for fit in (found.selection.nominal, found.selection.final))
    parts = []
    if found.fault_s is not None:
        parts.append(f"FAULT from {found.fault_s:.1f} s on: the servo no longer does what its command asks")
    elif found.undriven:
        parts.append("not driven in part (see below), which was left out")
    if not found.selection.rungs:
        if not found.selection.adequacy.reasons:
            told = "before that, nothing is missing" if found.fault_s is not None else "nothing is missing"
            parts.append(f"{told}: what is left is noise of {found.selection.sigma_deg:.3g} deg")
        else:
            parts.append(f"unexplained: {after:.3g} deg are left and no known effect tells them")
    else:
        parts += [_named(found, k) for k in range(len(found.selection.rungs))]
        parts.append(f"gap {before:.3g} -> {after:.3g} deg on data not fitted")
        if found.conclusion == "partly_explained" and found.selection.adequacy.reasons:
            parts.append(f"something is left: {found.selection.adequacy.reasons[0]}")
    advice = [_SOUND[name][1] for name in _beyond_sound(found)]
    if found.separating and found.separating[0].manoeuvre:
        advice.append(f"fly {found.separating[0].manoeuvre} to tell {' from '.join(found.separating[0].effects)}")
    if found.selection.rungs and found.is_simulated_by_audit and found.record.side is None and found.fault_s is None:
        advice.append("keep the model with --save")
    return "; ".join(parts) + (f". Next: {'; '.join(advice)}." if advice else ".")


def _named(found: Explanation, index: int) -> str:
    """One effect with its size, what it may be instead, and whether a sound servo may have it."""
    effect = found.selection.final.effects[index]
    values = effect_values(found.selection, index)
    name, value = next(iter(values.items()))
    unit = next((words for end, words in _UNITS if name.endswith(end)), "")
    size = f"{value['value']:.3g}{unit} ({value['low']:.3g} to {value['high']:.3g})"
    ties = next((tie[1:] for tie in found.selection.ties if tie[0] == effect.name), ())
    instead = f", or {' or '.join(_NAMES.get(n, n) for n in ties)}: cannot tell which" if ties else ""
    sound = ""
    if effect.name in _SOUND:
        limit = _SOUND[effect.name][0]
        beyond = abs(value["value"]) > limit
        # What a servo that nobody knows has may be how it was made.
        word = (
            ("more: compare it with another of its kind" if found.record.free_poles else "FAULT")
            if beyond
            else "acceptable"
        )
        sound = f" - a sound hobby servo has up to {limit:g}: {word}"
    return f"{_NAMES.get(effect.name, effect.name)} of {size}{instead}{sound}"


def _beyond_sound(found: Explanation) -> list[str]:
    names = []
    for k, effect in enumerate(found.selection.final.effects):
        value = next(iter(effect_values(found.selection, k).values()))["value"]
        if effect.name in _SOUND and abs(value) > _SOUND[effect.name][0]:
            names.append(effect.name)
    return names
