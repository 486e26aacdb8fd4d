"""Airspeed and supply of a flying aircraft, for servos whose model depends on them."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.segment import SURROUNDINGS
from servofd.detection.stream import MEMORY_S
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from collections.abc import Iterable

_PERIOD_S = 0.1
"""Airspeed and supply change slowly; more than that is not kept."""


class Surroundings:
    """What was heard of them lately; of several channels with the same news, the one that audits would take.

    `needs` are those of the models, of ``airspeed_m_s`` and ``servo_voltage_v``.

    Examples
    --------
    >>> around = Surroundings({"airspeed_m_s"})
    >>> around.channels[:3]
    ['airspeed_m_s', 'ARSP[0].Airspeed', 'ARSP.Airspeed']
    >>> around.add("VFR_HUD.airspeed", 1.0, 17.0), around.add("VFR_HUD.airspeed", 1.01, 17.1)
    (True, False)
    >>> around.context().airspeed_m_s
    array([17.])
    """

    def __init__(self, needs: Iterable[str]) -> None:
        self._sources = {
            channel: (need, rank, scale)
            for need in needs
            for rank, (channel, scale) in enumerate(SURROUNDINGS[need].items())
        }
        self._heard: dict[str, tuple[int, deque[tuple[float, float]]]] = {}

    @property
    def channels(self) -> list[str]:
        """Names of channels that tell about them."""
        return list(self._sources)

    def add(self, channel: str, time_s: float, value: float) -> bool:
        """Take a sample, as logged; whether it is news."""
        if channel not in self._sources or not np.isfinite(value):
            return False
        need, rank, scale = self._sources[channel]
        known_rank, samples = self._heard.get(need, (rank + 1, deque()))
        if rank < known_rank:
            samples = deque(maxlen=int(MEMORY_S / _PERIOD_S))
            self._heard[need] = rank, samples
        if rank > known_rank or (samples and not time_s - samples[-1][0] >= _PERIOD_S):
            return False
        samples.append((time_s, scale * value))
        return True

    def context(self) -> Context:
        """All that is known; what came last holds until something else comes."""
        columns = {need: np.array(samples).T for need, (_, samples) in self._heard.items()}
        nothing = (NO_CONTEXT.airspeed_s, NO_CONTEXT.airspeed_m_s)
        return Context(*columns.get("airspeed_m_s", nothing), *columns.get("servo_voltage_v", nothing))
