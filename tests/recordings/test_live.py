"""What was recorded in flight is judged when it is reviewed, as the log would be."""

from __future__ import annotations

import json
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servofd
from logparsers.codec import Codec
from logparsers.replay import replayed
from servofd.cli import main
from servofd.live.session import stamped
from servofd.outputs.live_recording import LiveRecording, Samples
from servofd.outputs.recording.content import Trace, live_verdicts
from servofd.outputs.recording.read import read_recording, rejudged

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"


@cache
def three_faults() -> servofd.Audit:
    (found,) = servofd.audit(SAMPLES / "table_three_faults.csv", servo="hs225bb-eq31")
    assert isinstance(found, servofd.Audit)
    return found


@pytest.mark.nightly
def test_a_recording_of_the_monitor_is_judged_in_review(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    audit = three_faults()
    names = [s.surface for s in audit.surfaces]
    path = tmp_path / "live.rrd"
    live = LiveRecording("x", names, path=path, properties=live_verdicts(audit.aircraft, names, "live"))
    for surface in audit.surfaces:
        trace = Trace.of(surface)
        assert trace is not None
        for rows in np.array_split(np.arange(trace.time_s.size), 7):
            piece = Trace._make([*(column[rows] for column in trace[:8]), (), trace.context])
            live.add(Samples(surface.surface, piece))
    live.close()
    again = rejudged(read_recording(path)).audit
    assert [s.status for s in again.surfaces] == [s.status for s in audit.surfaces]
    assert [f.alarm_s for s in again.surfaces for f in s.faults] == [
        f.alarm_s for s in audit.surfaces for f in s.faults
    ]
    assert [f.kind for s in again.surfaces for f in s.faults] == [f.kind for s in audit.surfaces for f in s.faults]
    assert main(["review", str(path)]) == 1
    assert "stuck at" in capsys.readouterr().out


def verdicts(words: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What a verb says of each surface: status, and each fault's kind, onset and alarm."""
    main([*words, "--json", "-"])
    (log,) = json.loads(capsys.readouterr().out)["logs"]
    return {
        name: (one["status"], [(f["kind"], f["start_s"], f["alarm_s"]) for f in one["faults"]])
        for name, one in log["surfaces"].items()
    }


@pytest.mark.slow
def test_commands_are_recorded_as_they_came(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands come more often than positions here: those at the positions alone would be another flight."""
    log, path = SAMPLES / "telemetry_stuck.tlog", tmp_path / "live.rrd"
    slow = tmp_path / "slow.tlog"
    codec, count, kept = Codec(0, 191), Counter[str](), []
    for at_s, frame in replayed(log):
        (heard,) = codec.decode(frame)
        name = heard.fields["name"] if heard.name == "NAMED_VALUE_FLOAT" else ""
        count[name] += 1
        if not name or count[name] % 3 == 0:
            kept.append(stamped(at_s, frame))
    slow.write_bytes(b"".join(kept))
    main(["monitor", str(slow), "-c", "simulated", "--speed", "0", "--no-alert", "--rrd", str(path), "--plain"])
    capsys.readouterr()
    audited = verdicts(["audit", str(slow), "-c", "simulated"], capsys)
    assert "fault" in {status for status, _ in audited.values()}
    assert verdicts(["review", str(path)], capsys) == audited


@pytest.mark.slow
def test_nothing_recorded_is_no_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    audit = three_faults()
    names = [s.surface for s in audit.surfaces]
    path = tmp_path / "live.rrd"
    LiveRecording("x", names, path=path, properties=live_verdicts(audit.aircraft, names, "live")).close()
    assert main(["review", str(path)]) == 2
    assert "nothing of it was recorded" in capsys.readouterr().err
