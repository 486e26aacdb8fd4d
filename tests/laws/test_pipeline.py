"""From file to verdict: what says the same in another way is judged the same.

Order of the surfaces, origin of the time, units and zero points of the channels, and a cut where all is well change no
verdict.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import servofd
from servofd.aircraft.schema import plain_aircraft
from servofd.core.types import FloatArray
from servofd.detection.verdict import SurfaceAudit
from servofd.servo.faults import Bias, Failure, HardOver, LossOfEffectiveness, Stuck
from servofd.simulation.flight import SimulatedFlight, simulate_flight

SURFACES = ("aileron", "elevator", "rudder")
DURATION_S, RATE_HZ = 45.0, 50.0
FAULTS: tuple[Failure, ...] = (
    Stuck(28.0),
    Bias(28.0, bias_deg=4.0),
    HardOver(28.0),
    LossOfEffectiveness(28.0, gain=0.3),
)
ONSET_S = 28.0
ALIKE_S = 1e-3
"""Onsets are found by descent, which ends where its steps are small."""
CUT_ALIKE_S = 0.1
"""Noise, and with it the threshold, is estimated from the log itself: half of it gives almost the same."""

few = settings(max_examples=3, deadline=None, derandomize=True)
flights = st.builds(
    lambda seed, surface, fault: simulate_flight(
        plain_aircraft(SURFACES, "hs225bb-eq31"), command="gusty", duration_s=DURATION_S, rate_hz=RATE_HZ, seed=seed,
        faults={surface: fault}, noise_deg=0.05,
    ),
    st.integers(0, 2**16), st.sampled_from(SURFACES), st.sampled_from(FAULTS),
)  # fmt: skip


@dataclass(frozen=True)
class Channel:
    """How an aircraft logs an angle: degrees = slope * (value - trim)."""

    toml: str
    slope_deg: float
    trim: float

    def logged(self, angle_deg: FloatArray) -> FloatArray:
        return angle_deg / self.slope_deg + self.trim


DEGREES = Channel('unit = "deg"', 1.0, 0.0)
CHANNELS = st.one_of(
    st.floats(-0.5, 0.5).map(lambda trim: Channel(f'unit = "rad", trim_rad = {trim!r}', 180.0 / np.pi, trim)),
    st.floats(-5.0, 5.0).map(lambda trim: Channel(f'unit = "deg", sign = -1, trim_deg = {trim!r}', -1.0, trim)),
    st.builds(
        lambda slope, trim: Channel(f'unit = "us", trim_us = {trim!r}, slope_deg_per_us = {slope!r}', slope, trim),
        st.floats(0.06, 0.15),
        st.floats(1400.0, 1600.0),
    ),
    st.builds(
        lambda slope, trim: Channel(
            f'unit = "count", trim_count = {trim!r}, slope_deg_per_count = {slope!r}', slope, trim
        ),
        st.floats(-0.5, -0.004),
        st.floats(-1e4, 1e5),
    ),
)


def audited(
    flight: SimulatedFlight,
    *,
    order: tuple[str, ...] = SURFACES,
    shift_s: float = 0.0,
    command: Channel = DEGREES,
    measured: Channel = DEGREES,
    part: slice = slice(None),
) -> dict[str, SurfaceAudit]:
    """Write a log and an aircraft file, and judge the one by the other."""
    table, toml = [flight.time_s[part] + shift_s], ['name = "drawn"', "[table]", 'time = "t"', 'time_unit = "s"']
    for name in order:
        column = flight.surfaces.index(name)
        table += [command.logged(flight.command_deg[part, column]), measured.logged(flight.measured_deg[part, column])]
        toml += [f"[surfaces.{name}]", 'servo = "hs225bb-eq31"', 'threshold = "interval"']
        toml.append(f'command = {{ channel = "{name}_asked", {command.toml} }}')
        toml.append(f'measured = {{ channel = "{name}_done", {measured.toml} }}')
    header = ",".join(["t", *(f"{name}_{what}" for name in order for what in ("asked", "done"))])
    with tempfile.TemporaryDirectory() as folder:
        log, aircraft = Path(folder) / "log.csv", Path(folder) / "aircraft.toml"
        np.savetxt(log, np.column_stack(table), fmt="%.17g", delimiter=",", header=header, comments="")
        aircraft.write_text("\n".join(toml) + "\n")
        (result,) = servofd.audit(log, aircraft)
    return {surface.surface: surface for surface in result.surfaces}


def check_alike(one: dict[str, SurfaceAudit], two: dict[str, SurfaceAudit], shift_s: float = 0.0) -> None:
    assert set(one) == set(two)
    for name, audit in one.items():
        other = two[name]
        assert (other.status, len(other.faults)) == (audit.status, len(audit.faults)), name
        for fault, same in zip(audit.faults, other.faults, strict=True):
            assert same.kind == fault.kind
            assert same.alarm_s - shift_s == pytest.approx(fault.alarm_s, abs=ALIKE_S)
            assert same.start_s - shift_s == pytest.approx(fault.start_s, abs=ALIKE_S)
            for parameter, estimate in fault.parameters.items():
                assert same.parameters[parameter].value == pytest.approx(estimate.value, rel=1e-3, abs=1e-3)


def check_judged(audits: dict[str, SurfaceAudit]) -> None:
    """Else equal verdicts would prove nothing."""
    assert sorted(audit.status for audit in audits.values()) == ["fault", "healthy", "healthy"]


@pytest.mark.slow
@given(
    flight=flights, order=st.permutations(SURFACES), shift_s=st.floats(0.0, 1e6), command=CHANNELS, measured=CHANNELS
)
@few
def test_order_origin_units_signs_and_zero_points_do_not_matter(
    flight: SimulatedFlight, order: list[str], shift_s: float, command: Channel, measured: Channel
) -> None:
    """Of the surfaces, of the time, and of what was logged: all of them at once."""
    first = audited(flight)
    check_judged(first)
    changed = audited(flight, order=tuple(order), shift_s=shift_s, command=command, measured=measured)
    check_alike(first, changed, shift_s)


@pytest.mark.slow
@given(flight=flights, cut_s=st.floats(12.0, ONSET_S - 8.0))
@few
def test_a_log_cut_in_two_where_all_is_well_is_judged_alike(flight: SimulatedFlight, cut_s: float) -> None:
    whole, cut = audited(flight), int(np.searchsorted(flight.time_s, cut_s))
    before, after = audited(flight, part=slice(cut)), audited(flight, part=slice(cut, None))
    assert {audit.status for audit in before.values()} == {"healthy"}
    for name, audit in whole.items():
        assert after[name].status == audit.status
        assert [fault.kind for fault in after[name].faults] == [fault.kind for fault in audit.faults]
        for fault, same in zip(audit.faults, after[name].faults, strict=True):
            assert same.alarm_s == pytest.approx(fault.alarm_s, abs=CUT_ALIKE_S)
            assert same.start_s == pytest.approx(fault.start_s, abs=CUT_ALIKE_S)
