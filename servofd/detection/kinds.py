"""The kinds of faults, one row each: what is said of one in a log, in a headline, in flight, and what to do about it.

A sentence has forms for the parameters that may be known; the first is taken whose parameters all are.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from string import Formatter
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

_ANYHOW: Final = "move it from stop to stop, slowly and fast, and compare with its command"
_WATCH: Final = "watch it, be ready to land"
_SOON: Final = "land soon"


@dataclass(frozen=True, slots=True)
class Kind:
    """What is said of the faults of one kind."""

    name: str
    """In JSON."""
    perhaps: str
    """In "perhaps ...": a noun."""
    clause: tuple[str, ...]
    """In a sentence, before "since"."""
    headline: tuple[str, ...]
    """In capitals, with `since`, or `when` where it may have ended; before either, or a comma, stands its `state`."""
    meaning: str
    """What may have happened to the aircraft."""
    check: str = _ANYHOW
    """What to do on the ground."""
    in_flight: str = _WATCH
    """What to do in the air."""
    severity: Literal["critical", "warning", "by size"] = "warning"
    """What it does to the aircraft: control lost, control worse, or as much as it is large."""
    size_deg: str = ""
    """Parameter that tells how large it is [deg]; where there is none, the residual of the moment does."""
    stands_still: bool = False
    """Whether no servo with other numbers is an account of it."""

    @property
    def state(self) -> str:
        """The headline without when and how much.

        Examples
        --------
        >>> KINDS["stuck"].state, KINDS["hardover"].state, KINDS["worn"].state
        ('JAMMED', 'RAN TO ONE END', 'WORN')
        """
        return re.split(r" at | \{when\}|,", self.headline[-1])[0]


def filled(forms: tuple[str, ...], values: Mapping[str, float | str]) -> str:
    """Return the first form whose fields are all known, with them; nothing if there is none.

    Examples
    --------
    >>> filled(KINDS["slow"].clause, {"rate_limit_deg_s": 42.0})
    'slow: no faster than 42 deg/s'
    >>> filled(KINDS["stuck"].headline, {"since": "1:02"})
    'JAMMED at 1:02'
    """
    for form in forms:
        if all(name in values for _, name, _, _ in Formatter().parse(form) if name):
            return form.format(**values)
    return ""


_ROWS: Final = (
    Kind(
        "hardover",
        "run to its stop",
        ("ran to {position_deg:.1f} deg and stays there", "ran to one end and stays there"),
        ("RAN TO {position_deg:+z.0f} deg at {since} and stays there", "RAN TO ONE END at {since} and stays there"),
        "The surface ran to one end and stays there: failed electronics or feedback inside the servo, or a broken "
        "signal wire.",
        "watch where it goes when it is powered up",
        "land now: hold against it",
        "critical",
        stands_still=True,
    ),
    Kind(
        "stuck",
        "stuck",
        ("stuck at {position_deg:.1f} deg", "stuck"),
        ("JAMMED at {since} ({position_deg:+z.1f} deg)", "JAMMED at {since}"),
        "The surface stayed where it was, whatever was asked: a jammed linkage, a stripped gear, a servo without "
        "power or signal, or a position sensor that froze.",
        "move it from stop to stop and feel for binding",
        "land soon: it no longer moves",
        "critical",
        stands_still=True,
    ),
    Kind(
        "blocked",
        "blocked",
        ("blocked: draws {current_a:.2g} A wherever it is asked to be elsewhere", "blocked"),
        ("BLOCKED {when}, by its current ({current_a:.1f} A)", "BLOCKED {when}, by its current"),
        "The servo pushes with all it has and the surface does not move: something blocks the linkage or the gear, "
        "and it will overheat.",
        "take the linkage off and move surface and servo apart from each other",
        "land soon: it no longer moves",
        "critical",
    ),
    Kind(
        "floating",
        "floating",
        ("floating: moves by itself within about ±{amplitude_deg:.1f} deg", "floating"),
        ("FLOATS FREE {when}",),
        "The surface moves without being asked: the linkage is open or the servo has no power, and the air moves it.",
        "pull at the surface with the servo powered: it must hold",
        "slow down, land soon: it may flutter",
        "critical",
        stands_still=True,
    ),
    Kind(
        "unpowered",
        "without power",
        ("without power: draws {current_a:.2g} A whatever it is asked", "without power"),
        ("WITHOUT POWER {when}, by its current",),
        "The servo draws no current for what it is asked: a broken wire or plug, a blown fuse, or dead electronics.",
        "measure the supply at its plug, and move it",
        "slow down, land soon: it may flutter",
        "critical",
    ),
    Kind(
        "loss_of_effectiveness",
        "a loss of travel",
        ("moves by only {gain:.0%} of its command", "moves by less than its command"),
        ("MOVES ONLY {gain:.0%} of its command {when}", "MOVES LESS THAN ITS COMMAND {when}"),
        "The surface moves less than asked: a slipping gear or horn, or a position channel of the wrong scale.",
        "compare its travel with the commanded one, in degrees",
        "fly gently, land soon",
        "by size",
    ),
    Kind(
        "slow",
        "slow",
        (
            "slow: {bandwidth_scale:.0%} of its bandwidth is left",
            "slow: no faster than {rate_limit_deg_s:.0f} deg/s",
            "slow",
        ),
        ("TOO SLOW {when} ({bandwidth_scale:.0%} of its speed is left)", "TOO SLOW {when}"),
        "The surface arrives late: low supply voltage, a binding hinge, too much load, or a worn motor.",
        "measure the supply at the servo while it moves, and the time from stop to stop",
        "fly gently, land soon",
    ),
    Kind(
        "intermittent",
        "a contact that comes and goes",
        ("comes and goes: holds still for {outage_s:.1f} s at a time, and obeys again", "comes and goes"),
        ("COMES AND GOES {when} (holds still for {outage_s:.1f} s at a time)", "COMES AND GOES {when}"),
        "For moments the surface holds still, then obeys again: a loose plug, a broken strand in a wire, or a bus that "
        "drops its commands.",
        "move it while you bend its wires and press on its plugs",
        "land soon: its contact may fail for good",
    ),
    Kind(
        "binding",
        "binding",
        ("binding: draws {times:.1f} times as much for the same motion", "binding"),
        ("BINDS {when}, by its current ({times:.1f} times as much)", "BINDS {when}, by its current"),
        "The servo needs more current for the same motion: a hinge or gear that binds, ice, or a linkage that rubs.",
        "take the linkage off and compare its current with and without it",
        _SOON,
    ),
    Kind(
        "bias",
        "an offset",
        ("off by {bias_deg:+.1f} deg", "off by some degrees"),
        ("OFF BY {bias_deg:+z.1f} deg {when}", "OFF {when}"),
        "The surface follows its command with an offset: a slipped horn or linkage, a shifted sensor, or a trim that "
        "the aircraft file does not know.",
        "compare its neutral position with a ruler",
        "trim against it, land soon",
        "by size",
        "bias_deg",
    ),
    Kind(
        "oscillation",
        "oscillating",
        ("oscillates by ±{amplitude_deg:.1f} deg at {frequency_hz:.2f} Hz", "oscillates"),
        ("OSCILLATES {when} (±{amplitude_deg:.1f} deg at {frequency_hz:.1f} Hz)", "OSCILLATES {when}"),
        "The surface swings on top of what was asked: a worn feedback potentiometer, play that the air excites, or "
        "a loop inside the servo that is about to become unstable.",
        "hold it at several deflections and listen for buzzing",
        "slow down, land soon",
        "by size",
        "amplitude_deg",
    ),
    Kind(
        "deadband",
        "a dead band",
        ("dead band, stiction or play of {width_deg:.1f} deg", "dead band, stiction or play"),
        ("IGNORES SMALL COMMANDS {when} (play or dead band of {width_deg:.1f} deg)", "IGNORES SMALL COMMANDS {when}"),
        "Small commands have no effect: worn gears, play in the linkage, or friction.",
        "move it in steps of 0.5 deg and look for steps it does not follow",
        "fly on, check it on the ground",
        "by size",
        "width_deg",
    ),
    Kind(
        "worn",
        "worn",
        ("worn: its current is {distance:.1f} times as far from that of good flights as good ones may be", "worn"),
        ("WORN, by its current",),
        "The current is further from that of good days than these are from each other: bearings, gears or lubrication "
        "wear.",
        "compare its current with and without its linkage, and look at gears and bearings",
        "fly on, check it on the ground",
        "by size",
    ),
    Kind(
        "unknown",
        "something else",
        ("left the model in a way that no known fault explains",),
        ("NOT WHERE IT SHOULD BE {when}",),
        "The surface left its model, and no single fault explains how, or there was too little motion to tell which"
        " one it is.",
        severity="by size",
    ),
    Kind(
        "healthy",
        "within tolerance",
        ("away from its model for longer than chance allows, yet within the tolerances of a working servo,",),
        ("NOT WHERE IT SHOULD BE {when}",),
        "The surface is further from its model than chance allows, yet within what a working servo may be: the "
        "model is not quite that of this servo.",
        severity="by size",
    ),
)
KINDS: Final[Mapping[str, Kind]] = {kind.name: kind for kind in _ROWS}
"""Kinds by their names, worst first by what they do to the aircraft."""
STANDS_STILL: Final = tuple(kind.name for kind in _ROWS if kind.stands_still)
"""Kinds of which no servo with other numbers is an account."""
