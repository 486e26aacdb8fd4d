"""ArduPlane flights in wind as streams: commands at 25 Hz, positions at 50, and worse links than that."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import logparsers
import servofd
from logparsers.codec import Codec
from servofd.aircraft.schema import load_aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.feedback.draft import draft_to_toml
from servofd.live.session import stamped
from tests.external.test_bench_tables import DATA
from tests.external.test_disturbed_links import LINKS, alarms, most_outages, same, silent, thinned, told

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.aircraft.schema import Aircraft
    from tests.external.test_disturbed_links import Frames

WIND = DATA / "logs" / "wind"
OUTPUTS = (1, 2, 4, 9, 10, 12)
PLANE: dict[str, Any] = {
    "type": 1,
    "autopilot": 3,
    "base_mode": 157,
    "custom_mode": 10,
    "system_status": 4,
    "mavlink_version": 3,
}
WAYS = {**LINKS, "silent": silent}
ALL = {**WAYS, "straight": list, "thinned": thinned}

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(not WIND.is_dir(), reason="no flights in wind: set SERVOFD_EXTERNAL_DATA"),
]


def frames(name: str) -> Frames:
    """What a ground station would have received of a flight, 20 ms later."""
    log, codec = logparsers.read(WIND / f"{name}.bin.gz"), Codec(1, 1)
    pulses = [log[f"RCOU.C{output}"] for output in OUTPUTS]
    air = log["ARSP[0].Airspeed" if "ARSP[0].Airspeed" in log.channels else "ARSP.Airspeed"]
    rows: list[tuple[float, str, dict[str, Any]]] = []
    for k, at_s in enumerate(pulses[0].time_s.tolist()):
        servos = {f"servo{o}_raw": int(p.values[k]) for o, p in zip(OUTPUTS, pulses, strict=True)}
        rows.append((at_s, "SERVO_OUTPUT_RAW", {"time_usec": round(1e6 * at_s), "port": 0, **servos}))
    for output in OUTPUTS:
        position = log[f"CSRV[{output - 1}].Pos"]
        for at_s, deg in zip(position.time_s.tolist(), position.values.tolist(), strict=True):
            stamp = {"time_boot_ms": round(1e3 * at_s), "name": f"SRVP{output}", "value": deg}
            rows.append((at_s, "NAMED_VALUE_FLOAT", stamp))
    for at_s in np.arange(pulses[0].time_s[0], pulses[0].time_s[-1]).tolist():
        rows.append((at_s, "HEARTBEAT", PLANE))
        rows.append((at_s, "SYSTEM_TIME", {"time_unix_usec": 0, "time_boot_ms": round(1e3 * at_s)}))
    for at_s, m_s in zip(air.time_s[::3].tolist(), air.values[::3].tolist(), strict=True):
        level = {"groundspeed": m_s, "heading": 0, "throttle": 50, "alt": 100.0, "climb": 0.0}
        rows.append((at_s, "VFR_HUD", {"airspeed": m_s, **level}))
    rows.sort(key=lambda row: row[0])
    return [(1.7e9 + at_s + 0.02, codec.encode(message, fields)) for at_s, message, fields in rows]


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    """Calibrated on two healthy flights, as streams."""
    folder: Path = tmp_path_factory.mktemp("wind")
    good = [folder / f"{name}.tlog" for name in ("d_ok1", "d_ok3")]
    for path in good:
        path.write_bytes(b"".join(stamped(*entry) for entry in frames(path.stem)))
    draft, known = folder / "draft.toml", folder / "plane.toml"
    draft.write_text(draft_to_toml(logparsers.read(good[0])))
    known.write_text(calibration_to_toml(servofd.calibrate(good, draft)))
    return load_aircraft(known)


@pytest.fixture(scope="module")
def jam_and_lag() -> Frames:
    """An elevator is stuck from 110.05 s on, an aileron has twice its lag from 222.08 s on."""
    return frames("d_f3")


@pytest.fixture(scope="module")
def straight(plane: Aircraft, jam_and_lag: Frames) -> list[tuple[str, float]]:
    return alarms(told(plane, jam_and_lag))


def test_both_faults_are_told_and_nothing_else(straight: list[tuple[str, float]]) -> None:
    (elevator, jammed_s), (aileron, slow_s) = straight
    assert (elevator, aileron) == ("servo_10", "servo_1")
    assert 110.05 < jammed_s < 111.1
    assert 222.08 < slow_s < 232.1


@pytest.mark.parametrize("link", WAYS)
def test_on_worse_links_at_the_same_times(
    plane: Aircraft, jam_and_lag: Frames, straight: list[tuple[str, float]], link: str
) -> None:
    disturbed = told(plane, WAYS[link](jam_and_lag))
    assert same(alarms(disturbed), straight)
    assert most_outages(disturbed) == 0


@pytest.fixture(scope="module", params=["d_f1", "d_f2", "d_f4"])
def another(plane: Aircraft, request: pytest.FixtureRequest) -> tuple[Frames, list[tuple[str, float]]]:
    """Another flight with two faults, and what is told of it on a good link."""
    seen = frames(request.param)
    return seen, alarms(told(plane, seen))


@pytest.mark.parametrize("link", WAYS)
def test_of_other_flights_the_same_is_told_at_the_same_times(
    plane: Aircraft, another: tuple[Frames, list[tuple[str, float]]], link: str
) -> None:
    seen, on_time = another
    disturbed = told(plane, WAYS[link](seen))
    assert on_time
    assert same(alarms(disturbed), on_time)
    assert most_outages(disturbed) == 0


@pytest.mark.parametrize("name", ["d_ok2", "d_ok4"])
@pytest.mark.parametrize("link", ALL)
def test_a_healthy_flight_has_no_alarm(plane: Aircraft, name: str, link: str) -> None:
    disturbed = told(plane, ALL[link](frames(name)))
    assert alarms(disturbed) == []
    assert most_outages(disturbed) == 0


def test_a_jam_and_both_slow_elevators_are_told_at_the_same_times_10_s_late(plane: Aircraft) -> None:
    """An aileron is stuck from 95.08 s on, both elevators have three times their lag from 210.09 s on."""
    seen = frames("d_f2")
    on_time, late = told(plane, seen), told(plane, LINKS["10 s late"](seen))
    assert {surface for surface, _ in alarms(on_time)} == {"servo_9", "servo_2", "servo_10"}
    assert alarms(on_time)[0][1] < 95.08 + 1.0
    assert same(alarms(late), alarms(on_time))
    assert most_outages(late) == 0


def test_of_an_aileron_that_jams_nothing_else_is_told(plane: Aircraft) -> None:
    """From 120.08 s on, in another aeroplane of the kind."""
    ((surface, at_s),) = alarms(told(plane, frames("d_f1")))
    assert surface == "servo_1"
    assert 120.08 < at_s < 121.0


def test_the_page_of_six_surfaces_with_currents_stays_small(tmp_path: Path) -> None:
    """Three of them are at fault, so six whole flights and three close-ups are drawn."""
    found = servofd.audit(WIND / "d_f2.bin.gz")
    assert isinstance(found, servofd.Audit)
    page = found.save_html(tmp_path / "page.html")
    assert page.read_text().count('<figure class="chart"') == 9
    assert page.stat().st_size <= 200_000
