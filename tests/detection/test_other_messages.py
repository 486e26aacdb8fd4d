"""A servo whose times are not those that it was calibrated by: first the log on the card, then the link.

Servos hang on one bus, which asks each of them every 45 ms for its position and tells it its command then. The card has
the command as the bus sends it and the position when it comes; the link has pulses, and positions as old as they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

import servofd
from servofd.aircraft.calibration import DegreeCalibration
from servofd.aircraft.outputs import streamed
from servofd.aircraft.schema import Aircraft
from servofd.core.types import FloatArray

BUS_S, FINE_S, LENGTH_S = 0.045, 0.001, 90.0
STUCK_S = (40.0, 52.0)


class Flown(NamedTuple):
    """Every millisecond."""

    time_s: FloatArray
    pulse_deg: FloatArray
    sent_deg: FloatArray
    """What the bus told the servo last."""
    position_deg: FloatArray
    read_deg: FloatArray
    """What the bus heard of it last."""


def flown(seed: int, *, stuck: bool = False) -> Flown:
    """A servo of 40 rad/s and 260 deg/s with 8 ms of dead time."""
    rng, time_s = np.random.default_rng(seed), np.arange(0.0, LENGTH_S, FINE_S)
    steps_deg = np.repeat(rng.uniform(-18.0, 18.0, int(LENGTH_S / 0.9)), 900)
    waves = [a * np.sin(w * time_s + rng.uniform(0.0, 6.0)) for a, w in ((3.0, 2.1), (1.5, 5.3))]
    pulse_deg = 0.2 * np.round((steps_deg + sum(waves)) / 0.2)[20 * (np.arange(time_s.size) // 20)]  # 50 Hz
    ticks = np.minimum(np.floor(time_s / BUS_S + 1e-9) * 45, time_s.size - 1).astype(int)
    sent_deg = pulse_deg[ticks]
    position_deg = np.zeros(time_s.size)
    for k in range(9, time_s.size):
        speed = np.clip(40.0 * (sent_deg[k - 9] - position_deg[k - 1]), -260.0, 260.0)
        held = stuck and STUCK_S[0] <= time_s[k] < STUCK_S[1]
        position_deg[k] = position_deg[k - 1] + FINE_S * (0.0 if held else speed)
    heard_deg = position_deg + rng.normal(0.0, 0.05, time_s.size)
    return Flown(time_s, pulse_deg, sent_deg, position_deg, np.round(heard_deg[ticks], 2))


def card(flight: Flown) -> pd.DataFrame:
    """Rows whenever the bus has been asked."""
    rows = np.arange(0, flight.time_s.size, 45)
    columns = {"rudder_cmd_deg": flight.sent_deg[rows], "rudder_pos_deg": flight.read_deg[rows]}
    return pd.DataFrame({"time_s": flight.time_s[rows], **columns})


def link(flight: Flown) -> pd.DataFrame:
    """Rows at 20 Hz, whatever the bus does."""
    rows = np.arange(0, flight.time_s.size, 50)
    columns = {"rudder_cmd_deg": flight.pulse_deg[rows], "rudder_pos_deg": flight.read_deg[rows]}
    return pd.DataFrame({"time_s": flight.time_s[rows], **columns})


@pytest.fixture(scope="module")
def by_its_card() -> Aircraft:
    """Calibrated on the card's log of one good flight."""
    known: Aircraft = servofd.calibrate(card(flown(1))).aircraft
    return known


@pytest.fixture(scope="module")
def by_its_link(by_its_card: Aircraft) -> Aircraft:
    """The same aircraft for messages of telemetry, which are then read from a table."""
    rudder = by_its_card.surfaces["rudder"]
    assert rudder.calibrated is not None
    assert rudder.measured is not None
    of_card = {
        "command": DegreeCalibration(channel="CSRV[3].PosCmd", unit="deg", pulse=(1500.0, 0.2)),
        "measured": DegreeCalibration(channel="CSRV[3].Pos", unit="deg", correction=rudder.measured.correction),
    }
    plane = by_its_card.model_copy(update={"surfaces": {"rudder": rudder.model_copy(update=of_card)}})
    heard = streamed(plane).surfaces["rudder"]
    assert heard.by_other_messages
    channels = {"command": rudder.command, "measured": rudder.measured}
    return plane.model_copy(update={"surfaces": {"rudder": heard.model_copy(update=channels)}})


@pytest.mark.slow
def test_times_of_another_path_are_no_fault(by_its_card: Aircraft, by_its_link: Aircraft) -> None:
    flight = link(flown(2))
    blamed, known = (servofd.audit(flight, plane)[0].surfaces[0] for plane in (by_its_card, by_its_link))
    assert blamed.status in ("suspect", "fault")  # by the times of the card
    assert known.status in ("healthy", "unknown")
    assert known.suspicions == ()
    assert "calibrated on other messages than this log has" in known.reason


@pytest.mark.slow
def test_a_jam_is_told_and_nothing_after_it(by_its_link: Aircraft) -> None:
    verdict = servofd.audit(link(flown(3, stuck=True)), by_its_link)[0].surfaces[0]
    (fault,) = verdict.faults
    assert fault.kind == "stuck"
    assert STUCK_S[0] < fault.alarm_s < STUCK_S[0] + 2.5
    assert fault.end_s == pytest.approx(STUCK_S[1], abs=2.0)
