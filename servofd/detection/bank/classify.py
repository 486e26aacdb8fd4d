"""The decision between the hypotheses of the bank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.bank.altered import DeadBand, Slow
from servofd.detection.bank.following import Bias, Healthy, LossOfEffectiveness
from servofd.detection.bank.lost import Floating, Hardover, Stuck, Wandering
from servofd.detection.bank.oscillation import Oscillation
from servofd.detection.bank.window import Explanation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.detection.bank.window import Hypothesis, Window

BANK: tuple[Hypothesis, ...] = (
    Healthy(),
    Bias(),
    Stuck(),
    Hardover(),
    Floating(),
    Oscillation(),
    DeadBand(),
    Slow(),
    LossOfEffectiveness(),
)
"""Adding a hypothesis is adding a class and an entry here."""

_UNEXPLAINED_SHARE = 0.25
_UNKNOWN_FREEDOM = 6.0
_WORTH_MENTIONING = 0.02


@dataclass(frozen=True, slots=True)
class Naming:
    """Which hypothesis explains a window best, and how sure that is."""

    best: Explanation | None
    """None if the best answer is "none of these"."""
    probabilities: Mapping[str, float]
    """Of every kind, `unknown` included, the largest first."""

    @property
    def kind(self) -> str:
        """The most probable kind."""
        return next(iter(self.probabilities))

    @property
    def probability(self) -> float:
        """Of that kind."""
        return next(iter(self.probabilities.values()))

    @property
    def alternatives(self) -> tuple[str, ...]:
        """Other kinds that are worth mentioning, the most probable first."""
        others = list(self.probabilities.items())[1:]
        return tuple(kind for kind, probability in others if probability >= _WORTH_MENTIONING)


def name_fault(window: Window) -> Naming:
    """Compare all hypotheses on one window."""
    found = {h.kind: e for h in BANK if (e := h.explain(window)) is not None}
    marks = scores(window, found)
    kinds = sorted(marks, key=marks.__getitem__)
    weights = np.exp(-0.5 * (np.array([marks[kind] for kind in kinds]) - marks[kinds[0]]))
    shares = weights / weights.sum()
    return Naming(found.get(kinds[0]), {k: float(s) for k, s in zip(kinds, shares, strict=True)})


def scores(window: Window, found: Mapping[str, Explanation]) -> dict[str, float]:
    """Information criterion of each explanation, and of having none; smaller is better."""
    gap = float(window.error_deg @ window.error_deg)
    cost_deg2 = _UNEXPLAINED_SHARE**2 * gap + window.time_s.size * window.noise_deg**2
    nothing = Explanation("unknown", window.measured_deg, cost_deg2, _UNKNOWN_FREEDOM)
    wandering = Wandering().explain(window) or nothing
    unknown = min(window.score(nothing), window.score(wandering))
    return {**{kind: window.score(e) for kind, e in found.items()}, "unknown": unknown}
