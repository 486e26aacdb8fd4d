"""How well `servofd explain` names what is hidden: ``python benchmarks/hidden_effects.py [--quick] [--jobs N]``.

Every effect of the catalogue in three sizes, pairs, triples and nothing at all, physics by another law and faults that
no model contains, in flight, doublets, a chirp and sweeps, under three levels of noise, made by a simulator that shares
nothing with servofd's. Each log goes through the command line. Cases count as separable if the best look-alike of each
effect, fitted by the generator itself, stays 5 standard deviations away. Of several effects, those that change nothing
beside the others (a stop behind the largest deflection) are not hidden, but absent.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hidden_logs import SURFACE, write
from hidden_peers import GROUPS, has_pysindy, regression_closure, sindy_group
from hidden_physics import (
    CATALOGUE,
    CONVERTER_DEG,
    EXCITATIONS,
    LEVELS,
    OUTSIDE,
    STRUCTURAL,
    Effects,
    change_deg,
    draw,
    effect_rms_deg,
    hidden,
)
from hidden_rivals import leftover_sigmas
from hidden_score import Score, Seconds, ask, score, seconds_found

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

PAIRS = (
    ("delay", "backlash"), ("rate_limit", "backlash"), ("rate_limit", "bias"), ("deadband", "slow_dynamics"),
    ("friction", "delay"), ("friction", "sensor_lag"), ("airload", "delay"), ("airload", "voltage_rate"),
    ("gain", "bias"), ("resonance", "rate_limit"), ("gravity_load", "rate_limit"), ("position_limit", "backlash"),
)  # fmt: skip
TRIPLES = (
    ("delay", "rate_limit", "backlash"), ("delay", "rate_limit", "deadband"), ("airload", "friction", "delay"),
    ("gain", "bias", "rate_limit"),
)  # fmt: skip
NOISES_DEG = (0.05, 0.1, 0.2)
_SEPARABLE_SIGMAS = 5.0
_SHOWS = 0.4
"""Over the noise: less than 15 % of its variance is what `explain` calls nothing."""
_SPREAD = 0.03
_FAIR = ("single", "pair", "triple")
"""Kinds of which those count that an excitation can tell."""


class Case(NamedTuple):
    """What is made; `level` is empty if nothing is hidden."""

    kind: str
    names: tuple[str, ...]
    level: str
    excitation: str
    noise_deg: float
    seed: int
    spread: float = 0.0


@dataclass(frozen=True, slots=True)
class Result:
    """What was made of a case."""

    case: Case
    score: Score
    seconds: float
    sizes: float
    """Rms of what is hidden, over the noise."""
    doubt: str
    sigmas: float
    """Best look-alike and how far it stays away; nobody and infinity without an effect of the catalogue."""
    shown: bool
    """Whether each of the effects changes the position."""
    linear: float
    """Share of the gap that a linear and a non-linear regression close."""
    nonlinear: float
    group: str
    """What PySINDy calls it; empty without it."""
    where: Seconds
    """Which seconds are rightly called bad."""

    @property
    def fair(self) -> bool:
        """Whether what is hidden is as large as the noise and the excitation can tell it from its look-alikes."""
        return self.sizes >= 1.0 and self.sigmas >= _SEPARABLE_SIGMAS and self.shown

    @property
    def silently_wrong(self) -> bool:
        """Whether the gap is said to be explained by a wrong name, or not to exist though the effect shows."""
        return self.score.silently_wrong and (bool(self.score.extra) or self.sizes >= _SHOWS)


def cases(seeds: Iterable[int], spread: float = 0.0, *, quick: bool = False) -> Iterator[Case]:
    """All that is measured; `quick`: one size and noise, flight and chirp."""
    levels = LEVELS[1:2] if quick else LEVELS
    ways = ("flight", "chirp") if quick else EXCITATIONS
    noises = NOISES_DEG[1:2] if quick else NOISES_DEG
    sets: dict[str, list[tuple[str, ...]]] = {
        "single": [(name,) for name in CATALOGUE],
        "pair": [*PAIRS],
        "triple": [*TRIPLES],
        "structural": [(name,) for name in STRUCTURAL],
        "outside": [(name,) for name in OUTSIDE],
    }
    for seed in seeds:
        for way in ways:
            for noise_deg in noises:
                yield from (Case("none", (), "", way, noise_deg, 100 * seed + k, spread) for k in range(8))
                for kind, names in sets.items():
                    for level in levels if kind == "single" else LEVELS[1:2]:
                        yield from (Case(kind, several, level, way, noise_deg, seed, spread) for several in names)


def judge(case: Case) -> Result:
    """Make the log, have it explained, and score the answer."""
    lot = np.random.default_rng([case.seed, *(ord(letter) for name in case.names for letter in name)])
    effects = {name: draw(lot, name, case.level) for name in case.names}
    nothing = case.kind == "none"
    disturbed = {"jitter_s": 0.003, "row_loss": 0.03} if nothing else {}
    record = hidden(case.seed, effects, case.excitation, case.noise_deg, spread=case.spread, **disturbed)
    with tempfile.TemporaryDirectory() as folder:
        answer = ask(write(record, Path(folder) / "log.csv"), SURFACE)
    floor_deg = float(np.hypot(case.noise_deg, CONVERTER_DEG / np.sqrt(12.0)))
    step_deg = effects.get("quantization", {}).get("step_deg", CONVERTER_DEG)
    plain = nothing or hidden(case.seed, {}, case.excitation, case.noise_deg, spread=case.spread)
    sizes = 0.0 if isinstance(plain, bool) else effect_rms_deg(record, plain) / floor_deg
    change = np.zeros(record.time_s.size) if isinstance(plain, bool) else change_deg(record, plain)
    alone = case.kind == "single"
    there = effects if alone or case.kind not in _FAIR else _shown(case, effects, record.clean_deg, floor_deg)
    doubt, sigmas = ("", np.inf)
    if case.kind in _FAIR and sizes >= 1.0:
        exact = hidden(case.seed, effects, case.excitation, case.noise_deg)
        doubt, sigmas = leftover_sigmas(exact, case.seed, effects, case.excitation, case.noise_deg)
    return Result(
        case=case,
        score=score(
            answer.said,
            there,
            float(np.hypot(case.noise_deg, step_deg / np.sqrt(12.0))),
            scattered=case.spread > 0.0,
            unseen=tuple(effects),
        ),
        seconds=answer.seconds,
        sizes=sizes,
        doubt=doubt,
        sigmas=sigmas,
        shown=len(there) == len(effects),
        linear=regression_closure(record, floor_deg, nonlinear=False) if alone else np.nan,
        nonlinear=regression_closure(record, floor_deg, nonlinear=True) if alone else np.nan,
        group=sindy_group(record) if alone and has_pysindy() else "",
        where=seconds_found(answer.said, record.time_s, change, floor_deg),
    )


def _shown(case: Case, effects: Effects, clean_deg: FloatArray, floor_deg: float) -> Effects:
    """Those of several effects without which the position would be another one."""
    shown = {}
    for name, values in effects.items():
        others = {other: effects[other] for other in effects if other != name}
        without = hidden(case.seed, others, case.excitation, case.noise_deg, spread=case.spread)
        if np.sqrt(np.mean((clean_deg - without.clean_deg) ** 2)) >= _SHOWS * floor_deg:
            shown[name] = values
    return shown


def report(results: Sequence[Result]) -> None:
    """Print all tables."""
    print(
        f"{len(results)} logs, {sum(one.score.conclusion == 'could_not_tell' for one in results)} without an answer\n"
    )
    print("Names (single, pair, triple: as large as the noise and separable)")
    header = ("", "logs", "first", "in set", "set size", "extra", "silently wrong", "explained")
    _table(
        header, (_names(*group) for group in _grouped(results, lambda one: f"{one.case.kind}, {one.case.excitation}"))
    )
    singles = [one for one in results if one.case.kind == "single"]
    several = [one for one in results if one.case.kind in ("pair", "triple")]
    print("\nSeveral effects, all of them; single effects by size and by noise, all of them")
    every = _grouped(several, lambda one: f"{one.case.kind}, {one.case.excitation}", fair=False)
    _table(header, (_names(*group) for group in every))
    _table(header, (_names(*group) for group in _grouped(singles, lambda one: f"{one.case.level}", fair=False)))
    _table(header, (_names(*group) for group in _grouped(singles, lambda one: f"{one.case.noise_deg} deg", fair=False)))
    print("\nConfusion: hidden, first name (fair single effects)")
    for name, group in _grouped(singles, lambda one: one.case.names[0]):
        first = Counter(one.score.named[0] if one.score.named else one.score.conclusion for one in group)
        print(f"  {name:22s}", ", ".join(f"{what} {count}" for what, count in first.most_common()))
    print("\nNot separable by their excitation")
    lost = Counter(
        (" + ".join(one.case.names), one.doubt, one.case.excitation)
        for one in (*singles, *several)
        if one.sizes >= 1.0 and one.shown and not one.fair
    )
    print("  " + ("; ".join(f"{a} as {b} in {way}: {n}" for (a, b, way), n in lost.most_common()) or "none"))
    _print_sizes(singles)
    _print_rest(results, singles)


def _grouped(
    results: Iterable[Result], key: Callable[[Result], str], *, fair: bool = True
) -> Iterator[tuple[str, list[Result]]]:
    groups: dict[str, list[Result]] = defaultdict(list)
    for one in results:
        if one.fair or one.case.kind not in _FAIR or not fair:
            groups[key(one)].append(one)
    yield from groups.items()


def _names(label: str, group: list[Result]) -> tuple[str, ...]:
    scores = [one.score for one in group]
    with_steps = [one.set_size for one in scores if one.named]
    return (
        label,
        str(len(scores)),
        _percent(one.first for one in scores),
        _percent(one.in_set for one in scores),
        f"{np.mean(with_steps):.2f}" if with_steps else "",
        _percent(bool(one.extra) for one in scores),
        str(sum(one.silently_wrong for one in group)),
        _percent(one.conclusion == "explained" for one in scores),
    )


def _print_sizes(singles: list[Result]) -> None:
    errors, covered = defaultdict(list), defaultdict(list)
    for one in singles:
        if one.fair:
            for name, error in one.score.errors.items():
                errors[one.case.excitation, name].append(error)
            for name, inside in one.score.covered.items():
                covered[one.case.excitation, name].append(inside)
    print("\nParameters of rightly named effects: median error, share of 95 % intervals that hold the truth")
    _table(
        ("", "logs", "error", "covered"),
        (
            (", ".join(key), str(len(of)), f"{100.0 * np.median(of):.2f} %", _percent(covered[key]))
            for key, of in sorted(errors.items())
        ),
    )


def _print_rest(results: Sequence[Result], singles: list[Result]) -> None:
    nothing = [one for one in results if one.case.kind == "none"]
    outside = [one for one in results if one.case.kind == "outside"]
    fair = [one for one in singles if one.fair]
    several = [one for one in results if one.case.kind in ("pair", "triple")]
    print("\nNothing hidden, called so:", _percent(one.score.conclusion == "nothing_missing" for one in nothing))
    doubted = ("unexplained", "partly_explained")
    told = [one.score.conclusion in doubted or (one.score.fault and not one.score.named) for one in outside]
    print("Outside the catalogue, called so or a fault:", _percent(told))
    print("At least one of several named:", _percent(one.score.found > 0 for one in several))
    print("In set (all of several) or declared indistinguishable, at least as large as the noise:", end=" ")
    print(_percent(one.score.in_set for one in [*fair, *several]))
    _print_where(nothing, [one for one in singles if one.case.names != ("quantization",)])
    ratio = _known(one.score.floor_ratio for one in fair)
    took_s = _known(one.seconds for one in fair)
    print("Held-out rms of at most 1.03 times the noise:", _percent(one <= 1.03 for one in ratio))
    print("Gap closed, median and lowest tenth:", _spread(one.score.closure for one in fair))
    print(
        "  linear regression:",
        _spread(one.linear for one in fair),
        "  non-linear:",
        _spread(one.nonlinear for one in fair),
    )
    if has_pysindy():
        grouped = [one for one in fair if one.case.names[0] in GROUPS]
        for way, group in _grouped(grouped, lambda one: one.case.excitation):
            right = _percent(one.group == GROUPS[one.case.names[0]] for one in group)
            print(f"  PySINDy names the right group, {way}: {right}")
    else:
        print("  PySINDy is not installed")
    if took_s.size:
        print(f"Time: median {np.median(took_s):.2f} s, slowest tenth from {np.quantile(took_s, 0.9):.2f} s")


def _print_where(nothing: Sequence[Result], singles: Sequence[Result]) -> None:
    """Whether the bad seconds are found: converter steps are in all of them, and left out."""
    for way, group in _grouped(singles, lambda one: one.case.excitation, fair=False):
        right, wrong, missed, _ = np.sum([one.where for one in group], axis=0).tolist()
        f1 = 2.0 * right / max(2 * right + wrong + missed, 1)
        print(f"Bad seconds, {way}: F1 {f1:.3f} ({right} rightly, {wrong} wrongly, {missed} missed)")
    if nothing:
        _, wrong, _, fine = np.sum([one.where for one in nothing], axis=0).tolist()
        print(f"Seconds called bad where nothing is hidden: {wrong} of {wrong + fine}")


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> None:
    for row in (header, *rows):
        print("  " + f"{row[0]:34s}" + "".join(f"{cell:>16s}" for cell in row[1:]))


def _percent(flags: Iterable[object]) -> str:
    known = [bool(flag) for flag in flags]
    return f"{100.0 * sum(known) / len(known):.1f} %" if known else ""


def _known(values: Iterable[float]) -> FloatArray:
    """Values that are numbers."""
    every = np.array(list(values), dtype=np.float64)
    return every[np.isfinite(every)]


def _spread(values: Iterable[float]) -> str:
    known = _known(values)
    return f"{100.0 * np.median(known):.1f} %, {100.0 * np.quantile(known, 0.1):.1f} %" if known.size else "unknown"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="effects of medium size, noise of 0.1 deg, flight and chirp"
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first one")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--spread", action="store_true", help="servos scatter by 3 %%")
    parser.add_argument("--only", metavar="TEXT", default="", help="only kinds and effects with this in their names")
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + options.seeds)
    every = cases(seeds, _SPREAD if options.spread else 0.0, quick=options.quick)
    wanted = [case for case in every if options.only in " ".join((case.kind, *case.names))]
    results = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for count, one in enumerate(pool.map(judge, wanted) if options.jobs > 1 else map(judge, wanted), 1):
            results.append(one)
            print(f"\r{count} of {len(wanted)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    report(results)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
