"""The one stepper: servos on their way from event to event, each under the same commands.

Between events (a command that takes effect, a position that is measured) a linear servo moves by matrices, exactly for
any step. Where an effect bends it, steps are short: what drives the loop beside its own error (`push`) and what loads
it (`pull`) are taken in the middle of a step and held; friction is the deceleration that would stop the shaft by the
end of the step, as far as its strength goes (docs/explain.md, E5 to E7).

`servofd.servo.generate` replaces the functions of the slots, which here do nothing, by those of all effects. Names of
arrays: `p` (V, sizes) are the sizes of V servos, `m` (V, memory) is what their effects remember; the first column of
`m` is what left each servo last.
"""

from __future__ import annotations

import math

from logparsers.compiled import compile_steps
from servofd.core.types import BoolArray, FloatArray
from servofd.servo.effect import Now

# Slots begin here.
GAIN = BIAS = -1
"""Where in `p` gain and zero of the reading stand; nowhere."""


def command(x: float, now: Now, p: FloatArray, v: int, m: FloatArray) -> float:
    """What passes a slot; without effects, unchanged."""
    return x


error = load = grip = speed = stop = output = reading = command


def rest(x: float, u: float, now: Now, p: FloatArray, v: int, m: FloatArray) -> None:
    """All effects at rest, the shaft at x and the command at u."""
    m[v, 0] = x


# Slots end here.


NO_STEP_S = 1e-12
"""Shorter than the rounding of a time stamp after an hour: no step."""
_SAME_S = 5e-13
"""So close to the grid, no servo moves by 1e-9 deg."""
_TINY_S = 1e-9
"""So short, the first term of the series is all of it."""
_TERMS = 8
"""Of the series of half a step of the grid: what is left is below 1e-16."""
_BENT_TERMS = 5
"""Of the same where something acts on the servo: what is left is below 1e-10, of a step in which that is held."""
_FAR_DEG = 2e6
"""An overbalanced surface that its servo no longer holds goes no further."""


@compile_steps(kind="inlined")
def departs(x: FloatArray, v: int, a: FloatArray, b: FloatArray, out: int, u: float) -> float:
    """Speed of one of the n states of the servo v."""
    n, total = x.shape[1] // 3, b[v, 3 * out] * u
    for j in range(n):
        total += a[v, n * out + j] * x[v, j]
    return float(total)


@compile_steps(kind="inlined")
def nudge(
    x: FloatArray, v: int, a: FloatArray, b: FloatArray, h: float, u: float, s: float, push: float, pull: float,
    terms: int,
) -> None:  # fmt: skip
    """Move the servo v on by a small h: Taylor's series of its n states, in the other 2 n columns of `x`."""
    n, part, rate, by = x.shape[1] // 3, h, a[v], b[v]
    for i in range(n):
        x[v, n + i] = departs(x, v, a, b, i, u) + by[3 * i + 1] * push + by[3 * i + 2] * pull
    for i in range(n):
        x[v, i] += h * x[v, n + i]
    for k in range(2, terms if abs(h) > _TINY_S else 2):
        part *= h / k
        for i in range(n):
            total = by[3 * i] * s if k == 2 else 0.0
            for j in range(n):
                total += rate[n * i + j] * x[v, n + j]
            x[v, 2 * n + i] = total
        for i in range(n):
            x[v, n + i] = x[v, 2 * n + i]
            x[v, i] += part * x[v, n + i]


@compile_steps(kind="inlined")
def advance(
    x: FloatArray, v: int, a: FloatArray, b: FloatArray, steps: FloatArray, grid_s: float, h: float, u: float, s: float,
    push: float, pull: float, terms: int,
) -> None:  # fmt: skip
    """Move the servo v on by h, under a command u that runs on at s, and what pushes and pulls it meanwhile."""
    n, last = x.shape[1] // 3, steps.shape[1] - 1
    while h > 0.0:
        k = min(int(h / grid_s + 0.5), last)
        left, row = h - k * grid_s, steps[v, k]
        for i in range(n):
            total, first = 0.0, (n + 4) * i
            for j in range(n):
                total += row[first + j] * x[v, j]
            total += row[first + n] * u + row[first + n + 1] * s
            x[v, n + i] = total + row[first + n + 2] * push + row[first + n + 3] * pull
        for i in range(n):
            x[v, i] = x[v, n + i]
        u += k * grid_s * s
        if left <= 0.5 * grid_s:
            if abs(left) > _SAME_S:
                nudge(x, v, a, b, left, u, s, push, pull, terms)
            left = 0.0
        h = left


@compile_steps(kind="outer")
def run(
    p: FloatArray, acts: BoolArray, facts: FloatArray, a: FloatArray, b: FloatArray, steps: FloatArray,
    at_rest: FloatArray, grid_s: float, longest_s: float,
    effective_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray,
    at_s: FloatArray, anew: BoolArray, measured_deg: FloatArray, around: FloatArray,
    clock: FloatArray, x: FloatArray, m: FloatArray, read_deg: FloatArray, speed_deg_s: FloatArray,
) -> int:  # fmt: skip
    """Move V servos on to each of some instants; what their sensors read goes into `read_deg` (instants, V).

    Call it again with later instants, and with the commands from the returned number on, to go on from where `clock`,
    `x` and `m` stand.

    Parameters
    ----------
    p, m : ndarray, shape (V, sizes) and (V, memory)
    acts : ndarray of bool, shape (9,)
        Which slots act on any of the servos, in their order from the command to the reading; then whether steps must
        be short.
    facts : ndarray, shape (V, 5)
        Of each loop: gain, `error_s`, `per_error`, which state leaves it, and whether its slow pole filters.
    a, b, steps, at_rest
        Of the loops (`servofd.servo.loop.Loop`), one after the other; `grid_s` is common to them.
    longest_s : float
        Longest step while effects act [s].
    effective_s, command_deg, slope_deg_s : ndarray, shape (c,)
        When commands reach the servo [s], what they ask for [deg], and their slope [deg/s].
    at_s : ndarray, shape (k,)
        Instants [s], rising.
    anew, measured_deg : ndarray, shape (k,) or (0,)
        Where the servos begin anew, at rest where they were measured, or where their command wants them if that is NaN.
    around : ndarray, shape (k, 5) or (0, 5)
        Dynamic pressure [Pa], supply [V], supply over the usual one, current [A], load; each until its instant.
    clock : ndarray, shape (4,)
        Time [s], NaN at first; command in force and its slope; whether any came.
    speed_deg_s : ndarray, shape (k,) or (0,)
        Speed of the first shaft.
    """
    commands, instants, count = effective_s.size, at_s.size, p.shape[0]
    now_s, u, s, commanded = clock[0], clock[1], clock[2], clock[3] > 0.0
    commanding, erring, loaded, has_friction, is_rate_limited, stops, hangs, reads, bends = (
        acts[0], acts[1], acts[2], acts[3], acts[4], acts[5], acts[6], acts[7], acts[8],
    )  # fmt: skip
    inside = commanding or erring or loaded or has_friction or is_rate_limited or stops
    logged = around.shape[0] > 0
    pressure, supply, power, current, external = 0.0, math.inf, 1.0, 0.0, 0.0
    # The last step of an interval is up to half as long again, and none is longer than those that are kept.
    whole = max(min(int(longest_s / grid_s + 1e-9), (2 * (steps.shape[1] - 1)) // 3), 1)
    whole_s, per_whole = whole * grid_s, 1.0 / (whole * grid_s)
    c, k = 0, 0
    while k < instants:
        if math.isnan(now_s) or (k < anew.size and anew[k]):
            first = c
            while c < commands and effective_s[c] <= at_s[k]:
                c += 1
            measured = measured_deg[k] if k < measured_deg.size else math.nan
            if c > first:
                u, s = command_deg[c - 1] + slope_deg_s[c - 1] * (at_s[k] - effective_s[c - 1]), slope_deg_s[c - 1]
                commanded = True
            elif commanded:
                u += s * (at_s[k] - now_s)
            elif math.isnan(measured):  # the first command to come, unless they begin anew before that
                end = k + 1
                while end < anew.size and not anew[end]:
                    end += 1
                awaited = c < commands and (end >= anew.size or effective_s[c] <= at_s[end - 1])
                u, s = command_deg[c] if awaited else 0.0, 0.0
            else:  # what holds it can only have been an earlier command
                u, s = (measured - (p[0, BIAS] if BIAS >= 0 else 0.0)) / (p[0, GAIN] if GAIN >= 0 else 1.0), 0.0
                u /= facts[0, 0]
            still = Now(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, pressure, supply, power, current, external, 0.0, 0.0)
            for v in range(count):
                rest(0.0, u, still, p, v, m)
                shaft = command(u, still, p, v, m) * facts[v, 0]
                if not math.isnan(measured):
                    shaft = (measured - (p[v, BIAS] if BIAS >= 0 else 0.0)) / (p[v, GAIN] if GAIN >= 0 else 1.0)
                for i in range(at_rest.shape[1]):
                    x[v, i] = at_rest[v, i] * shaft / facts[v, 0]
                rest(shaft, u, still, p, v, m)
            now_s = at_s[k]
        arrives = c < commands and effective_s[c] <= at_s[k]
        until = max(effective_s[c], now_s) if arrives else at_s[k]
        left = until - now_s
        if left > NO_STEP_S:
            if logged:
                pressure, supply, power, current, external = (
                    around[k, 0], around[k, 1], around[k, 2], around[k, 3], around[k, 4],
                )  # fmt: skip
            many = max(int(left * per_whole + 0.5), 1) if bends else 1
            last = left - (many - 1) * whole_s
            for n in range(many):
                h = whole_s if n < many - 1 else last
                q = int(h / grid_s + 0.5)
                come = u + s * n * whole_s
                for v in range(count):
                    gain, error_s, per_error = facts[v, 0], facts[v, 1], facts[v, 2]
                    away, out, was, parted = 0.0, int(facts[v, 3]), 0.0, 0.0
                    if hangs:
                        was, parted = x[v, out], departs(x, v, a, b, out, come)
                    if not inside:
                        advance(x, v, a, b, steps, grid_s, h, come, s, 0.0, 0.0, _TERMS)
                        shaft = x[v, out]
                    else:
                        y, fast, w = x[v, 0], x[v, 1], x[v, 2]
                        middle = y + 0.5 * h * fast
                        now = Now(
                            h, middle * gain, fast * gain, error_s, 0.0, 0.0,
                            pressure, supply, power, current, external, 0.0, 0.0,
                        )  # fmt: skip
                        wanted, slope = come, s
                        if commanding:  # its mean over the step
                            mean = command(come + 0.5 * h * s, now, p, v, m)
                            if mean != come + 0.5 * h * s:
                                wanted, slope = mean, 0.0
                        row, rate, by = steps[v, q], a[v], b[v]
                        asked = wanted + 0.5 * h * slope
                        if facts[v, 4] > 0.0:
                            asked = 0.5 * (w + row[16] * w + row[17] * wanted + row[18] * slope)
                        push, pull, bent = 0.0, 0.0, asked - middle
                        if erring:
                            bent = error(asked - middle, now, p, v, m)
                            push = bent - (asked - middle)
                        if loaded:
                            away = load(0.0, now, p, v, m)
                            pull = -per_error * away / gain
                        advance(x, v, a, b, steps, grid_s, h, wanted, slope, push, pull, _BENT_TERMS)
                        y1, v1, w1 = x[v, 0], x[v, 1], x[v, 2]
                        if has_friction:
                            by_y, by_v, by_w, over = row[6], row[13], row[20], h - q * grid_s
                            by_y, by_v, by_w = (
                                by_y + over * (rate[0] * by_y + rate[1] * by_v + rate[2] * by_w + by[2]),
                                by_v + over * (rate[3] * by_y + rate[4] * by_v + rate[5] * by_w + by[5]),
                                by_w + over * (rate[6] * by_y + rate[7] * by_v + rate[8] * by_w + by[8]),
                            )
                            effort = abs(bent) if rate[5] != 1.0 else 0.5 * abs(w + w1) / per_error
                            slips = Now(
                                h, middle * gain, fast * gain, error_s, effort * gain, away,
                                pressure, supply, power, current, external, 0.0, 0.0,
                            )  # fmt: skip
                            limit = per_error * grip(0.0, slips, p, v, m) / gain
                            brake = min(max(-v1 / by_v, -limit), limit)
                            held = abs(brake) < limit
                            y1 = y if held and fast == 0.0 else y1 + by_y * brake
                            v1 = 0.0 if held else v1 + by_v * brake
                            w1 += by_w * brake
                        if is_rate_limited:
                            most = speed(v1 * gain, now, p, v, m)
                            if most != v1 * gain:
                                most /= gain
                                y1, v1 = y + 0.5 * h * (min(max(fast, -abs(most)), abs(most)) + most), most
                        if stops:
                            kept = stop(y1 * gain, now, p, v, m)
                            if kept != y1 * gain:
                                y1, v1 = kept / gain, 0.0
                        if not abs(y1) < _FAR_DEG:
                            y1 = 0.0 if math.isnan(y1) else min(max(y1, -_FAR_DEG), _FAR_DEG)
                            v1 = w1 = 0.0
                        x[v, 0], x[v, 1], x[v, 2] = y1, v1, w1
                        shaft = x[v, out]
                    if hangs:
                        arriving = departs(x, v, a, b, out, come + s * h)
                        middle = 0.5 * (was + shaft) + 0.125 * h * (parted - arriving)  # of a cubic
                        then = Now(
                            h, middle * gain, parted * gain, error_s, 0.0, away,
                            pressure, supply, power, current, external, (shaft - was) * gain, arriving * gain,
                        )  # fmt: skip
                        m[v, 0] = output(shaft * gain, then, p, v, m)
        if left > NO_STEP_S:
            u += s * left
        if until > now_s:  # noqa: PLR1730 - of a stamp that goes back, or is none, nothing is known
            now_s = until
        if arrives:
            u, s, commanded = command_deg[c], slope_deg_s[c], True
            c += 1
            continue
        if logged:
            current = around[k, 3]
        still = Now(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, pressure, supply, power, current, external, 0.0, 0.0)
        for v in range(count):
            seen = x[v, int(facts[v, 3])] * facts[v, 0]
            if hangs:
                seen = m[v, 0] if bends else output(seen, still, p, v, m)
            if reads:
                seen = reading(seen, still, p, v, m)
            read_deg[k, v] = seen
        if k < speed_deg_s.size:
            speed_deg_s[k] = x[0, 1] * facts[0, 0]
        k += 1
    clock[0], clock[1], clock[2], clock[3] = now_s, u, s, 1.0 if commanded else 0.0
    return c
