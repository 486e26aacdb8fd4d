"""Effects of what hangs on the shaft, in the order in which they lie between servo and surface."""

from __future__ import annotations

import math

from servofd.core.errors import ConfigError
from servofd.servo.effect import RARELY, SELDOM, Effect, Now, Parameter, Slot
from servofd.servo.effects.commands import LARGEST_SPEED
from servofd.servo.effects.motor import WIDTHS_DEG
from servofd.servo.loop import AFTER, BEFORE, INSIDE

_PUSH_PER_PA_S = 25.0 / 300.0
"""How fast the air pushes a surface through its play: in 0.04 s at 300 Pa (22 m/s)."""
_SURE_PER_DEG = 10.0
"""A load of a tenth of a degree decides to which side of its play the air pushes a surface."""
_TIPS_HZ = (3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.5, 16.0, 20.0, 26.0, 34.0)
"""Frequencies of a flexible linkage from which a search starts."""
_MOST_TURNS, _HALVINGS = 4, 40
"""How often in one step an output may fall behind and catch up, and how exactly it is known when."""


class RateLimit(Effect):
    """Largest speed of the output, which follows what a faster servo would do."""

    name, slot, form, rank, memory = "rate_limit", Slot.OUTPUT, "output", 7, 2
    spoken = "a rate limit"
    longest_s, varies = 5e-3, True
    parameters = (LARGEST_SPEED(fields=("follow_up_deg_s", "follow_down_deg_s")),)

    def __init__(self, rate_limit_deg_s: float = math.inf, rate_down_deg_s: float | None = None) -> None:
        super().__init__(rate_limit_deg_s)
        self.down_deg_s: float = rate_limit_deg_s if rate_down_deg_s is None else RateLimit(rate_down_deg_s).down_deg_s

    @property
    def sizes(self) -> dict[str, float]:
        """As of any effect; the limit downwards may be another one."""
        return {**super().sizes, "follow_down_deg_s": self.down_deg_s}

    @staticmethod
    def act(
        x: float, now: Now, up_deg_s: float, down_deg_s: float, at: float, lag: float
    ) -> tuple[float, float, float]:
        """It follows until the servo is too fast, on a cubic from step to step, then runs until it meets it again."""
        step_s, was = now.step_s, at + lag
        # Travels of the step at its first and last speed, and between; all of its speeds lie between these three.
        most, least = up_deg_s * step_s, -down_deg_s * step_s
        begins, mean, ends = now.speed_deg_s * step_s, x - was, now.arrives_deg_s * step_s
        between = 3.0 * mean - begins - ends
        if lag == 0.0 and least <= min(begins, between, ends) and max(begins, between, ends) <= most:
            return x, x, 0.0
        if step_s <= 0.0:
            return at, at, lag
        # At a share of the step, its speed is begins + linear * share + square * share^2.
        linear, square, share = 2.0 * (between - begins), begins - 2.0 * between + ends, 0.0
        for _ in range(_MOST_TURNS):
            speed, faster = begins + share * (linear + share * square), linear + 2.0 * share * square
            short = -1.0
            if lag == 0.0:
                up, down = reaches(most - speed, faster, square), reaches(speed - least, -faster, -square)
                if share + min(up, down) >= 1.0:
                    return x, x, 0.0
                lag, share = 1.0 if up <= down else -1.0, share + min(up, down)
                at = was + share * (begins + share * (0.5 * linear + share * square / 3.0))
            else:
                lag = math.copysign(1.0, lag)
                short = lag * ((most if lag > 0.0 else least) - speed)
            limit = most if lag > 0.0 else least
            last = at + limit * (1.0 - share)
            high = 1.0
            if lag * (x - last) > 0.0:  # unless it was met before, where the servo turned
                high = share + (reaches(short, lag * faster, lag * square) if short > 0.0 else 1.0)
                there = was + high * (begins + high * (0.5 * linear + high * square / 3.0))
                if high >= 1.0 or lag * (there - at - limit * (high - share)) > 0.0:
                    return last, last, x - last
            low = share
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                there = was + middle * (begins + middle * (0.5 * linear + middle * square / 3.0))
                is_behind = lag * (there - at - limit * (middle - share)) > 0.0
                low, high = (middle, high) if is_behind else (low, middle)
            at += limit * (high - share)
            share, lag = high, 0.0
        at += min(max(x - at, least * (1.0 - share)), most * (1.0 - share))
        return at, at, x - at


def reaches(gap: float, faster: float, square: float) -> float:
    """After which share of a step a speed that grows by `faster`, and `square`, has closed a gap to its limit, or 2.

    Examples
    --------
    >>> reaches(-0.1, 0.0, 0.0), reaches(0.5, 1.0, 0.0), reaches(0.5, 0.1, 0.0)
    (0.0, 0.5, 2.0)
    """
    within = faster * faster + 4.0 * square * gap
    below = faster + math.sqrt(max(within, 0.0))
    return 0.0 if gap <= 0.0 else 2.0 * gap / below if within >= 0.0 and below > gap else 2.0


def speed_over(x: float, at: float, now: Now) -> tuple[float, float, float, float]:
    """Speed of what moves from `at` to x in a step: b + f t + s t^2; b, f, s, and the speed at its end.

    It moves with the shaft, on a cubic, or else (in play, at its limit, or for too short a time to tell) on a straight
    line.

    Examples
    --------
    >>> now = Now(0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.2, 3.0)
    >>> [round(part, 9) for part in speed_over(0.2, 0.0, now)], speed_over(0.5, 0.0, now)
    ([1.0, 20.0, 0.0, 3.0], (5.0, 0.0, 0.0, 5.0))
    """
    mean = (x - at) / now.step_s
    # Beyond rounding; that of two stamps that differ by rounding alone would bend the cubic by hundreds of degrees.
    if now.step_s < 1e-5 or abs(x - at - now.travel_deg) > 1e-12 * (abs(x) + abs(at)):
        return mean, 0.0, 0.0, mean
    begins, ends = now.speed_deg_s, now.arrives_deg_s
    faster, square = 3.0 * mean - 2.0 * begins - ends, begins + ends - 2.0 * mean
    return begins, 2.0 * faster / now.step_s, 3.0 * square / now.step_s**2, ends


class Resonance(Effect):
    """Flexible linkage between servo and surface."""

    name, slot, rank, memory = "resonance", Slot.OUTPUT, 33, 3
    spoken = "a flexible linkage"
    longest_s, apart_s, surprise = 5e-3, 5e-4, SELDOM
    parameters = (
        Parameter("frequency_hz", ("resonance_hz",), 1.0, 80.0, 80.0, 30.0, _TIPS_HZ, off=0.0),
        Parameter("damping_ratio", ("resonance_damping",), 5e-3, 0.5, 0.05, 0.05, (0.03, 0.15)),
    )

    @staticmethod
    def act(
        x: float, now: Now, frequency_hz: float, damping: float, at: float, away: float, speed: float
    ) -> tuple[float, float, float, float]:
        """A tip on a spring, exactly, while its root moves with the shaft, on a cubic, or else on a straight line."""
        step_s = now.step_s
        if frequency_hz <= 0.0 or step_s <= 0.0:
            return x + away, x, away, speed
        natural = 2.0 * math.pi * frequency_hz
        turn, damps, stiff = natural * math.sqrt(1.0 - damping * damping), 2.0 * damping * natural, natural * natural
        begins, faster, square, ends = speed_over(x, at, now)
        # What a tip leaves of a way that goes on so for ever, and how it swings about that.
        bent = -damps * square / stiff
        drifts = -(2.0 * square + damps * faster + 2.0 * damps * bent) / stiff
        behind = -(faster + damps * begins + 2.0 * bent + damps * drifts) / stiff
        free, swings = away - behind, speed - begins - drifts
        decay = math.exp(-0.5 * damps * step_s)
        cosine, sine = decay * math.cos(turn * step_s), decay * math.sin(turn * step_s) / turn
        after = behind + step_s * (drifts + step_s * bent)
        after += free * (cosine + 0.5 * damps * sine) + swings * sine
        speed = ends + drifts + 2.0 * step_s * bent + swings * (cosine - 0.5 * damps * sine) - stiff * free * sine
        return x + after, x, after, speed


class Backlash(Effect):
    """Free play of gear and linkage, through which the air pushes a surface to its loaded side."""

    name, slot, family, rank, memory = "backlash", Slot.OUTPUT, "hysteresis", 14, 1
    spoken = "play"
    sound, advice = 0.3, "check horn, rod and gear for play"  # the HS-225BB has so much free play when new
    places, varies, at_rest = (INSIDE, BEFORE, AFTER), True, 3
    sees = ("backlash_deg", "airload_per_pa", "air_trim_per_pa")
    parameters = (Parameter("width_deg", ("backlash_deg",), 0.0, 8.0, 0.0, 0.3, WIDTHS_DEG, loose=0.5, smallest=0.12),)

    @staticmethod
    def act(
        x: float, now: Now, width_deg: float, airload_per_pa: float, trim_per_pa: float, at: float
    ) -> tuple[float, float]:
        half = 0.5 * width_deg
        side = min(max(_SURE_PER_DEG * now.pressure_pa * (airload_per_pa * x + trim_per_pa), -1.0), 1.0)
        if side != 0.0:
            pushed = _PUSH_PER_PA_S * now.pressure_pa * now.step_s
            at += pushed / (1.0 + pushed) * (x - side * half - at)
        at = max(min(at, x + half), x - half)
        return at, at


class LinkageNonlinearity(Effect):
    """Geometry of horn and rod: the ratio changes with the deflection."""

    name, slot, rank = "linkage_nonlinearity", Slot.OUTPUT, 32
    spoken = "a crooked linkage"
    surprise, instead = RARELY, ("gravity_load",)
    parameters = (
        Parameter("quadratic_per_deg", ("quadratic_per_deg",), -0.05, 0.05, 0.0, 2e-3, (-4e-3, 4e-3)),
        Parameter("cubic_per_deg2", ("cubic_per_deg2",), -5e-3, 5e-3, 0.0, 2e-4, (-4e-4, 4e-4)),
    )

    @staticmethod
    def act(x: float, now: Now, quadratic: float, cubic: float) -> float:
        return x * (1.0 + x * (quadratic + x * cubic))


class UpperGain(Effect):
    """Another ratio above zero than below: a horn that is set askew, or a sensor whose scale differs up and down."""

    name, slot, form, rank = "linkage_nonlinearity", Slot.OUTPUT, "up and down", 34
    spoken = "another gain up than down"
    surprise, instead = RARELY, ("gravity_load",)
    parameters = (Parameter("upper_gain", ("upper_gain",), 0.5, 2.0, 1.0, 0.03, (0.9, 0.95, 1.05, 1.1), smallest=0.01),)

    @staticmethod
    def act(x: float, now: Now, upper_gain: float) -> float:
        return x * upper_gain if x > 0.0 else x


class Gain(Effect):
    """Horn or linkage of another ratio, or a sensor's scale."""

    name, slot, rank = "gain", Slot.OUTPUT, 2
    spoken = "another gain"
    varies, at_rest = True, 2
    parameters = (Parameter("gain", ("gain",), 0.2, 2.0, 1.0, 0.03, (0.8, 0.95, 1.05, 1.2), smallest=0.02),)

    @staticmethod
    def act(x: float, now: Now, gain: float) -> float:
        return gain * x


class PositionLimit(Effect):
    """Stops of the linkage: the surface waits there while the servo goes on."""

    name, slot, form, rank = "position_limit", Slot.OUTPUT, "linkage", 10
    spoken = "a stop"
    parameters = (
        Parameter("lower_deg", ("lower_deg",), -90.0, 0.0, -90.0, 2.0, (-15.0, -10.0, -6.0, -4.0, -2.0), -math.inf),
        Parameter("upper_deg", ("upper_deg",), 0.0, 90.0, 90.0, 2.0, (2.0, 4.0, 6.0, 10.0, 15.0), math.inf),
    )

    def __init__(self, lower_deg: float, upper_deg: float) -> None:
        if not lower_deg < upper_deg:
            raise ConfigError(f"position_limit: lower_deg {lower_deg:g} must be below upper_deg {upper_deg:g}")
        self.values = (float(lower_deg), float(upper_deg))

    @staticmethod
    def act(x: float, now: Now, lower_deg: float, upper_deg: float) -> float:
        return min(max(x, lower_deg), upper_deg)
