"""How well faults are found and named: ``python benchmarks/detection.py [--seeds N] [--healthy N] [--workers N]``.

The fleet of `fleet.py` flies every style with every kind and size of fault, N seeds of each, and N healthy flights of
120 s. Printed are: names (confusion matrices), false alarms, delays beside the best that any detector could do
(`bound.py`), errors of the onset, whether probabilities mean what they say, and cost (`bank_cost.py`).

- A fault has enough motion if, after its onset, the healthy surface turns faster than 5 deg/s for at least 2 s in
  all, over a range of at least 4 deg. Other flights are shown by themselves.
- A fault that was not detected stays in every denominator, but for that of the column "right of detected".
- Delays of faults that show only in motion (stuck, dead band, slow, loss of effectiveness) are also counted from the
  first motion. A missed fault has an infinite delay, and takes part in medians.
- The bank dismisses some crossings of the threshold by what it sees after them, up to 16 s. The delay of a fault is
  that of its alarm all the same: what is late then is the dismissal of others.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from bank_cost import measure
from bound import KNOWN_ONSET, UNKNOWN_ONSET
from fleet import KINDS, SIZES, STYLES, cases
from trial import Case, Trial, trial

__all__ = ["fly", "limits", "main", "quantile", "tables"]

FLIGHT_S = 120.0
NAMES = (*KINDS, "unknown", "healthy", "suspect", "none")
PROBABILITIES = (0.0, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0)


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--seeds", type=int, default=8, help="of each style, kind and size")
    options.add_argument("--healthy", type=int, default=1000, help="healthy flights")
    options.add_argument("--first", type=int, default=0, help="first seed")
    options.add_argument("--workers", type=int, default=os.cpu_count())
    options.add_argument("--wrong", action="store_true", help="list every flight with a wrong name or a false alarm")
    given = options.parse_args()
    begin = time.perf_counter()
    faulty, healthy = fly(given.seeds, given.healthy, given.first, given.workers)
    for table in tables(faulty, healthy):
        print(table, end="\n\n")
    if given.wrong:
        print(*(_listed(one) for one in (*faulty, *healthy) if not _fine(one)), sep="\n", end="\n\n")
    with _pool(1) as pool:
        print("Cost, one thread, processor time:", pool.submit(measure).result())
    print(f"\n{len(faulty)} flights with a fault, {len(healthy)} without, in {time.perf_counter() - begin:.0f} s")


def fly(seeds: int, healthy: int, first: int, workers: int | None) -> tuple[list[Trial], list[Trial]]:
    """Trials with a fault, and without."""
    jobs = [Case(seed, *case) for seed in range(first, first + seeds) for case in cases() if case[1] is not None]
    well = [Case(first + n // len(STYLES), STYLES[n % len(STYLES)], None, "") for n in range(healthy)]
    with _pool(workers) as pool:
        trials = list(pool.map(trial, [*jobs, *well], chunksize=10))
    return trials[: len(jobs)], trials[len(jobs) :]


def tables(faulty: Sequence[Trial], healthy: Sequence[Trial]) -> Iterable[str]:
    """All that is printed, but for the cost."""
    visible = [one for one in faulty if one.enough_motion]
    large, small = ([one for one in visible if (one.case.size == "small") is little] for little in (False, True))
    yield confusion("Medium and large faults with enough motion", large)
    yield shares("The same, by style", large, lambda one: one.case.style)
    yield confusion("Small faults with enough motion", small)
    yield confusion(
        "Faults of any size with too little motion after them", [one for one in faulty if not one.enough_motion]
    )
    yield false_alarms(healthy, faulty)
    limit = limits(faulty)
    yield delays("Delay from the fault to the alarm, medium and large, enough motion [s]", large, limit)
    yield delays(
        "The same from the first motion", [one for one in large if one.motion_wait_s > 0.0], limit, motion=True
    )
    yield delays(
        "Steps (bias) of any size and motion [s]",
        [one for one in faulty if one.case.kind == "bias"],
        limit,
        by_size=True,
    )
    yield "Limits of the evidence, at an equal rate and with the onset known: " + ", ".join(
        f"{kind} {equal:.1f} and {known:.1f}" for kind, (known, equal) in limit.items()
    )
    yield onsets(large)
    yield calibration("Probabilities of names given, with enough motion", visible)
    yield calibration("The same with too little motion", [one for one in faulty if not one.enough_motion])


def confusion(title: str, trials: Sequence[Trial]) -> str:
    """True kinds down, names across."""
    names = Counter((one.case.kind, one.name) for one in trials)
    rows = [[kind, *(names[kind, name] or "." for name in NAMES), *_cells(trials, kind)] for kind in KINDS]
    rows.append(["all", *(sum(names[kind, name] for kind in KINDS) or "." for name in NAMES), *_cells(trials, None)])
    return _table(
        f"{title} ({len(trials)} flights)",
        ["", *NAMES, "right", "detected", "right of detected", "right or alternative"],
        rows,
    )


def shares(title: str, trials: Sequence[Trial], key: Callable[[Trial], str]) -> str:
    """Right names in each group."""
    groups = {name: [one for one in trials if key(one) == name] for name in dict.fromkeys(map(key, trials))}
    rows = [[name, len(group), *_cells(group, None)] for name, group in groups.items()]
    return _table(title, ["", "flights", "right", "detected", "right of detected", "right or alternative"], rows)


def false_alarms(healthy: Sequence[Trial], faulty: Sequence[Trial]) -> str:
    """Healthy flights in which each detector raised an alarm."""
    hours = len(healthy) * FLIGHT_S / 3600.0
    counts = {
        "constant 1.5 deg": sum(one.constant_peak >= 1.0 for one in healthy),
        "interval threshold": sum(one.interval_peak >= 1.0 for one in healthy),
        "bank": sum(one.alarms > 0 for one in healthy),
        "(suspicions)": sum(one.suspicions > 0 for one in healthy),
    }
    rows = [[name, count, f"{count / hours:.3g}"] for name, count in counts.items()]
    before = sum(one.alarms > 0 for one in faulty)
    peaks = np.percentile([one.interval_peak for one in healthy] or [np.nan], [50, 99, 100])
    return _table(
        f"Healthy flights with an alarm ({len(healthy)} flights, {hours:.1f} h)", ["", "flights", "per hour"], rows
    ) + (
        f"\nLargest |residual| / interval threshold: median {peaks[0]:.2f}, 99 % {peaks[1]:.2f}, largest {peaks[2]:.2f}"
        f"\nFlights with a fault and a false alarm before it: {before} of {len(faulty)}"
    )


def limits(faulty: Sequence[Trial]) -> dict[str, tuple[float, float]]:
    """Limits of evidence for each kind: with the onset known, and at an equal rate of false alarms."""
    noisiest = {kind: max((t.healthy_evidence for t in faulty if t.case.kind == kind), default=0.0) for kind in KINDS}
    return {kind: (max(KNOWN_ONSET, most), max(UNKNOWN_ONSET, most)) for kind, most in noisiest.items()}


def delays(
    title: str,
    trials: Sequence[Trial],
    limit: dict[str, tuple[float, float]],
    *,
    motion: bool = False,
    by_size: bool = False,
) -> str:
    """Median, 90 % and missed share of each detector, and the bounds."""
    groups: dict[str, list[Trial]] = {}
    for one in trials:
        groups.setdefault(_group(one, by_size), []).append(one)
    rows = []
    for name, group in groups.items():
        waits_s = [one.motion_wait_s if motion else 0.0 for one in group]
        columns = [
            [one.constant_delay_s for one in group],
            [one.interval_delay_s for one in group],
            [one.bank_delay_s for one in group],
            [one.bound_delay_s(limit[one.case.kind or ""][1]) for one in group],
            [one.bound_delay_s(limit[one.case.kind or ""][0]) for one in group],
        ]
        waited = [[d - w if np.isfinite(w) else np.inf for d, w in zip(c, waits_s, strict=True)] for c in columns]
        medians = [quantile(c, 0.5) for c in waited]
        worse = sum(i > c for c, i in zip(waited[0], waited[1], strict=True))
        rows.append([name, len(group), *map(_delay, waited), f"{medians[1] / medians[3]:.2f}", worse])
    head = [
        "",
        "flights",
        "constant",
        "interval",
        "bank",
        "bound",
        "onset known",
        "interval / bound",
        "later than constant",
    ]
    return _table(title + ": median / 90 % / missed", head, rows)


def onsets(trials: Sequence[Trial]) -> str:
    """Named minus true onset of rightly named faults."""
    rows = []
    for kind in KINDS:
        errors_s = [one.onset_error_s for one in trials if one.case.kind == kind and one.right]
        if errors_s:
            low, middle, high = np.percentile(errors_s, [10, 50, 90])
            rows.append([kind, len(errors_s), f"{middle:+.2f}", f"{low:+.2f}", f"{high:+.2f}"])
    return _table(
        "Onset, named minus true [s], medium and large, rightly named", ["", "flights", "median", "10 %", "90 %"], rows
    )


def calibration(title: str, trials: Sequence[Trial]) -> str:
    """Predicted probability of each name beside the share that was right."""
    named, rows = [one for one in trials if one.found is not None], []
    for low, high in itertools.pairwise(PROBABILITIES):
        group = [one for one in named if low < one.probability <= high or (low == 0.0 and one.probability == 0.0)]
        if group:
            predicted, right = np.mean([(one.probability, float(one.right)) for one in group], axis=0)
            rows.append([f"{low:g} to {high:g}", len(group), f"{predicted:.3f}", f"{right:.3f}"])
    return _table(title, ["", "flights", "predicted", "right"], rows)


def _cells(trials: Sequence[Trial], kind: str | None) -> list[str]:
    mine = [one for one in trials if kind in (None, one.case.kind)]
    found = [one for one in mine if one.found is not None]
    right, either = sum(one.right for one in mine), sum(one.among_named for one in mine)
    return [
        _percent(right, len(mine)),
        _percent(len(found), len(mine)),
        _percent(right, len(found)),
        _percent(either, len(mine)),
    ]


def _group(one: Trial, by_size: bool) -> str:
    kind = one.case.kind or ""
    if not by_size:
        return kind
    name, sizes = SIZES[kind]
    return f"{name} {sizes[one.case.size]:g}"


def _delay(values_s: Sequence[float]) -> str:
    missed = sum(not np.isfinite(value) for value in values_s)
    return f"{quantile(values_s, 0.5):.2f} {quantile(values_s, 0.9):.2f} {missed / len(values_s):.0%}"


def quantile(values: Sequence[float], share: float) -> float:
    """Of values some of which may be infinite: the smallest that at least this share does not exceed."""
    return sorted(values)[int(np.ceil(share * len(values))) - 1]


def _percent(count: int, of: int) -> str:
    return f"{count / of:.1%}" if of else "-"


def _fine(one: Trial) -> bool:
    if one.case.kind is None:
        return one.alarms == 0 and one.suspicions == 0
    return (one.right or not one.enough_motion) and one.alarms == 0


def _listed(one: Trial) -> str:
    counts = f"{one.alarms} false alarms, {one.suspicions} suspicions"
    return f"{one.case} at {one.start_s:.2f} s: {one.found or one.name}, {counts}"


def _table(title: str, head: Sequence[object], rows: Sequence[Sequence[object]]) -> str:
    texts = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in texts) for i in range(len(head))]
    lines = [
        "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in texts
    ]
    return "\n".join([title, *lines])


def _pool(workers: int | None) -> ProcessPoolExecutor:
    """Processes that start from scratch, in which linear algebra stays on one thread."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


if __name__ == "__main__":
    main()
