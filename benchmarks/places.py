"""Servos of another structure than any model's: a loop whose slow pole is before or after it, or inside.

A position loop of second order (thesis Eq. 3.1 without its slow pole) turns a shaft whose friction, speed and play
are integrated in steps of 0.25 ms; the slow pole filters the command, is a part of the loop (a winding), or filters
what the loop moves. Poles differ from those of the known servo by 3 %, damping by 6 %, and noise is white or has a
colour. It shares no code with servofd. **Even seeds choose constants, odd ones report.**

Run it for a table: ``python benchmarks/places.py 1 60`` explains the logs of the odd seeds from 1 to 60.
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["RATE_HZ", "Case", "case", "command", "moved", "score_line"]

Floats = NDArray[np.floating[Any]]
PLACES = ("before", "inside", "after")
STYLES = ("flight", "aerobatic", "doublets")
_STEP_S = 2.5e-4
_SLOW, _SUM, _PRODUCT = 24.84, 70.04, 4921.0
RATE_HZ, _DURATION_S = 50.0, 50.0
_SEEN = 0.4
"""Times the noise: what changes the motion by less is left out; nobody could see it."""
EFFECTS: Mapping[str, tuple[float, float]] = {
    "deadband": (0.6, 2.0),
    "friction": (0.3, 1.0),
    "backlash": (0.5, 1.6),
    "rate_limit": (25.0, 70.0),
    "voltage_rate": (6.0, 12.0),
    "gain": (0.75, 0.92),
    "bias": (0.5, 2.0),
    "delay": (0.012, 0.05),
    "slow_dynamics": (0.5, 0.8),
}
"""Ranges of the sizes that are drawn: degrees, degrees per second, per volt, seconds; log-uniform."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A log, and what is hidden in it."""

    seed: int
    place: str
    style: str
    colour: float
    truth: Mapping[str, float]
    noise_deg: float
    time_s: Floats
    command_deg: Floats
    measured_deg: Floats
    supply_v: Floats

    def table(self) -> bytes:
        """As a plain table."""
        sink = io.StringIO()
        sink.write("time_s,elevator_cmd_deg,elevator_pos_deg,servo_voltage_v\n")
        rows = np.column_stack([self.time_s, self.command_deg, self.measured_deg, self.supply_v])
        np.savetxt(sink, rows, fmt=["%.4f", "%.5f", "%.5f", "%.3f"], delimiter=",")
        return sink.getvalue().encode()


def case(seed: int) -> Case:
    """Draw a log.

    Examples
    --------
    >>> case(2).measured_deg.size
    2500
    """
    rng = np.random.default_rng([91, seed])
    place = PLACES[int(rng.choice(3, p=[0.5, 0.25, 0.25]))]
    style = str(rng.choice(STYLES))
    colour = float(rng.choice([0.0, 0.0, 0.8]))
    count = int(rng.choice(3, p=[0.15, 0.5, 0.35]))
    names = [str(name) for name in rng.permutation(list(EFFECTS))]
    chosen: list[str] = []
    for name in names:
        if len(chosen) == count:
            break
        limits = {"rate_limit", "voltage_rate", "slow_dynamics"}
        loose = {"deadband", "friction", "backlash"}
        if any({name, other} <= limits or {name, other} <= loose for other in chosen):
            continue
        chosen.append(name)
    truth = {name: float(np.exp(rng.uniform(*np.log(EFFECTS[name])))) for name in chosen}
    if "bias" in truth and rng.uniform() < 0.5:
        truth["bias"] *= -1.0
    noise_deg = float(rng.uniform(0.1, 0.3))
    time_s = np.arange(round(_DURATION_S * RATE_HZ)) / RATE_HZ
    asked = command(rng, style, time_s)
    supply = 6.0 - 0.8 * time_s / _DURATION_S - 0.3 * (np.sin(0.4 * time_s + rng.uniform(0.0, 6.0)) > 0.3)
    scales = np.exp(rng.normal(0.0, 0.03, 2)).tolist()
    damping = float(np.exp(rng.normal(0.0, 0.06)))

    def swung(there: Mapping[str, float]) -> Floats:
        return moved(place, there, scales, damping, asked, supply, late_s=late_s)

    late_s = 0.004 + float(rng.normal(0.0, 1e-3))
    whole, least = swung(truth), _SEEN * noise_deg
    if np.std(whole[time_s > 1.0]) < least:  # friction holds it for good, and nothing else can show
        truth.pop("friction")
        whole = swung(truth)
    unseen = [
        name
        for name in truth
        if np.std(whole - swung({other: size for other, size in truth.items() if other != name})) < least
        and (name != "bias" or abs(truth["bias"]) < least)
    ]
    shown = {name: size for name, size in truth.items() if name not in unseen}
    moved_deg = swung(shown) * (1.0 + rng.normal(0.0, 0.005))
    white = rng.normal(size=time_s.size)
    noise = white.copy()
    for k in range(1, noise.size):
        noise[k] = colour * noise[k - 1] + np.sqrt(1.0 - colour**2) * white[k]
    measured = moved_deg + rng.normal(0.0, 0.04) + noise_deg * noise
    return Case(seed, place, style, colour, shown, noise_deg, time_s, asked, measured, supply)


def moved(
    place: str,
    there: Mapping[str, float],
    scales: list[float],
    damping: float,
    command_deg: Floats,
    supply_v: Floats,
    *,
    late_s: float,
) -> Floats:
    """Deflection without noise [deg]; `scales` are of the slow pole and of the pair."""
    numbers = np.array(_numbers(place, there, scales, damping, there.get("slow_dynamics", 1.0)))
    late = max(there.get("delay", 0.0) + late_s, 0.0)
    turned: Floats = _moved(numbers, command_deg, supply_v, late)
    return turned * there.get("gain", 1.0) + there.get("bias", 0.0)


def _numbers(
    place: str, truth: Mapping[str, float], scales: list[float], damping: float, slow: float
) -> tuple[float, ...]:
    """What the compiled servo takes: place, slow pole, damping and stiffness of the pair, then what is hidden."""
    return (
        PLACES.index(place),
        _SLOW * scales[0] * slow,
        _SUM * damping * scales[1] * slow,
        _PRODUCT * scales[1] ** 2 * slow**2,
        0.5 * truth.get("deadband", 0.0),
        truth.get("friction", 0.0),
        0.3,
        8.0,
        truth.get("rate_limit", 1e9),
        truth.get("voltage_rate", 1e9),
        0.5 * truth.get("backlash", 0.0),
    )


def command(rng: np.random.Generator, style: str, time_s: Floats) -> Floats:
    """Degrees: turbulence and turns, brisk sticks, or steps either way with rests between."""
    if style == "doublets":
        out = np.zeros(time_s.size)
        for start_s in np.arange(1.0, time_s[-1], 2.5):
            size = float(rng.uniform(2.0, 9.0) * rng.choice([-1.0, 1.0]))
            length = rng.uniform(0.25, 0.7)
            out[(time_s >= start_s) & (time_s < start_s + length)] = size
            out[(time_s >= start_s + length) & (time_s < start_s + 2.0 * length)] = -size
        return out
    high = 1.2 if style == "flight" else 2.5
    size = 4.0 if style == "flight" else 9.0
    tones = rng.uniform(0.05, high, 24)
    total = np.sum([np.sin(2.0 * np.pi * f * time_s + rng.uniform(0.0, 6.28)) for f in tones], axis=0)
    swing = 0.5 + 0.5 * np.sin(2.0 * np.pi * time_s / rng.uniform(15.0, 30.0)) ** 2
    out = size * total / np.std(total) * swing
    rounded: Floats = np.round(np.clip(out, -25.0, 25.0), 3)
    return rounded


@njit(cache=True)  # type: ignore[untyped-decorator]
def _moved(numbers: Floats, command: Floats, supply: Floats, late_s: float) -> Floats:
    place, slow, total, product = numbers[0], numbers[1], numbers[2], numbers[3]
    half_dead, friction, extra, fade = numbers[4], numbers[5], numbers[6], numbers[7]
    rate, per_volt, half_play = numbers[8], numbers[9], numbers[10]
    inner = round(1.0 / RATE_HZ / _STEP_S)
    out = np.zeros(command.size)
    y = v = torque = filtered = after = 0.0
    y = filtered = after = played = command[0]
    for n in range(command.size):
        for k in range(inner):
            t = n * inner + k
            at = (t * _STEP_S - late_s) * RATE_HZ
            u = command[max(int(np.floor(at + 1e-9)), 0)] if at >= 0.0 else command[0]
            if place == 0.0:
                filtered += (u - filtered) * (1.0 - np.exp(-slow * _STEP_S))
                u = filtered
            error = u - y
            error = max(error - half_dead, 0.0) + min(error + half_dead, 0.0)
            most = min(rate, per_volt * supply[n])
            if place == 1.0:
                # third order: a winding between the error and the torque
                q = 0.8 * (slow + total)
                p = slow + total - q
                gain = slow * product
                r = product + slow * total - p * q
                reach = most * (slow * total + product) / gain
                error = min(max(error, -reach), reach)
                grip = friction * gain / q
                torque += _STEP_S * (-q * torque - r * v + gain * error)
                pull = torque - p * v
            else:
                reach = most * total / product
                if place == 2.0:
                    error = min(max(error, -reach), reach)
                grip = friction * product
                pull = product * error - total * v
            free = v + _STEP_S * pull
            hold = _STEP_S * grip * (1.0 + extra * np.exp(-((v / fade) ** 2)))
            v = free - min(max(free, -hold), hold)
            if place == 0.0:
                v = min(max(v, -most), most)
            y += _STEP_S * v
            x = y
            if place == 2.0:
                after += (x - after) * (1.0 - np.exp(-slow * _STEP_S))
                x = after
            played = min(max(played, x - half_play), x + half_play)
            if k == 0:
                out[n] = played
    return out


def score_line(one: Case) -> dict[str, Any]:
    """Explain a log as a user would, and say what the answer is worth."""
    sys.path.insert(0, str(Path(__file__).parent))
    from hidden_score import ask

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        path.write_bytes(one.table())
        answer = ask(path, "elevator", "--servo", "hs225bb-eq31")
    said = answer.said or {"conclusion": "could_not_tell", "steps": [], "indistinguishable": []}
    named = [step["effect"] for step in said["steps"]]
    offered = [{name}.union(*(set(g) for g in said["indistinguishable"] if name in g)) for name in named]
    in_set = all(any(name in names for names in offered) for name in one.truth) and len(named) == len(one.truth)
    return {
        "seed": one.seed,
        "place": one.place,
        "style": one.style,
        "colour": one.colour,
        "truth": {k: round(v, 4) for k, v in one.truth.items()},
        "named": named,
        "sets": [sorted(each) for each in offered],
        "first": set(named) == set(one.truth),
        "in_set": in_set,
        "conclusion": said["conclusion"],
        "wrong": said["conclusion"] in ("explained", "nothing_missing") and not in_set,
        "per_name": float(np.mean([len(each) for each in offered])) if offered else 1.0,
        "left": [note for note in said.get("notes", []) if note.startswith("left")],
        "seconds": answer.seconds,
    }


def main(words: list[str]) -> int:
    """Score a range of seeds."""
    first, last = int(words[0]), int(words[1])
    lines = []
    for seed in range(first, last + 1, 2):
        line = score_line(case(seed))
        lines.append(line)
        if "-v" in words or not line["in_set"] or line["conclusion"] not in ("explained", "nothing_missing"):
            print(line, flush=True)
    there = [line for line in lines if line["truth"]]
    nothing = [line for line in lines if not line["truth"]]
    seconds = [line["seconds"] for line in lines]
    print(
        f"{len(lines)} logs: named first {sum(line['first'] for line in there)} of {len(there)}, in the declared set "
        f"{sum(line['in_set'] for line in there)}, names per name {np.mean([line['per_name'] for line in there]):.2f}, "
        f"explained but wrong {sum(line['wrong'] for line in lines)}, nothing named on nothing "
        f"{sum(not line['named'] for line in nothing)} of {len(nothing)}, explained "
        f"{sum(line['conclusion'] in ('explained', 'nothing_missing') for line in lines)}; processor time "
        f"{np.median(seconds):.1f} s median, {np.quantile(seconds, 0.95):.1f} s 95 %"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
