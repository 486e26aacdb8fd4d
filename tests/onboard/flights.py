"""Samples of a log, as the autopilot's script would have met them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.calibration import DegreeCalibration
from servofd.aircraft.schema import Aircraft
from tests.onboard.autopilot import Flight

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft.series import Series

__all__ = ["flight_of", "on_autopilot"]


def on_autopilot(aircraft: Aircraft) -> Aircraft:
    """The same surfaces on outputs 1, 2, ..., with servos that repeat their commands [deg]."""
    surfaces = {
        name: surface.model_copy(
            update={
                "command": DegreeCalibration(channel=f"CSRV[{k}].PosCmd", unit="deg"),
                "measured": DegreeCalibration(channel=f"CSRV[{k}].Pos", unit="deg") if surface.measured else None,
                "command_saturation_deg": None,
            }
        )
        for k, (name, surface) in enumerate(aircraft.surfaces.items())
    }
    return aircraft.model_copy(update={"surfaces": surfaces})


def flight_of(segments: Mapping[int, Series]) -> Flight:
    """A call for every stamp of every surface; what was not new then is what came before."""
    stamps = [
        np.round(1e6 * time_s).astype(np.int64) for s in segments.values() for time_s in (s.command_s, s.measured_s)
    ]
    time_us = np.unique(np.concatenate(stamps))
    commands, positions = {}, {}
    for output, segment in segments.items():
        at = np.searchsorted(np.round(1e6 * segment.command_s).astype(np.int64), time_us, side="right") - 1
        commands[output] = np.where(at >= 0, segment.command_deg[np.maximum(at, 0)], np.nan)
        positions[output] = np.full(time_us.size, np.nan)
        positions[output][np.searchsorted(time_us, np.round(1e6 * segment.measured_s).astype(np.int64))] = (
            segment.measured_deg
        )
    return Flight(time_us, commands, positions)
