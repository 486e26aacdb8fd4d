"""What a ground station is told: which surface, within fifty characters, and alarms before anything else."""

from __future__ import annotations

import itertools

import pytest

from logparsers.protocol import Severity
from servofd.aircraft.names import short_names
from servofd.core.statistics import Estimate
from servofd.detection.event import Event
from servofd.detection.verdict import Fault
from servofd.live.alerts import Alerts

NAMES = ["aileron_1", "aileron_9", "servo_1", "servo_10", "servo_3", "outer_flaperon_left", "outer_flaperon_right"]
ODD = [
    "höhenruder",
    "hohenruder",
    "Höhenruder",
    "升降舵",
    "方向舵",
    "",
    "a" * 200,
    "a" * 199 + "b",
    "servo~1",
    "x\n\x1b",
]


@pytest.mark.parametrize("room", [7, 10, 12, 20])
def test_short_names_are_plain_and_all_different(room: int) -> None:
    short = short_names([*NAMES, *ODD], room)
    assert len(set(short.values())) == len(short)
    assert all(0 < len(name) <= room and name.isascii() and name.isprintable() for name in short.values())


def test_a_number_is_that_of_its_own_surface() -> None:
    short = short_names([f"servo_{n}" for n in range(1, 17)], 7)
    assert {name: text.removeprefix("SERVO").strip("_") for name, text in short.items()} == {
        f"servo_{n}": str(n) for n in range(1, 17)
    }


def jam(surface: str, position_deg: float) -> Event:
    fault = Fault("stuck", 10.0, 10.4, None, {"position_deg": Estimate(position_deg, 0.0, 0.0)}, 0.99, ())
    return Event(10.9, surface, "named", "stuck", -2.0, 1.5, fault=fault, severity=Severity.CRITICAL)


def texts(alerts: Alerts, now_s: float) -> list[str]:
    return [str(fields["text"]) for _, fields in alerts.due(now_s)]


def test_whole_names_within_fifty_characters() -> None:
    alerts = Alerts(NAMES)
    for name in NAMES:
        alerts.take(jam(name, -0.2), 100.0)
    said = texts(alerts, 100.0)
    assert said[:2] == ["AILERON_1 stuck at -0.2 deg", "AILERON_9 stuck at -0.2 deg"]
    assert len(set(said)) == len(NAMES)
    assert all(len(text) <= 50 for text in said)


def test_an_alarm_gets_through_whatever_else_is_said() -> None:
    """Surfaces come and go fifty times a second for a minute: one line in ten seconds, and the alarm at once, twice."""
    alerts, said = Alerts(NAMES), []
    for k in range(3000):
        now_s = 100.0 + 0.02 * k
        for name in NAMES:
            alerts.take(Event(now_s, name, "no_data", text=f"no position since {now_s:.1f} s"), now_s)
        alerts.note("servofd: link 4 s late", now_s)
        if k == 1500:
            alerts.take(Event(now_s, "servo_10", "alarm", "unknown", 3.0, 1.5, severity=Severity.WARNING), now_s)
        said += [(now_s, text) for text in texts(alerts, now_s)]
    alarms = [at_s for at_s, text in said if text == "SERVO_10 ALARM, off by 3.0 deg"]
    assert alarms == [pytest.approx(130.0), pytest.approx(131.0, abs=0.03)]
    assert len(said) - len(alarms) <= 2 * 7
    assert {text for _, text in said[:2]} == {"7 surfaces not watched: no position", "servofd: link 4 s late"}


def test_what_came_back_meanwhile_is_not_said() -> None:
    alerts = Alerts(NAMES)
    for name in NAMES:
        alerts.take(Event(1.0, name, "no_data", text="no command since 1.0 s"), 100.0)
    for name in NAMES[1:]:
        alerts.watched(name)
    assert list(itertools.chain(*(texts(alerts, at_s) for at_s in (100.5, 101.5)))) == [
        "AILERON_1 not watched: no command"
    ]


def test_nothing_is_said_of_a_fault_that_has_cleared() -> None:
    alerts = Alerts(NAMES)
    alerts.take(jam("servo_3", 2.0), 100.0)
    assert texts(alerts, 100.0) == ["SERVO_3 stuck at 2.0 deg"]
    alerts.take(Event(11.0, "servo_3", "clear", "stuck"), 100.6)
    assert texts(alerts, 105.0) == ["SERVO_3 moves as commanded again"]


def test_a_surface_whose_residual_is_not_known_is_no_axis() -> None:
    """Where commands were lost, a test over a window may alarm at a position that has no residual."""
    alerts = Alerts(["rudder", "roll"])
    alerts.take(Event(10.0, "rudder", "alarm", "unknown"), 100.0)
    alerts.take(Event(10.0, "roll", "alarm", "unknown", text="aileron_left: alarm of its motion"), 100.0)
    assert texts(alerts, 100.0) == ["RUDDER ALARM", "ROLL AXIS ALARM by its motion"]


def test_severity_is_what_the_aircraft_feels() -> None:
    alerts = Alerts(NAMES)
    alerts.take(Event(10.0, "servo_1", "alarm", "unknown", 0.1, 0.05, severity=Severity.NOTICE), 100.0)
    alerts.take(jam("servo_3", 2.0), 100.0)
    found = [(fields["severity"], fields["text"]) for _, fields in alerts.due(100.0)]
    assert found == [(5, "SERVO_1 off by 0.1 deg"), (2, "SERVO_3 stuck at 2.0 deg")]


def test_news_of_two_surfaces_are_both_told_one_after_the_other() -> None:
    alerts = Alerts(NAMES)
    for news in ("aileron_1: the link is too poor", "servo_1: the link is too poor", "aileron_1: the link is too poor"):
        alerts.note(news, 100.0)
    said = {now_s: texts(alerts, now_s) for now_s in (100.5, 101.0, 105.0, 111.0, 125.0)}
    assert [text for each in said.values() for text in each] == [
        "aileron_1: the link is too poor",
        "servo_1: the link is too poor",
    ]
    assert said[111.0] == ["servo_1: the link is too poor"]
