"""A multirotor has no control surfaces: its page shows what was asked of its motors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from logparsers.records import Channel, FlightLog
from servofd.jobs.workflow import FailedLog
from servofd.outputs.audit_report import audit_report, motors_of
from servofd.outputs.document import Table
from servofd.outputs.page import html_page


def quad(vehicle: str = "quadrotor") -> FlightLog:
    time_s = np.arange(0.0, 60.0, 0.1)
    channels = {}
    for k in range(1, 5):
        pulses = 1500.0 + 20.0 * k + 50.0 * np.sin(time_s)
        pulses[100:130] = 2000.0 if k == 4 else pulses[100:130]
        channels[f"RCOU.C{k}"] = Channel(f"RCOU.C{k}", time_s, pulses, "us", "")
    functions = {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 5)}
    return FlightLog(Path("quad.bin"), "dataflash", channels, vehicle=vehicle, parameters=functions)


def test_saturation_is_counted_and_drawn() -> None:
    motors = motors_of(quad())
    assert motors is not None
    (table,) = (part for part in motors.parts if isinstance(part, Table))
    assert [row[3] for row in table.rows] == ["0.0%", "0.0%", "0.0%", "5.0%"]
    text = html_page(audit_report([FailedLog("quad.bin", "quad.bin: no measured deflection", quad())]))
    assert "No control surfaces: a quadrotor." in text
    assert "What was asked of its motors" in text
    assert motors_of(quad("fixed wing")) is None
