"""What hangs on a servo's shaft: an output that follows it, a flexible and loose linkage, the surface, its sensor.

None of it acts back on the shaft, so that it is carried on from one measurement to the next, along the positions and
speeds that the shaft had between. Between two of these the shaft is a cubic through both, and so what it drives is
exact: to a flexible tip and to a sensor that lags, a cubic is a sum of polynomials and a free motion.
"""

from __future__ import annotations

import math

from servofd.core.types import FloatArray
from servofd.servo.loop_steps import compiled, inlined, inner
from servofd.servo.physics import Physics

_KEPT, _FADE = 8, 5
"""Lengths of step of which is kept what fades within them, and how many numbers that are."""
_SAME_STEP_S = 1e-9
_SHORT_LAG_S, _FAST_RAD_S = 2e-3, 550.0
"""Below and above, half a step of the grid is too much for six terms of a series (1e-8)."""
_TOUCHING = 1.0 - 1e-9
_MOST_TURNS, _BISECTIONS = 4, 50
"""Of an output that cannot follow in a step: how often it meets the shaft again, and how an instant is located."""
(
    _FOLLOWED,
    _FLEXED,
    _SWING,
    _PLAYED,
    _LAGGED,
    _OLDER,
    _LATEST,
    _UP,
    _DOWN,
    _NATURAL,
    _DAMPING,
    _TURN,
    _HALF,
    _GAIN,
    _QUADRATIC,
    _CUBIC,
    _LOWER,
    _UPPER,
    _BIAS,
    _LAG_S,
    _FADES,
) = range(21)
_GRID = _FADES + _FADE * _KEPT
_GRID_S, _ON_GRID = 2.5e-4, 48
LINKAGE = _GRID + 3 * _ON_GRID
"""Numbers that a linkage remembers: its positions, its sizes, and what fades."""


@inlined
def deflected(link: FloatArray, played: float) -> float:
    """Deflection of the surface, from the position of the servo at the end of its play [deg]."""
    bent = 1.0 + played * (link[_QUADRATIC] + played * link[_CUBIC])
    return float(max(min(link[_GAIN] * played * bent, link[_UPPER]), link[_LOWER]) + link[_BIAS])


@inlined
def _climb(link: FloatArray, played: float, speed: float) -> float:
    """Speed of the surface [deg/s]."""
    bent = 1.0 + played * (link[_QUADRATIC] + played * link[_CUBIC])
    free = link[_LOWER] < link[_GAIN] * played * bent < link[_UPPER]
    steep = 1.0 + played * (2.0 * link[_QUADRATIC] + 3.0 * played * link[_CUBIC])
    return float(link[_GAIN] * steep * speed) if free else 0.0


@inner
def _exactly(link: FloatArray, at: int, h: float) -> None:
    """What a step leaves of a sensor's lag, and cosine and sine of a tip's free swing."""
    if link[_LAG_S] > 0.0:
        link[at] = math.exp(-h / link[_LAG_S])
    if link[_NATURAL] > 0.0:
        damping = link[_DAMPING]
        decay, turn = math.exp(-damping * link[_NATURAL] * h), link[_NATURAL] * math.sqrt(1.0 - damping * damping)
        link[at + 1], link[at + 2] = decay * math.cos(turn * h), decay * math.sin(turn * h)


@inlined
def _fade(link: FloatArray, at: int, h: float) -> None:
    """Keep the length of a step, what it leaves, and 1/h: from that of a length nearby, if that is near enough."""
    link[at], link[at + 4] = h, 1.0 / h
    k = int(h / _GRID_S + 0.5)
    lag_s, natural = link[_LAG_S], link[_NATURAL]
    if k >= _ON_GRID or 0.0 < lag_s < _SHORT_LAG_S or natural > _FAST_RAD_S:
        _exactly(link, at + 1, h)
    else:
        rest, k = h - k * _GRID_S, _GRID + 3 * k
        if lag_s > 0.0:
            z = rest / lag_s
            link[at + 1] = link[k] * (1.0 - z * (1.0 - z * (0.5 - z * (1.0 / 6.0 - z * (1.0 / 24.0 - z / 120.0)))))
        if natural > 0.0:
            z = rest * link[_DAMPING] * natural
            decay = 1.0 - z * (1.0 - z * (0.5 - z * (1.0 / 6.0 - z * (1.0 / 24.0 - z / 120.0))))
            z = rest * link[_TURN]
            cosine, sine = 1.0 - z * z * (0.5 - z * z * (1.0 / 24.0)), z * (1.0 - z * z * (1.0 / 6.0 - z * z / 120.0))
            link[at + 2] = decay * (link[k + 1] * cosine - link[k + 2] * sine)
            link[at + 3] = decay * (link[k + 2] * cosine + link[k + 1] * sine)


@compiled
def begin_linkage(link: FloatArray, physics: Physics) -> bool:
    """Take over the sizes of a servo's linkage; whether any of it remembers where it was."""
    link[_UP], link[_DOWN] = physics.follow_up_deg_s, physics.follow_down_deg_s
    link[_NATURAL], link[_DAMPING] = 2.0 * math.pi * physics.resonance_hz, physics.resonance_damping
    link[_HALF], link[_LAG_S] = 0.5 * physics.backlash_deg, physics.lag_s
    link[_GAIN], link[_QUADRATIC], link[_CUBIC] = physics.gain, physics.quadratic_per_deg, physics.cubic_per_deg2
    link[_LOWER], link[_UPPER], link[_BIAS] = physics.lower_deg, physics.upper_deg, physics.bias_deg
    link[_TURN] = link[_NATURAL] * math.sqrt(1.0 - link[_DAMPING] * link[_DAMPING])
    if link[_NATURAL] > 0.0 or link[_LAG_S] > 0.0:
        for k in range(_ON_GRID):
            _exactly(link, _GRID + 3 * k, k * _GRID_S)
        for k in range(_FADES, _GRID, _FADE):
            if link[k] > 0.0:
                _fade(link, k, link[k])
    follows = link[_UP] < math.inf or link[_DOWN] < math.inf
    return follows or link[_HALF] > 0.0 or link[_NATURAL] > 0.0 or link[_LAG_S] > 0.0


@compiled
def rest_linkage(link: FloatArray, shaft: float, seen_deg: float) -> None:
    """All at rest where the shaft is [deg]."""
    link[_FOLLOWED] = link[_FLEXED] = link[_PLAYED] = shaft
    link[_SWING], link[_LAGGED] = 0.0, seen_deg
    link[_OLDER] = link[_LATEST] = _FADES
    for k in range(_FADES, _GRID, _FADE):
        link[k] = -1.0


@inlined
def _faded(link: FloatArray, h: float) -> int:
    """Where the numbers for a length of step are kept; made, if it is new, in the place of the last but one."""
    at = int(link[_OLDER])
    if abs(link[at] - h) >= _SAME_STEP_S:  # most often two lengths take turns
        for k in range(_FADES, _GRID, _FADE):
            if abs(link[k] - h) < _SAME_STEP_S:
                at = k
        if abs(link[at] - h) >= _SAME_STEP_S:
            at = at + _FADE if at + _FADE < _GRID else _FADES
            _fade(link, at, h)
    link[_OLDER], link[_LATEST] = link[_LATEST], at
    return at


@inlined
def _bends(h_inverse: float, by: float, slopes: tuple[float, float]) -> tuple[float, float, float]:
    """Second derivative at both ends and third of the cubic that moves on `by` in a step, from both slopes."""
    mean = by * h_inverse
    jerk = 6.0 * h_inverse * h_inverse * (slopes[0] + slopes[1] - 2.0 * mean)
    first = h_inverse * (6.0 * mean - 4.0 * slopes[0] - 2.0 * slopes[1])
    return first, h_inverse * (4.0 * slopes[1] + 2.0 * slopes[0] - 6.0 * mean), jerk


@inlined
def _too_fast(slower: float, bent: float, turned: float) -> float:
    """When a speed that is so much below a limit first passes it, growing by `bent` t + `turned` t^2; 2 if never."""
    if slower < 0.0:
        return 0.0
    root = bent * bent + 4.0 * turned * slower
    if root < 0.0 or bent + math.sqrt(root) <= 0.0:
        return 2.0
    return min(2.0 * slower / (bent + math.sqrt(root)), 2.0)


@inner
def _limited(followed: float, shaft: tuple[float, float, float, float], up: float, down: float) -> float:
    """Where an output is after a step of the shaft that it may be unable to follow, from the instant on that it is.

    In shares of the step, in which the shaft is a cubic and the output no faster than `up` and `down`.
    """
    x0, x1, x2, x3 = shaft
    end, now, way = x0 + x1 + x2 + x3, 0.0, 0.0
    if followed != x0:
        way = 1.0 if x0 > followed else -1.0
    for _ in range(_MOST_TURNS):
        if way == 0.0:
            speed, bent = x1 + now * (2.0 * x2 + 3.0 * now * x3), 2.0 * x2 + 6.0 * now * x3
            rises, falls = _too_fast(up - speed, bent, 3.0 * x3), _too_fast(down + speed, -bent, -3.0 * x3)
            now += min(rises, falls)
            if now >= 1.0:
                return end
            way, followed = 1.0 if rises < falls else -1.0, x0 + now * (x1 + now * (x2 + now * x3))
        rate = up if way > 0.0 else -down
        reached = followed + rate * (1.0 - now)
        if way * (reached - end) < 0.0:
            return reached
        low, high = now, 1.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if way * (followed + rate * (middle - now) - (x0 + middle * (x1 + middle * (x2 + middle * x3)))) < 0.0:
                low = middle
            else:
                high = middle
        now, way = high, 0.0
    return end


@compiled
def carried(  # noqa: PLR0915 - one function, because calls would take most of its time
    link: FloatArray, notes: FloatArray, noted: int, result: FloatArray, n: int, last: int
) -> None:
    """Move on along steps of the shaft, shape (noted, 5): length, and position and speed at both ends.

    What the sensor reads replaces in the result, from `n` to before `last`, how many steps were taken until then.
    """
    followed, flexed, swing, played = link[_FOLLOWED], link[_FLEXED], link[_SWING], link[_PLAYED]
    up, down, half, lag_s = link[_UP], link[_DOWN], link[_HALF], link[_LAG_S]
    follows, natural, damping = up < math.inf or down < math.inf, link[_NATURAL], link[_DAMPING]
    lagged = link[_LAGGED]
    flexes = natural > 0.0
    a1, a2, a3, turn, turn_inverse = 0.0, 0.0, 0.0, 0.0, 0.0
    if flexes:
        a1 = -2.0 * damping / natural
        a2 = (4.0 * damping * damping - 1.0) / (natural * natural)
        a3 = (4.0 - 8.0 * damping * damping) * damping / natural**3
        turn = link[_TURN]
        turn_inverse = 1.0 / turn
    fading = flexes or lag_s > 0.0
    at = _FADES
    for k in range(noted + 1):
        while n < last and result[n] == k:
            result[n] = lagged if lag_s > 0.0 else deflected(link, played)
            n += 1
        if k == noted:
            break
        h, from_deg, from_deg_s, to_deg, to_deg_s = notes[k, 0], notes[k, 1], notes[k, 2], notes[k, 3], notes[k, 4]
        if fading:
            at = _faded(link, h)
        if follows and (followed != from_deg or max(from_deg_s, to_deg_s) > up or min(from_deg_s, to_deg_s) < -down):
            by = to_deg - from_deg
            square, cube = 3.0 * by - h * (2.0 * from_deg_s + to_deg_s), h * (from_deg_s + to_deg_s) - 2.0 * by
            reached = _limited(followed, (from_deg, h * from_deg_s, square, cube), h * up, h * down)
            from_deg, to_deg = followed, reached
            from_deg_s = to_deg_s = (to_deg - from_deg) / h
        followed = to_deg
        rate, before = from_deg_s, flexed
        if flexes:
            bend, bend_end, jerk = _bends(link[at + 4], to_deg - from_deg, (from_deg_s, to_deg_s))
            away = flexed - (from_deg + a1 * from_deg_s + a2 * bend + a3 * jerk)
            speed = swing - (from_deg_s + a1 * bend + a2 * jerk)
            rate, free = swing, (speed + damping * natural * away) * turn_inverse
            flexed = to_deg + a1 * to_deg_s + a2 * bend_end + a3 * jerk + away * link[at + 2] + free * link[at + 3]
            swing = to_deg_s + a1 * bend_end + a2 * jerk + speed * link[at + 2]
            swing -= (away * turn + damping * natural * free) * link[at + 3]
        else:
            flexed, swing = to_deg, to_deg_s
        was = played
        if half > 0.0:
            if rate * swing < 0.0:  # it went further than where it is
                s = rate / (rate - swing)
                by = flexed - before
                peak = s * (h * rate + s * (3.0 * by - h * (2.0 * rate + swing) + s * (h * (rate + swing) - 2.0 * by)))
                played = max(min(played, before + peak + half), before + peak - half)
            played = max(min(played, flexed + half), flexed - half)
        else:
            played = flexed
        if lag_s > 0.0:
            moving = half <= 0.0 or abs(was - before) >= _TOUCHING * half
            slope = _climb(link, was, rate) if moving else 0.0
            moving = half <= 0.0 or abs(played - flexed) >= _TOUCHING * half
            slope_end = _climb(link, played, swing) if moving else 0.0
            static, static_end = deflected(link, was), deflected(link, played)
            bend, bend_end, jerk = _bends(link[at + 4], static_end - static, (slope, slope_end))
            relaxed = static - lag_s * (slope - lag_s * (bend - lag_s * jerk))
            relaxed_end = static_end - lag_s * (slope_end - lag_s * (bend_end - lag_s * jerk))
            lagged = relaxed_end + link[at + 1] * (lagged - relaxed)
    link[_FOLLOWED], link[_FLEXED], link[_SWING], link[_PLAYED], link[_LAGGED] = followed, flexed, swing, played, lagged
