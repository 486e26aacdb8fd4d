"""What a log and nothing else tells: flights of `strangers`, each servo fitted to the very log.

``python benchmarks/evidence.py [--first SEED] [--healthy N] [--each N] [--supply N]`` prints what becomes of healthy
flights, of flights of which one surface has a fault that sets in between 27 and 66 of 110 s and lasts to the end, and
of brisk flights in which all servos are left with a share of their speed at once. Styles (all but
taxi) are drawn in turn, kinds and sizes in all pairs. Constants were chosen on aircraft of even seed; odd ones are
reported.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

from strangers import ALL, SIZES, SURFACES, Failure, draw_failure, fly, stranger

import servofd

_FLIGHT_S = 110.0
_STYLES = ("mixed", "aerobatics", "turbulence", "loiter", "cruise")
_BRISK = _STYLES[:3]
"""In which each surface moves by several degrees a second."""
_WEAK = (1.0 / 3.0, 0.5, 2.0 / 3.0)
_ALIKE = {("floating", "stuck"), ("floating", "hardover"), ("stuck", "hardover"), ("stuck", "floating")}
"""A geared servo without power stays where it is, and where it stopped may be as far as it ever was."""


class Told(NamedTuple):
    """What was said of the surfaces of one flight."""

    seed: int
    style: str
    failure: Failure | None
    statuses: dict[str, str]
    kinds: tuple[str, ...]
    """Of the faults of the surface that has one."""
    clears: bool
    """Whether the exit code is 0."""


def told(case: tuple[int, str | None, str]) -> Told:
    """Fly one flight, and audit its table without any aircraft file."""
    seed, kind, size = case
    style = _STYLES[seed // 2 % len(_STYLES)]
    failure = None if kind is None else draw_failure(seed, _FLIGHT_S, kind, size)
    with tempfile.TemporaryDirectory() as folder:
        path = fly(stranger(seed), 1, style, duration_s=_FLIGHT_S, failure=failure).write(Path(folder) / "flight.csv")
        (found,) = servofd.audit(path)
    kinds = () if failure is None else tuple(fault.kind for fault in found[failure.surface].faults)
    statuses = {surface.surface: surface.status for surface in found.surfaces}
    return Told(seed, style, failure, statuses, kinds, not found.has_fault and not found.not_judged)


class Weak(NamedTuple):
    """What was said of a flight whose servos all lost speed at once."""

    at_fault: int
    is_supply: bool


def weak(case: tuple[int, float]) -> Weak:
    """Fly one of which all servos are left with a share of their speed from a moment on, and audit its table."""
    seed, share = case
    failure = Failure("slow", ALL, start_s=27.0 + seed % 40, size=share)
    with tempfile.TemporaryDirectory() as folder:
        style = _BRISK[seed // 2 % len(_BRISK)]
        flown = fly(stranger(seed), 1, style, duration_s=_FLIGHT_S, failure=failure)
        (found,) = servofd.audit(flown.write(Path(folder) / "flight.csv"))
    slow = sum(any(fault.kind == "slow" for fault in surface.faults) for surface in found.surfaces)
    return Weak(slow, any(cause.kind == "supply" for cause in found.common_causes))


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=5001, metavar="SEED")
    parser.add_argument("--healthy", type=int, default=48, metavar="N", help="healthy flights")
    parser.add_argument("--each", type=int, default=5, metavar="N", help="flights of each kind and size")
    parser.add_argument("--supply", type=int, default=0, metavar="N", help="flights of each share of the speed")
    options = parser.parse_args()
    plain = {kind for kind, sizes in SIZES.items() if len(set(sizes)) == 1}
    sized = [(kind, size) for kind in SIZES for size in ("large", "medium") if size == "large" or kind not in plain]
    wanted = [(None, "")] * options.healthy + sized * options.each
    cases = [(options.first + 2 * place, *each) for place, each in enumerate(wanted)]
    shares = [(options.first + 2 * place, share) for share in _WEAK for place in range(options.supply)]
    with ProcessPoolExecutor() as pool:
        results = list(pool.map(told, cases))
        weakened = list(pool.map(weak, shares))
    for share in _WEAK if shares else ():
        those = [one for one, (_, left) in zip(weakened, shares, strict=True) if left == share]
        members = sum(one.at_fault for one in those)
        said = sum(one.is_supply for one in those)
        whole = sum(one.at_fault == len(SURFACES) for one in those)
        print(f"all servos at {share:.0%} of their speed: {len(those)} flights, all members slow in {whole}, ", end="")
        print(f"{members} of {len(SURFACES) * len(those)} servos, supply named in {said}")
    if not results:
        return
    healthy = [one for one in results if one.failure is None]
    print(f"aircraft {cases[0][0]} to {cases[-1][0]}, every second")
    brisk = [one for one in healthy if one.style in _BRISK]
    cleared, briskly = (sum(one.clears for one in some) for some in (healthy, brisk))
    print(f"healthy flights: {len(healthy)}, cleared {cleared}; brisk ones: {len(brisk)}, cleared {briskly}")
    print("their surfaces:", dict(Counter(status for one in healthy for status in one.statuses.values())))
    others = [s for one in results if one.failure for name, s in one.statuses.items() if name != one.failure.surface]
    print("sound surfaces beside a faulty one:", dict(Counter(others)))
    for one in results:
        accused = [s for s, status in one.statuses.items() if status in ("fault", "suspect")]
        wrongly = [s for s in accused if one.failure is None or s != one.failure.surface]
        if wrongly:
            print(f"  {one.seed} {one.style}: {', '.join(wrongly)} wrongly accused")
    counts: Counter[tuple[str, str, str]] = Counter()
    for one, (_, kind, size) in zip(results, cases, strict=True):
        if one.failure is None or kind is None:
            continue
        status = one.statuses[one.failure.surface]
        named = any(found == kind or (kind, found) in _ALIKE for found in one.kinds)
        for key in {kind, "all"}:
            counts[size, key, status] += 1
            counts[size, key, "named"] += named
        if status != "fault":
            print(f"  {one.seed} {one.style}: {size} {kind} is {status}")
    for (size, kind, what), count in sorted(counts.items()):
        print(f"{size} {kind}: {what} {count}")


if __name__ == "__main__":
    main()
