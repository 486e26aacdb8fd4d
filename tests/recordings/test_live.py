"""What was recorded in flight is judged when it is reviewed, as the log would be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.cli import main
from servofd.outputs.live_recording import LiveRecording, Samples
from servofd.outputs.recording.content import Trace
from servofd.outputs.recording.read import read_recording
from servofd.outputs.recording.verdicts import live_verdicts
from servofd.review import rejudged

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"


def test_a_recording_of_the_monitor_is_judged_in_review(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (audit,) = servofd.audit(SAMPLES / "table_three_faults.csv")
    names = [s.surface for s in audit.surfaces]
    path = tmp_path / "live.rrd"
    live = LiveRecording("x", names, path=path, properties=live_verdicts(audit.aircraft, names, "live"))
    for surface in audit.surfaces:
        assert surface.segment is not None
        assert surface.residuals is not None
        assert surface.threshold is not None
        trace = Trace.of(surface.segment, surface.residuals, surface.threshold.level_deg)
        for rows in np.array_split(np.arange(trace.time_s.size), 7):
            columns = (trace.command_deg, trace.simulated_deg, trace.measured_deg, trace.residual_deg)
            values = (column[rows] for column in (trace.time_s, *columns, trace.threshold_deg))
            live.add(Samples(surface.surface, *values))
    live.close()
    again = rejudged(read_recording(path)).audit
    assert [s.status for s in again.surfaces] == [s.status for s in audit.surfaces]
    assert [f.alarm_s for s in again.surfaces for f in s.faults] == [
        f.alarm_s for s in audit.surfaces for f in s.faults
    ]
    assert [f.kind for s in again.surfaces for f in s.faults] == [f.kind for s in audit.surfaces for f in s.faults]
    assert main(["review", str(path)]) == 1
    assert "stuck at" in capsys.readouterr().out


def test_nothing_recorded_is_no_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (audit,) = servofd.audit(SAMPLES / "table_three_faults.csv")
    names = [s.surface for s in audit.surfaces]
    path = tmp_path / "live.rrd"
    LiveRecording("x", names, path=path, properties=live_verdicts(audit.aircraft, names, "live")).close()
    assert main(["review", str(path)]) == 2
    assert "nothing of it was recorded" in capsys.readouterr().err
