"""What a verdict means for the people around the aircraft, and what they can do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.detection.bank.flight import Fault
    from servofd.detection.verdict import SurfaceAudit

_MEANING = {
    "stuck": "The surface stayed where it was, whatever was asked: a jammed linkage, a stripped gear, a servo without "
    "power or signal, or a position sensor that froze.",
    "bias": "The surface follows, but beside its command: a slipped horn or linkage, a shifted sensor, or a trim that "
    "the aircraft file does not know.",
    "hardover": "The surface ran to one end and stays there: failed electronics or feedback inside the servo, or a "
    "broken signal wire.",
    "floating": "The surface moves without being asked: the linkage is open or the servo has no power, and the air "
    "moves it.",
    "oscillation": "The surface swings on top of what was asked: a worn feedback potentiometer, play that the air "
    "excites, or a loop inside the servo that is about to become unstable.",
    "deadband": "Small commands have no effect: worn gears, play in the linkage, or friction.",
    "slow": "The surface arrives late: low supply voltage, a binding hinge, too much load, or a worn motor.",
    "loss_of_effectiveness": "The surface moves less than asked: a slipping gear or horn, or a position channel of the "
    "wrong scale.",
    "unknown": "The surface left its model, and no single fault explains how, or there was too little motion to tell "
    "which one it is.",
    "healthy": "The surface is further from its model than chance allows, yet within what a working servo may be: the "
    "model is not quite that of this servo.",
}
_CHECK = {
    "stuck": "move it from stop to stop and feel for binding",
    "bias": "compare its neutral position with a ruler",
    "hardover": "watch where it goes when it is powered up",
    "floating": "pull at the surface with the servo powered: it must hold",
    "oscillation": "hold it at several deflections and listen for buzzing",
    "deadband": "move it in steps of 0.5 deg and look for steps it does not follow",
    "slow": "measure the supply at the servo while it moves, and the time from stop to stop",
    "loss_of_effectiveness": "compare its travel with the commanded one, in degrees",
}
_ANYHOW = "move it from stop to stop, slowly and fast, and compare with its command"


def meaning(fault: Fault) -> str:
    """What may have happened to the aircraft, in a sentence.

    Examples
    --------
    >>> from servofd.detection.bank.flight import Fault
    >>> meaning(Fault("deadband", 10.0, 10.4, None, {}, 0.99, ()))
    'Small commands have no effect: worn gears, play in the linkage, or friction.'
    """
    return _MEANING[fault.kind]


def gravest(faults: Sequence[Fault]) -> Fault:
    """The first fault that lasts to the end of the log; the first of all if every one has passed.

    Examples
    --------
    >>> from servofd.detection.bank.flight import Fault
    >>> passed, lasts = (Fault("bias", 1.0, 2.0, 3.0, {}, 1.0, ()), Fault("stuck", 5.0, 6.0, None, {}, 1.0, ()))
    >>> gravest([passed, lasts]).kind, gravest([passed]).kind
    ('stuck', 'bias')
    """
    return next((fault for fault in faults if fault.end_s is None), faults[0])


def next_step(surface: SurfaceAudit) -> str:
    """What to do about a verdict, in a sentence; empty if there is nothing to do.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> next_step(SurfaceAudit("rudder", "healthy", "", "s9254", "constant", 1.5, True))
    ''
    """
    if surface.status == "fault":
        check = _CHECK.get(gravest(surface.faults).kind, _ANYHOW)
        return f"do not fly; on the ground, {check}; if it moves as asked, its position sensor is at fault"
    if surface.status == "suspect":
        check = _CHECK.get(gravest(surface.suspicions).kind, _ANYHOW) if surface.suspicions else _ANYHOW
        return (
            f"look at another flight; if it happens again, on the ground, {check}; 'servofd explain' says what the "
            "model lacks"
        )
    if surface.status == "unknown":
        return "no verdict: before the next flight, move it from stop to stop and watch that it follows"
    if surface.status == "no_data" and surface.expected:
        return "log its measured position; 'servofd info' says what this log holds and what is missing"
    return ""


def headline(surfaces: Sequence[SurfaceAudit]) -> str:
    """The verdict on a whole log, in a sentence.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> rudder = SurfaceAudit("rudder", "healthy", "", "s9254", "constant", 1.5, True)
    >>> headline([rudder])
    'The one surface that could be judged is healthy.'
    >>> headline([rudder, rudder])
    'All 2 surfaces that could be judged are healthy.'
    """
    judged = [s for s in surfaces if s.is_judged]
    if not judged:
        return "No surface could be judged."
    count = len(judged)
    named = {
        status: ", ".join(s.surface for s in judged if s.status == status)
        for status in ("fault", "suspect")
        if any(s.status == status for s in judged)
    }
    parts = []
    if "fault" in named:
        parts.append(f"servo or position sensor at fault: {named['fault']}")
    if "suspect" in named:
        parts.append(f"suspect: {named['suspect']}")
    if parts:
        text = "; ".join(parts)
        text = f"{text[0].upper()}{text[1:]}"
        healthy = sum(s.status == "healthy" for s in judged)
        return f"{text}." + (f" {healthy} of {count} judged surfaces healthy." if healthy else "")
    missing = [s.surface for s in surfaces if s.expected and not s.is_judged]
    verdict = (
        "The one surface that could be judged is" if count == 1 else f"All {count} surfaces that could be judged are"
    )
    return f"{verdict} healthy." + (f" No verdict on {', '.join(missing)}." if missing else "")
