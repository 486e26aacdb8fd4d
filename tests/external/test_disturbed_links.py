"""Recorded flights of a simulated ArduPlane as worse links would have brought them: the same alarms in time."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import pytest

import logparsers
import servofd
from logparsers.codec import Codec
from logparsers.replay import replayed
from servofd.aircraft.schema import load_aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.feedback.draft import draft_to_toml
from servofd.live.session import Session, stamped
from tests.external.test_bench_tables import DATA

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from servofd.aircraft.schema import Aircraft
    from servofd.detection.event import Event

Frames = list[tuple[float, bytes]]

TWO_JAMS = DATA / "logs" / "ardupilot_sitl_feedback.tlog"
HEALTHY = DATA / "logs" / "healthy_ten_minutes.tlog.gz"
BACKLOG = DATA / "logs" / "mavproxy_backlog.tlog.gz"


def delayed(frames: Frames, by_s: float) -> Frames:
    """Every frame of the second half comes so much later [s]."""
    middle_s = 0.5 * (frames[0][0] + frames[-1][0])
    return [(at_s + by_s * (at_s > middle_s), frame) for at_s, frame in frames]


def thinned(frames: Frames, seed: int = 4) -> Frames:
    kept = np.random.default_rng(seed).random(len(frames)) < 0.25
    return [entry for entry, stays in zip(frames, kept.tolist(), strict=True) if stays]


def silent(frames: Frames) -> Frames:
    """Without 20 s in the middle."""
    middle_s = 0.5 * (frames[0][0] + frames[-1][0])
    return [entry for entry in frames if abs(entry[0] - middle_s) > 10.0]


def shuffled(frames: Frames) -> Frames:
    """Each is up to 0.2 s late, so that many overtake each other."""
    late_s = 0.2 * np.random.default_rng(4).random(len(frames))
    order = sorted((at_s + late_s[k], k) for k, (at_s, _) in enumerate(frames))
    return [(at_s, frames[k][1]) for at_s, k in order]


LINKS: dict[str, Callable[[Frames], Frames]] = {
    "1.1 s late": lambda frames: delayed(frames, 1.1),
    "4 s late": lambda frames: delayed(frames, 4.0),
    "10 s late": lambda frames: delayed(frames, 10.0),
    "reordered": shuffled,
}


def calibrated(folder: Path, log: Path, spans: tuple[tuple[float, float], ...] | None) -> Aircraft:
    if not log.exists():
        pytest.skip("no flight logs: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/")
    draft, known = folder / "draft.toml", folder / "plane.toml"
    draft.write_text(draft_to_toml(logparsers.read(log)))
    known.write_text(calibration_to_toml(servofd.calibrate([log], draft, spans=spans or ())))
    return load_aircraft(known)


@pytest.fixture(scope="module")
def two_jams(tmp_path_factory: pytest.TempPathFactory) -> tuple[Aircraft, Frames]:
    aircraft = calibrated(tmp_path_factory.mktemp("two"), TWO_JAMS, ((2.0, 50.0), (58.0, 92.0)))
    return aircraft, list(replayed(TWO_JAMS))


@pytest.fixture(scope="module")
def ten_minutes(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    return calibrated(tmp_path_factory.mktemp("ten"), HEALTHY, None)


def told(aircraft: Aircraft, frames: Frames) -> list[Event]:
    session, stepped_s = Session(Codec(0, 191), {0: aircraft}), 0.0
    events: list[Event] = []
    now_s = 0.0
    for now_s, frame in frames:
        events += session.take(now_s, frame)
        if now_s - stepped_s >= 0.02:
            stepped_s = now_s
            events += session.step(now_s)
    return events + session.finish(now_s)


def alarms(events: list[Event]) -> list[tuple[str, float]]:
    return [(event.surface, event.time_s) for event in events if event.event == "alarm"]


def same(found: list[tuple[str, float]], wanted: list[tuple[str, float]]) -> bool:
    """The same surfaces in the same order, within 0.1 s."""
    names = [[name for name, _ in each] for each in (found, wanted)]
    return names[0] == names[1] and all(abs(a[1] - b[1]) <= 0.1 for a, b in zip(found, wanted, strict=True))


def most_outages(events: list[Event]) -> int:
    """Most that any surface was called without data, before the first of its positions has changed aside."""
    counts = Counter(
        event.surface for event in events if event.event == "no_data" and "has not changed" not in event.text
    )
    del counts[""]
    return max(counts.values(), default=0)


@pytest.mark.nightly
@pytest.mark.parametrize("link", LINKS)
def test_two_jams_are_told_at_the_same_times(two_jams: tuple[Aircraft, Frames], link: str) -> None:
    aircraft, frames = two_jams
    straight, disturbed = told(aircraft, frames), told(aircraft, LINKS[link](frames))
    assert {"servo_1", "servo_10"} <= {name for name, _ in alarms(straight)}
    assert same(alarms(disturbed), alarms(straight))
    assert most_outages(disturbed) == 0


@pytest.mark.nightly
def test_a_jam_within_a_silence_is_told_after_it(two_jams: tuple[Aircraft, Frames]) -> None:
    aircraft, frames = two_jams
    straight, disturbed = alarms(told(aircraft, frames)), told(aircraft, silent(frames))
    first_s = next(at_s for name, at_s in alarms(disturbed) if name == "servo_1")
    assert 107.0 < first_s < 109.0
    assert same([a for a in alarms(disturbed) if a[0] != "servo_1"], [a for a in straight if a[0] != "servo_1"])
    assert most_outages(disturbed) == 0


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [4, 5])
def test_a_quarter_of_all_messages_shows_both_jams(
    two_jams: tuple[Aircraft, Frames], seed: int, tmp_path: Path
) -> None:
    """Positions at 5 Hz, commands at 10, and no other alarm; the log of it shows the same."""
    aircraft, frames = two_jams
    left = thinned(frames, seed)
    found = alarms(told(aircraft, left))
    assert {name for name, _ in found} == {"servo_1", "servo_10"}
    assert next(at_s for name, at_s in found if name == "servo_1") < 93.5 + 15.0
    (tmp_path / "left.tlog").write_bytes(b"".join(stamped(*entry) for entry in left))
    (result,) = servofd.audit(tmp_path / "left.tlog", aircraft)
    audited = {(s.surface, fault.alarm_s) for s in result.surfaces for fault in s.faults}
    assert audited <= set(found)
    assert "servo_1" in {name for name, _ in audited}


@pytest.mark.nightly
@pytest.mark.parametrize("link", ["straight", *LINKS, "thinned", "silent"])
def test_a_healthy_flight_has_no_alarm(ten_minutes: Aircraft, link: str) -> None:
    ways = {**LINKS, "straight": lambda frames: frames, "thinned": thinned, "silent": silent}
    disturbed = told(ten_minutes, ways[link](list(replayed(HEALTHY))))
    assert alarms(disturbed) == []
    assert most_outages(disturbed) <= (link == "thinned")  # no command in the first seven seconds


@pytest.mark.nightly
@pytest.mark.parametrize("link", ["1.1 s late", "4 s late", "10 s late", "silent"])
def test_of_another_flight_of_that_aircraft(ten_minutes: Aircraft, link: str) -> None:
    """Behind MAVProxy, with a backlog, a silence of its own, parameters that change, and a restart."""
    frames, ways = list(replayed(BACKLOG)), {**LINKS, "silent": silent}
    straight, disturbed = told(ten_minutes, frames), told(ten_minutes, ways[link](frames))
    assert len(alarms(straight)) >= 2
    assert same(alarms(disturbed), alarms(straight))
    assert most_outages(disturbed) == 0
