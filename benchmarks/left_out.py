"""Constants of `servofd explain` chosen without a source, and what they do on it, for each source in turn.

A source is a simulator or the servos of one maker. Each constant that was chosen by what it did on data has three
values: the one that is shipped, a smaller and a larger one. Without a source, that value is taken which does best on
the others (each source counts as much as any other; the shipped one where they are equal); then the source is
explained with all that was taken. Loss of a record: of simulators 1 where the truth is not in the declared set, 1
more if that is "explained", and 0.2 for each name too many of a step; of servos on a bench the share of the names that
their description gives and that are not told, and the logarithm of the held-out error over the least of any value.

Run it for a table: ``SERVOFD_EXTERNAL_DATA=... python benchmarks/left_out.py`` (a quarter of an hour), or for the
sources whose names are given.
"""

from __future__ import annotations

import contextlib
import copy
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import places
from hidden_effects import PAIRS
from hidden_logs import SURFACE, write
from hidden_physics import CATALOGUE, draw, hidden
from servofd import explain, explain_logs
from servofd.core.errors import ServofdError
from servofd.core.types import FloatArray
from servofd.discrepancy import adequacy, explanation, search, select
from servofd.discrepancy.known import A_TYPE, NOTHING, Known
from servofd.discrepancy.record import Record
from servofd.discrepancy.search import Search
from servofd.discrepancy.select import Selection

__all__ = ["CONSTANTS", "Constant", "Judged", "chosen_without", "judged"]

KNOWN = "hs225bb-eq31"
_NAME_TOO_MANY = 0.2
_EQUAL = 2e-3
"""Losses that differ by less are equal."""


class Constant(NamedTuple):
    """Something that was chosen by what it did on data."""

    name: str
    what: str
    where: tuple[tuple[Any, str], ...]
    values: tuple[Any, Any, Any]
    """The shipped one in the middle."""
    of_unknown: bool | None = None
    """Whether it matters to servos that nobody knows, or to those that are known, alone."""
    is_searched: bool = False
    """Whether structures have to be fitted again with it."""


def _widths(share: float) -> dict[str, float]:
    return {name: share * deviation for name, deviation in A_TYPE.spread.items()}


CONSTANTS = (
    Constant("OCCAM", "misfit for a further name", ((search, "OCCAM"), (select, "OCCAM")), (20.0, search.OCCAM, 45.0)),
    Constant("own", "misfit for one of its own numbers", ((select, "_OCCAM_OWN"),), (10.0, select._OCCAM_OWN, 24.0)),
    Constant("gap", "share of the gap on top", ((select, "_OF_GAP"),), (3e-5, select._OF_GAP, 3e-4)),
    Constant("declared", "probability that is declared", ((select, "_DECLARED"),), (0.9, select._DECLARED, 0.99)),
    Constant(
        "gain",
        "gain of an unknown servo",
        ((NOTHING, "gain_share"),),
        (0.02, NOTHING.gain_share, 0.05),
        of_unknown=True,
    ),
    Constant(
        "model", "error of a model, of its misfit", ((select, "_MODEL_SHARE"),), (0.01, select._MODEL_SHARE, 0.04), True
    ),
    Constant("left", "what effects may leave", ((select, "_MOST_LEFT"),), (0.35, select._MOST_LEFT, 0.7), True),
    Constant("memory", "memory of the noise at rest", ((adequacy, "_MEMORY"),), (1.3, adequacy._MEMORY, 2.0)),
    Constant(
        "widths",
        "how servos of a type differ",
        ((A_TYPE, "spread"),),
        (_widths(0.67), A_TYPE.spread, _widths(1.5)),
        of_unknown=False,
        is_searched=True,
    ),
)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One answer: of a simulator's record right or not, of a bench's what is missing and how large its error is."""

    loss: float
    is_right: bool
    per_name: float
    held_out_deg: float


@dataclass(slots=True, eq=False)
class Case:
    """A record, and the names of what is in it."""

    record: Record
    names: tuple[str, ...]
    is_known: bool
    """Whether it holds these effects and no others."""
    found: dict[tuple[tuple[str, int], ...], Search] = field(default_factory=dict)
    """Structures that were fitted, by the constants that change them."""
    answers: dict[tuple[tuple[str, int], ...], Judged] = field(default_factory=dict)

    def judged(self, levels: Mapping[str, int]) -> Judged:
        """With some constants at another of their values."""
        own = [c for c in CONSTANTS if c.name in levels and c.of_unknown is not self.is_known]
        if levels and not own:
            return self.judged({})
        with _set(levels):
            key = tuple((c.name, levels[c.name]) for c in own if c.is_searched)
            if key not in self.found:
                self.found[key] = select.searched(self.record)
            levels_of = tuple((c.name, levels[c.name]) for c in own)
            if levels_of not in self.answers:
                found = select.concluded(_copied(self.found[key]))
                self.answers[levels_of] = judged(found, self.names, is_known=self.is_known)
            return self.answers[levels_of]


def judged(selection: Selection, names: Sequence[str], *, is_known: bool) -> Judged:
    """What an answer is worth, but for how large its error is beside others."""
    named = selection.final.names
    offered = [{name}.union(*(tie for tie in selection.ties if tie[0] == name)) for name in named]
    offered = [{"delay" if name == "clock_offset" else name for name in each} for each in offered]
    missing = [name for name in names if not any(name in each for each in offered)]
    per_name = float(np.mean([len(each) for each in offered])) if offered else 1.0
    held_out_deg = float(np.sqrt(selection.final.held_out))
    is_right = not missing and (not is_known or len(named) == len(names))
    if not is_known:
        return Judged(len(missing) / max(len(names), 1), is_right, per_name, held_out_deg)
    wrong = not is_right and not selection.adequacy.reasons
    return Judged(float(not is_right) + float(wrong) + _NAME_TOO_MANY * (per_name - 1.0), is_right, per_name, 0.0)


@contextlib.contextmanager
def _set(levels: Mapping[str, int]) -> Iterator[None]:
    """Constants at other values."""
    changed = [constant for constant in CONSTANTS if constant.name in levels]
    try:
        for constant in changed:
            for module, name in constant.where:
                _give(module, name, constant.values[levels[constant.name]])
        yield
    finally:
        for constant in changed:
            for module, name in constant.where:
                _give(module, name, constant.values[1])


def _give(owner: Any, name: str, value: Any) -> None:  # noqa: ANN401 - a module, or what is known of a servo
    (object.__setattr__ if isinstance(owner, Known) else setattr)(owner, name, value)


def _copied(found: Search) -> Search:
    """A search whose misfits may be counted anew."""
    again = copy.copy(found)
    again.fitter, again.part = copy.copy(found.fitter), copy.copy(found.part)
    again.visited, again.grown = dict(found.visited), set(found.grown)
    return again


@contextlib.contextmanager
def _caught() -> Iterator[list[Record]]:
    """Records whose effects are asked for."""
    records: list[Record] = []
    usual = select.select

    def caught(record: Record, *_: object) -> Selection:
        records.append(record)
        raise ServofdError("caught")

    try:
        explanation.select = caught  # type: ignore[assignment, attr-defined]
        yield records
    finally:
        explanation.select = usual  # type: ignore[attr-defined]


def _simulated(logs: Sequence[tuple[Path, tuple[str, ...]]]) -> list[Case]:
    cases = []
    for path, names in logs:
        with _caught() as records, contextlib.suppress(ServofdError):
            explain(path, servo=KNOWN, surface=SURFACE)
        cases += [Case(record, names, is_known=True) for record in records[:1]]
    return cases


def _places(folder: Path) -> list[Case]:
    logs = []
    for seed in range(2, 98, 8):
        case = places.case(seed)
        path = folder / f"places_{seed}.csv"
        path.write_bytes(case.table())
        logs.append((path, tuple(case.truth)))
    return _simulated(logs)


def _hidden(folder: Path) -> list[Case]:
    logs = []
    for names in (*((name,) for name in tuple(CATALOGUE)[::3]), *PAIRS[::6]):
        lot = np.random.default_rng([2, *(ord(letter) for name in names for letter in name)])
        effects = {name: draw(lot, name, "medium") for name in names}
        logs.append((write(hidden(2, effects, "flight", 0.1), folder / f"{'_'.join(names)}.csv"), names))
    return _simulated(logs)


def _bench(name: str, names: Sequence[str], where: str = "") -> list[Case]:
    """A record of the bench, with what its description says of each surface."""
    path = Path(os.environ["SERVOFD_EXTERNAL_DATA"]) / "bench" / f"{name}.csv"
    aircraft = None
    with tempfile.TemporaryDirectory() as folder:
        if where:
            aircraft = Path(folder) / "aircraft.toml"
            channel = 'channel = "{}", unit = "deg"'
            aircraft.write_text(
                f'[table]\ntime = "t_s"\nrun = "run"\nwhere = {{ {where} }}\n[surfaces.servo]\n'
                f"command = {{ {channel.format('cmd')} }}\nmeasured = {{ {channel.format('meas')} }}\n"
            )
        surfaces = names if "teleop" in name else (None,)
        cases = []
        for surface in surfaces:
            with _caught() as records, contextlib.suppress(ServofdError):
                explain_logs([path], aircraft, surfaces=() if surface is None else (surface,))
            told = ("gravity_load",) if surface else tuple(names)
            cases += [Case(record, told, is_known=False) for record in records[:1]]
    return cases


SOURCES: Mapping[str, Callable[[Path], list[Case]]] = {
    "places": _places,
    "hidden_effects": _hidden,
    "hobby servo": lambda _: _bench("hobby_servo_encoder", ("rate_limit", "delay", "deadband")),
    "HJ S3315D": lambda _: _bench("digital_servo_loads", ("rate_limit", "supply_coupling")),
    "Feetech": lambda _: [
        *_bench("smart_servo_gravity_load", ("gravity_load", "rate_limit")),
        *_bench("smart_servo_play", ("backlash",)),
        *_bench("teleop_arm_1", ("shoulder_lift", "elbow_flex")),
    ],
    "XL330": lambda _: [
        *_bench("smart_servo_gains", ("gravity_load", "load_friction"), 'kp = "400", torque_enabled = "1"'),
        *_bench("smart_servo_gains", ("gravity_load", "load_friction"), 'kp = "100", torque_enabled = "1"'),
    ],
    "EMPS drive": lambda _: _bench("emps_linear_drive", ("friction", "bias")),
    "RC servo": lambda _: _bench("rc_servo_steps_1khz", ()),
    "Maxon joint": lambda _: _bench("geared_joint_plc", ()),
}
"""Simulators (even seeds) and servos by maker, and how to get their records."""


def chosen_without(losses: Mapping[str, Mapping[str, FloatArray]], source: str) -> dict[str, int]:
    """Of each constant the value that loses least on all sources but one, by its name; without those that stay.

    Parameters
    ----------
    losses : mapping
        By constant, then source: mean loss with each of its three values, shape (3,).
    source : str
        The one that is left out.

    Examples
    --------
    >>> losses = {"OCCAM": {"a": np.array([1.0, 0.5, 0.0]), "b": np.array([0.2, 0.3, 0.9])}}
    >>> chosen_without(losses, "a"), chosen_without(losses, "b")
    ({'OCCAM': 0}, {'OCCAM': 2})
    """
    taken = {}
    for name, of in losses.items():
        mean = np.mean([each for other, each in of.items() if other != source], axis=0)
        best = int(np.argmin(mean))
        if mean[best] < mean[1] - _EQUAL:
            taken[name] = best
    return taken


def _losses(cases: Sequence[Case], answers: Sequence[Sequence[Judged]]) -> FloatArray:
    """Mean loss of some settings on the records of a source, errors beside the least of any."""
    lost = np.zeros((len(answers), len(cases)))
    for k in range(len(cases)):
        least_deg = min(each[k].held_out_deg for each in answers)
        for j, each in enumerate(answers):
            lost[j, k] = each[k].loss + (np.log(each[k].held_out_deg / least_deg) if least_deg > 0.0 else 0.0)
    mean: FloatArray = lost.mean(axis=1)
    return mean


def main(words: list[str]) -> int:
    """Print the table."""
    losses: dict[str, dict[str, FloatArray]] = {constant.name: {} for constant in CONSTANTS}
    sources: dict[str, list[Case]] = {}
    shipped: dict[str, list[Judged]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for source in words or SOURCES:
            cases = sources[source] = SOURCES[source](Path(folder))
            shipped[source] = [case.judged({}) for case in cases]
            for constant in CONSTANTS:
                others = [[case.judged({constant.name: level}) for case in cases] for level in (0, 2)]
                losses[constant.name][source] = _losses(cases, (others[0], shipped[source], others[1]))
            print(source, len(cases), {n: of[source].round(3).tolist() for n, of in losses.items()}, flush=True)
    print("| left out | records | chosen otherwise | right: shipped, so | names per name | error over shipped |")
    print("|---|---|---|---|---|---|")
    for source, cases in sources.items():
        taken = chosen_without(losses, source)
        there, before = [case.judged(taken) for case in cases], shipped[source]
        right = [sum(each.is_right for each in of) for of in (before, there)]
        per_name = [float(np.mean([each.per_name for each in of])) for of in (before, there)]
        raised = [t.held_out_deg / b.held_out_deg for t, b in zip(there, before, strict=True) if b.held_out_deg > 0.0]
        words = [f"{name} {'smaller' if level == 0 else 'larger'}" for name, level in taken.items()]
        print(
            f"| {source} | {len(cases)} | {', '.join(words) or 'none'} | {right[0]}, {right[1]} | "
            f"{per_name[0]:.2f}, {per_name[1]:.2f} | {f'{min(raised):.2f} to {max(raised):.2f}' if raised else ''} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
