"""A calibration: what was fitted, the smallest faults that such flights show, and the false alarms to expect."""

from __future__ import annotations

from collections.abc import Iterable
from math import exp
from typing import TYPE_CHECKING

from servofd.aircraft.axes import SURFACE_AXES
from servofd.outputs.document import Bullets, Document, Table
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    from servofd.aircraft.axes import MotionModel
    from servofd.aircraft.current import CalibratedCurrent
    from servofd.calibrating.result import CalibratedSurface, Calibration

_NOT_REACHED = 0.5
"""Deviation of the logarithm of the largest speed from which on flights do not tell it."""
_HEAD = ("surface", "delay (ms)", "bandwidth (rad/s)", "speed (deg/s)", "noise (deg)", "held out (deg)")
_SMALLEST = ("surface", "offset (deg)", "speed left", "travel lost", "play (deg)", "oscillation (deg)")
_KINDS = {"bias_deg": ".2g", "slow_share": ".0%", "loss_share": ".0%", "deadband_deg": ".2g", "oscillation_deg": ".2g"}


def calibrate_report(found: Calibration, wanted_per_hour: float | None = None) -> Document:
    """Tables of the surfaces; a lower rate of false alarms than was measured is not promised."""
    fitted, sizes, notes = [], [], []
    for one in found.surfaces:
        fitted.append(_row(one))
        known = ((getattr(one.detectable, kind), form) for kind, form in _KINDS.items())
        sizes.append([spoken(one.surface), *("none" if size is None else format(size, form) for size, form in known)])
        notes.append(f"{spoken(one.surface)}: {', '.join(one.effects) or 'no effect beyond a linear servo pays'}")
        notes += [f"{spoken(one.surface)}: note: {note}" for note in (*one.notes, one.sharper)]
    notes += [f"{spoken(name)}: not calibrated: {reason}" for name, reason in found.kept.items()]
    notes += [f"{spoken(name)}: its current is not calibrated: {why}" for name, why in found.without_current.items()]
    per_hour = found.false_alarms_per_hour
    of = "this surface" if len(found.surfaces) == 1 else f"these {len(found.surfaces)} surfaces"
    rate = f"false alarms to expect: about {per_hour:.2g} an hour of {of}, as measured on simulated aircraft"
    if not any(one.known.airspeed_m_s for one in found.surfaces):
        rate += "; more in flight, for these logs hold no airspeed"
    if wanted_per_hour is not None and wanted_per_hour < per_hour:
        rate += f"; {wanted_per_hour:g} cannot be promised"
    kept = f"; left as they were: {', '.join(map(spoken, found.kept))}" if found.kept else ""
    by_position = [spoken(one.surface) for one in found.surfaces]
    by_current = [spoken(name) for name in found.currents]
    kinds = [", ".join(by_position)] * bool(by_position) + [f"current of {', '.join(by_current)}"] * bool(by_current)
    calibrated = "; ".join(kinds) or "nothing"
    healthy = ((name, found.aircraft.surfaces[name].healthy_current) for name in found.currents)
    drawn = [_drawn(name, current) for name, current in healthy if current is not None]
    return Document(
        title="Calibration",
        status="unknown" if found.kept else "healthy",
        sentence=f"Calibrated: {calibrated}{kept}"
        + (f"; about {per_hour:.2g} false alarms an hour to expect" if found.surfaces else ""),
        facts=", ".join(dict.fromkeys(flight for one in found.surfaces for flight in one.flights)),
        parts=[
            Table("Fitted, with 95% intervals; error on what the fit had not seen", _HEAD, fitted),
            Table("Smallest faults that flights like these show, 19 times in 20", _SMALLEST, sizes),
            Table("Currents", _DRAWN, drawn),
            Bullets([*notes, *([rate] if found.surfaces else [])]),
        ],
    )


_DRAWN = ("surface", "idle (A)", "most in motion (A)", "noise at rest (A)", "explained", "late (s)", "wear")


def _drawn(name: str, current: CalibratedCurrent) -> list[str]:
    wear = "four good flights or cycles show it" if current.wear is None else f"known from {current.wear.flights}"
    drawn = (f"{current.parameters['idle']:.3g}", f"{current.most_a:.3g}", f"{current.noise.still_a:.2g}")
    return [spoken(name), *drawn, f"{current.explained_share:.0%}", f"{current.lag_s:g}", wear]


def _row(one: CalibratedSurface) -> list[str]:
    delay, rate = one.estimates["delay_s"], one.estimates["ln_rate"]
    return [
        spoken(one.surface),
        _interval(1e3 * x for x in delay),
        _interval(one.bandwidth_rad_s),
        _interval(exp(x) for x in rate) if rate.deviation < _NOT_REACHED else "not reached",
        f"{one.known.noise.still_deg:.2g}",
        f"{one.held_out_rms_deg:.2g}",
    ]


def _interval(estimate: Iterable[float]) -> str:
    value, low, high = estimate
    return f"{value:.0f} [{low:.0f}, {high:.0f}]"


_BY_DAYS = {1: "17", 2: "6", 3: "1.5"}
_AXES = ("axis", "form", "explained", "delay (s)", "lost share ±", "offset ± (us)", "suspect", "fault", "false/h")


def motion_report(model: MotionModel) -> Document:
    """What motion tells of the axes of an aircraft, from its calibration flights."""
    rows = []
    for name, axis in model.axes.items():
        spread, never = axis.spreads[-1], axis.fault is None
        fitted = (name, spoken(axis.form), f"{axis.explained:.0%}", f"{axis.delay_s:.2f}")
        stray = (f"{spread.loss_var**0.5:.2f}", f"{spread.offset_var_us2**0.5:.1f}")
        limits = (f"{axis.suspect:.2g}", "never" if never else f"{axis.fault:.2g}", f"{axis.false_alarms_per_hour:.2g}")
        rows.append((*fitted, *stray, *limits))
    days = "1 day" if model.days == 1 else f"{model.days} days"
    low, high = model.regime.airspeed_low_m_s, model.regime.airspeed_high_m_s
    notes = [
        "explained: share of the command's effect, in flights that the model had not seen; ±: how far healthy windows "
        "stray; suspect, fault: from which multiple of the largest value in these flights on",
        f"judged between {low:.0f} and {high:.0f} m/s, with at least {model.regime.throttle_low:.0%} throttle",
    ]
    notes += [
        f"{name}: not judged: its command is not logged, or explains nothing of the motion of other days"
        for name in SURFACE_AXES
        if name not in model.axes
    ]
    notes += [
        f"{name}: its command never moved on its own: fly a wiggle of it alone to have it judged"
        for name, axis in model.axes.items()
        if not axis.own_command
    ]
    if model.days in _BY_DAYS:
        notes.append(
            f"flights of {days} say little about other days: thresholds allow for {_BY_DAYS[model.days]} times the "
            "false alarms of four days, and fall with each day more"
        )
    if model.days == model.flights > 1:
        notes.append(
            "each flight counts as a day of its own; flights of one day are recognised by the date in a log or its name"
        )
    notes += [f"left out: {why}" for why in model.left_out]
    flights = "1 flight" if model.flights == 1 else f"{model.flights} flights"
    facts = f"{flights}, {model.hours:.2f} h, {days}"
    said = f"Calibrated by the motion of the aircraft: {', '.join(model.axes) or 'nothing'}"
    status = "healthy" if model.axes else "unknown"
    return Document("Calibration of motion", status, said, facts, [Table("Axes", _AXES, rows), Bullets(notes)])
