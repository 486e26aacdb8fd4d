"""Hypotheses of a surface that no longer listens: stuck, hard over, floating."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servofd.detection.bank.explanation import COLOUR, Ridge
from servofd.detection.bank.window import Explanation
from servofd.estimate.statistics import Estimate

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.bank.window import Window

_OUT_OF_REACH_DEG = 2.0
_UNCOMMANDED_RUN_DEG = 3.0
_STOP_SHARE = 0.9
_WIND_HZ = 1.0
_FASTEST_WIND_HZ = 8.0
_MOST_COSINES = 96
_SWINGS_DEG = (3.0, 10.0)
_UNHEARD_OF = 6.0
"""Where nothing was commanded, loose and wandering surfaces look alike: then it is called floating, 20 to 1."""


@dataclass(frozen=True, slots=True)
class Stuck:
    """The shaft jams where the servo has brought it."""

    kind: ClassVar[str] = "stuck"

    def explain(self, window: Window) -> Explanation | None:
        """Fit a constant, within reach of the commands."""
        rest = _resting(self.kind, window)
        return None if _ran_away(window, rest.parameters["position_deg"].value) else rest


@dataclass(frozen=True, slots=True)
class Hardover:
    """The servo runs to one end, uncommanded, and stays there."""

    kind: ClassVar[str] = "hardover"

    def explain(self, window: Window) -> Explanation | None:
        """Fit a constant, where no command has led."""
        rest = _resting(self.kind, window)
        return rest if _ran_away(window, rest.parameters["position_deg"].value) else None


@dataclass(frozen=True, slots=True)
class Floating:
    """The surface is loose, and the air moves it: smooth motion that has nothing to do with the command."""

    kind: ClassVar[str] = "floating"

    def explain(self, window: Window) -> Explanation | None:
        """Fit a random smooth motion."""
        found = _smooth(self.kind, window, np.zeros(window.time_s.size))
        if found is None:
            return None
        swing = Estimate.of(float(np.ptp(found.predicted_deg)) / 2.0, window.noise_deg)
        return replace(found, parameters={"amplitude_deg": swing})


@dataclass(frozen=True, slots=True)
class Wandering:
    """The surface follows its command, but for a smooth error that no fault of the bank explains.

    Without it, everything that is smooth would be called floating.
    """

    kind: ClassVar[str] = "unknown"

    def explain(self, window: Window) -> Explanation | None:
        """Fit a random smooth error."""
        found = _smooth(self.kind, window, window.healthy_deg)
        return None if found is None else replace(found, doubt=found.doubt + _UNHEARD_OF)


def _smooth(kind: str, window: Window, base_deg: FloatArray) -> Explanation | None:
    """Explain what is beyond the base by cosines, the faster the smaller; their size is chosen by the evidence."""
    target_deg, found = window.measured_deg - base_deg, []
    for sized in _cosines(window):
        fit = sized.fit(target_deg)
        doubt = (sized.occam + fit.doubt) / COLOUR
        found.append(Explanation(kind, base_deg + fit.predicted_deg, fit.cost_deg2, 0.0, {}, doubt))
    return min(found, key=window.score, default=None)


@lru_cache(maxsize=4)
def _cosines(window: Window) -> tuple[Ridge, ...]:
    """Smooth motions of each size within a window, kept for the next hypothesis; none if the window is too short."""
    count = 1 + int(np.ceil(2.0 * _FASTEST_WIND_HZ * window.duration_s))
    count = min(count, _MOST_COSINES, window.time_s.size // 2)
    if count < 1:
        return ()
    place = (window.time_s - window.time_s[0]) / max(window.duration_s, 1e-9)
    columns = np.cos(np.pi * place[:, None] * np.arange(count))
    frequency_hz = 0.5 * np.arange(count) / max(window.duration_s, 1e-9)
    shape = np.asarray(1.0 / (1.0 + (frequency_hz / _WIND_HZ) ** 2), dtype=np.float64)
    ridge = Ridge(columns, _SWINGS_DEG[0] * shape, window.noise_deg)
    return ridge, *(ridge.respread(swing_deg * shape) for swing_deg in _SWINGS_DEG[1:])


def _resting(kind: str, window: Window) -> Explanation:
    """Explain the window by a surface at rest."""
    position_deg = float(np.mean(window.measured_deg))
    misfit = window.measured_deg - position_deg
    parameters = {"position_deg": Estimate.of(position_deg, window.noise_deg / float(np.sqrt(misfit.size)))}
    return Explanation(
        kind,
        np.full(misfit.size, position_deg),
        float(misfit @ misfit),
        1.0,
        parameters,
        predict=lambda other: np.full(other.time_s.size, position_deg),
    )


def _ran_away(window: Window, position_deg: float) -> bool:
    """Whether no command has led to where the surface rests."""
    stops_deg = (window.servo.lower_deg, window.servo.upper_deg)
    if any(np.isfinite(stop) and stop != 0.0 and position_deg / stop >= _STOP_SHARE for stop in stops_deg):
        return True
    low_deg, high_deg = window.reach_deg
    if not low_deg - _OUT_OF_REACH_DEG <= position_deg <= high_deg + _OUT_OF_REACH_DEG:
        return True
    if window.onset is None:
        return False
    run_deg = position_deg - window.onset.position_deg
    towards_deg = window.onset.low_deg if run_deg < 0.0 else window.onset.high_deg
    asked_deg = (towards_deg - window.onset.position_deg) * float(np.sign(run_deg))
    return abs(run_deg) - max(asked_deg, 0.0) > _UNCOMMANDED_RUN_DEG
