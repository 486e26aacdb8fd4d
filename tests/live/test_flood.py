"""A link that carries a hundred thousand messages a second: alarms still come out, loss is told, memory has an end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from logparsers.codec import Codec
from logparsers.endpoint import parse_endpoint
from logparsers.link import open_link
from tests.live.test_troubles import lively
from tests.live.vehicles import free_port, plane_file, vehicle

DURATION_S, RATE_HZ = 60.0, 1e5
FRAMES_A_DATAGRAM, TICK_S = 25, 0.02
MOST_MB, MOST_GROWTH_MB = 400.0, 40.0
"""In all, and in the second half of the flood."""


def resident_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS"))


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_an_alarm_comes_through_a_flood(tmp_path: Path) -> None:
    config, lines, port = tmp_path / "plane.toml", tmp_path / "events.jsonl", free_port()
    config.write_text(plane_file())
    words = ["monitor", f"udpin:127.0.0.1:{port}", "-c", str(config), "--plain", "--json-lines", str(lines)]
    plane = vehicle(lively(duration_s=DURATION_S, stuck_s=DURATION_S / 2.0), message_hz=40.0)
    codec, other = Codec(1, 1), Codec(1, 158)
    loud = {"time_boot_ms": 1, "name": "NOISE", "value": 1.0}
    datagram = b"".join(other.encode("NAMED_VALUE_FLOAT", loud) for _ in range(FRAMES_A_DATAGRAM))
    with subprocess.Popen([sys.executable, "-m", "servofd", *words], stdout=subprocess.PIPE, text=True) as child:
        link = open_link(parse_endpoint(f"udpout:127.0.0.1:{port}"))
        time.sleep(5.0)
        begun_s, sent, memory = time.monotonic(), 0, []
        for turn in range(plane.time_us.size):
            at_s = 1e-6 * float(plane.time_us[turn] - plane.time_us[0])
            time.sleep(max(begun_s + at_s - time.monotonic(), 0.0))
            for message in plane.turn(turn):
                link.send(codec.encode(*message))
            if at_s > 5.0:
                for _ in range(round(RATE_HZ * TICK_S / FRAMES_A_DATAGRAM)):
                    link.send(datagram)
                    sent += FRAMES_A_DATAGRAM
            if turn % 50 == 0:
                memory.append(resident_mb(child.pid))
        time.sleep(10.0)
        memory.append(resident_mb(child.pid))
        child.send_signal(signal.SIGINT)
        told = child.communicate(timeout=60)[0]
        link.close()
    assert sent > 0.8 * RATE_HZ * (DURATION_S - 5.0)
    events = [json.loads(line) for line in lines.read_text().splitlines()]
    assert "elevator" in {event["surface"] for event in events if event["event"] == "alarm"}
    assert {event["surface"] for event in events if event["event"] == "alarm"} == {"elevator"}
    assert max(memory) < MOST_MB
    assert max(memory) - memory[len(memory) // 2] < MOST_GROWTH_MB
    assert "dropped" in told or "skipped" in told
