"""Commands of which a link loses three in four: what is not known of the servo, and verdicts by what is."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

import servofd
from servofd.aircraft.calibrated import CalibratedServo
from servofd.aircraft.pace import Rhythm, link_period_s, sent_period_s
from servofd.aircraft.priors import FITTED, PRIORS
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.detection import changes
from servofd.detection.faults import judged
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.moving import watched
from servofd.detection.seen import Healthy, Pace
from servofd.estimate.family import PATTERNS, new_state, simulated, variants
from servofd.estimate.record import LONGEST_S, Record, new_memory, put_back, unknown_deg
from servofd.simulation.flight import simulate_flight

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.core.types import FloatArray

PERIOD_S = 0.02
_COLUMNS = FITTED + len(PATTERNS)
KNOWN = CalibratedServo.model_validate(
    {
        "parameters": {prior.name: prior.value for prior in PRIORS},
        "between": [[0.01 * prior.between**2 * (i == k) for k in range(i + 1)] for i, prior in enumerate(PRIORS)],
        "noise": {"still_deg": 0.1, "lag_s": 0.003, "colour": (0.4, 0.2), "innovation": 0.8, "period_s": PERIOD_S},
        "reach_deg": (-40.0, 40.0),
    }
)


def moved(sent_s: FloatArray, asked_deg: FloatArray, time_s: FloatArray) -> FloatArray:
    """Where the calibrated servo goes, by commands each of which holds until the next."""
    table, still = variants(KNOWN.theta, patterns=False)[:1], np.zeros(time_s.size)
    start_deg = np.where(np.arange(time_s.size) == 0, asked_deg[0], np.nan)
    position_deg, _ = simulated(
        table, new_state(1), (sent_s, asked_deg, 0.0 * sent_s), time_s, still, still + 1.0, start_deg
    )
    return position_deg[:, 0]


def walk(sent_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """An autopilot in turbulence, and a stick that is moved now and then."""
    gusts = np.convolve(rng.normal(size=sent_s.size), np.exp(-0.1 * np.arange(60.0)), "same")
    return 1.5 * gusts + 12.0 * np.repeat(rng.normal(size=sent_s.size // 100 + 1), 100)[: sent_s.size]


def steps(sent_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Nothing but steps, one a second."""
    return np.repeat(10.0 * rng.normal(size=sent_s.size // 50 + 1), 50)[: sent_s.size]


def flown(seed: int, *, jam_s: float = np.inf, duration_s: float = 120.0) -> Series:
    """A flight of which one command and one position in four arrive."""
    rng = np.random.default_rng(seed)
    sent_s = np.arange(0.0, duration_s, PERIOD_S)
    asked_deg = walk(sent_s, rng)
    measured_deg = moved(sent_s, asked_deg, sent_s)
    measured_deg = np.where(sent_s < jam_s, measured_deg, measured_deg[np.searchsorted(sent_s, min(jam_s, 1e3)) - 1])
    measured_deg = measured_deg + 0.1 * rng.normal(size=sent_s.size)
    came, seen = (rng.random(sent_s.size) < 0.25 for _ in range(2))
    period_s = sent_period_s(sent_s[came][:101])
    return Series("x", sent_s[came], asked_deg[came], sent_s[seen], measured_deg[seen], sent_period_s=period_s)


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 25.0, 40.0, 50.0])
@pytest.mark.parametrize("loss", [0.0, 0.2, 0.3, 0.4, 0.5, 0.6])
def test_the_period_of_what_was_sent_is_known_whatever_is_lost(rate_hz: float, loss: float) -> None:
    """From the first hundred commands that arrive, whose stamps are a twentieth of a period off."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        stamp_s = (np.arange(500) + rng.normal(0.0, 0.05, 500)) / rate_hz
        period_s = link_period_s(stamp_s[rng.random(500) >= loss][:101])
        frames = {10.0: 5, 20.0: 3, 25.0: 2}.get(rate_hz, 1)  # of the autopilot, of which the link brings one
        assert period_s == pytest.approx(1.0 / rate_hz / frames, rel=0.05)


@pytest.mark.parametrize("asked", [walk, steps])
@pytest.mark.parametrize("seed", range(4))
def test_what_is_not_known_covers_what_the_servo_did(
    asked: Callable[[FloatArray, np.random.Generator], FloatArray], seed: int
) -> None:
    """A standard deviation: larger than the error, of all and of the tenth with most of it, but not by much."""
    rng = np.random.default_rng(seed)
    sent_s = np.arange(0.0, 300.0, PERIOD_S)
    asked_deg = asked(sent_s, rng)
    came = rng.random(sent_s.size) < 0.25
    arrived = sent_s[came], asked_deg[came]
    time_s = arrived[0][10:-10]
    time_s = time_s[np.searchsorted(arrived[0], time_s) > 0]
    error_deg = moved(*put_back(*arrived, Rhythm.of_link(PERIOD_S)), time_s) - moved(sent_s, asked_deg, time_s)
    unknown = unknown_deg(arrived, Rhythm.of_link(PERIOD_S), KNOWN.theta, time_s, new_memory())
    gaps_s = np.diff(arrived[0])[np.searchsorted(arrived[0], time_s) - 1]
    short = np.convolve(gaps_s > LONGEST_S, np.ones(15), "same") == 0.0
    most = short & (unknown > np.quantile(unknown[short], 0.9))
    for rows in (short, most):
        ratio = np.sqrt(np.mean(error_deg[rows] ** 2) / np.mean(unknown[rows] ** 2))
        assert 0.2 < ratio < 1.0


def test_nothing_is_unknown_where_every_command_arrived() -> None:
    sent_s = np.arange(0.0, 20.0, PERIOD_S)
    asked = sent_s, steps(sent_s, np.random.default_rng(1))
    assert not unknown_deg(asked, Rhythm.of_link(PERIOD_S), KNOWN.theta, sent_s, new_memory()).any()
    assert np.array_equal(put_back(*asked, Rhythm.of_link(PERIOD_S))[1], asked[1])
    assert sent_period_s(sent_s[:101]) is None


def largest_row(error_deg: FloatArray, lost_deg: FloatArray, time_s: FloatArray, *, is_lossy: bool = True) -> float:
    """Of residuals in a row on one side, by a servo that is known to 1 deg."""
    tests, slopes = changes.Tests.of(KNOWN, PERIOD_S, is_lossy=is_lossy), np.zeros((time_s.size, _COLUMNS))
    noise_deg = np.hypot(1.0, lost_deg)
    return float(
        changes.follow(tests, changes.Memory(tests), time_s, error_deg, slopes, noise_deg, lost_deg).triple.max()
    )


@pytest.mark.parametrize("lost", [1.5, 7.9])
def test_a_residual_that_lost_commands_may_explain_breaks_no_row(lost: float) -> None:
    """Of four residuals on one side the third is no farther off than its commands leave it: the others are a row."""
    time_s, error_deg, lost_deg = PERIOD_S * np.arange(1.0, 21.0), np.zeros(20), np.zeros(20)
    error_deg[10:14] = 8.0
    assert largest_row(error_deg, lost_deg, time_s) == pytest.approx(8.0)
    error_deg[13] = 0.0
    lost_deg[12] = lost
    assert largest_row(error_deg, lost_deg, time_s) == pytest.approx(8.0 / np.hypot(1.0, lost))
    error_deg[13] = 8.0
    assert largest_row(error_deg, lost_deg, time_s) == pytest.approx(8.0)
    error_deg[12] = -8.0  # what contradicts the two before it is no longer the same row
    assert largest_row(error_deg, lost_deg, time_s) == 0.0


def test_a_row_outlives_positions_that_a_lossy_link_loses() -> None:
    time_s, error_deg = PERIOD_S * np.arange(1.0, 21.0), np.zeros(20)
    error_deg[10:13] = 8.0
    time_s[12:] += 4.0 * PERIOD_S
    assert largest_row(error_deg, 0.0 * error_deg, time_s) == pytest.approx(8.0)
    assert largest_row(error_deg, 0.0 * error_deg, time_s, is_lossy=False) == 0.0
    time_s[12:] += 0.2  # in more than a quarter of a second nothing is known of what was asked
    assert largest_row(error_deg, 0.0 * error_deg, time_s) == 0.0


@pytest.mark.parametrize("loss", [0.5, 0.7])
def test_a_link_that_leaves_too_little_is_told_once_with_what_it_can_bear(loss: float) -> None:
    aircraft = plain_aircraft(["x"], "s9254")
    surface = aircraft.surfaces["x"].model_copy(update={"calibrated": KNOWN, "threshold": "interval"})
    monitor = SurfaceMonitor("x", surface, aircraft.model("x"), is_periodic=True)
    rng, sent_s = np.random.default_rng(2), np.arange(0.0, 60.0, PERIOD_S)
    asked_deg = walk(sent_s, rng)
    seen_deg = moved(sent_s, asked_deg, sent_s) + 0.1 * rng.normal(size=sent_s.size)
    came = rng.random((2, sent_s.size)) >= loss
    events = []
    for part in np.array_split(np.arange(sent_s.size), 60):
        asked, seen = part[came[0, part]], part[came[1, part]]
        events += monitor.feed((sent_s[asked], asked_deg[asked]), (sent_s[seen], seen_deg[seen]))
    events += monitor.finish()
    poor = [event.text for event in events if event.event == "no_data"]
    assert [event for event in events if event.event == "alarm"] == []
    assert len(poor) == (loss > 0.6)
    for text in poor:
        lost, shown, borne = map(int, re.findall(r"(\d+)%", text))
        assert text.startswith("the link is too poor")
        assert lost == pytest.approx(100.0 * loss, abs=5.0)
        assert shown < 50
        assert 40 <= borne < lost


def test_a_stream_that_becomes_slower_has_lost_nothing() -> None:
    assert sent_period_s(np.concatenate([np.arange(50) * 0.25, 12.5 + np.arange(51) * PERIOD_S])) is None


@pytest.mark.slow
def test_good_flights_have_no_alarm_and_jams_are_found() -> None:
    for seed in range(20):
        assert judged(watched(KNOWN, Record.of(flown(seed)))).faults == ()
    for seed in range(10):
        (fault, *_) = judged(watched(KNOWN, Record.of(flown(seed, jam_s=60.0)))).faults
        assert fault.kind in ("stuck", "floating")
        assert 60.0 < fault.alarm_s < 66.0


@pytest.mark.slow
def test_a_stream_has_the_residuals_and_thresholds_of_the_whole_log() -> None:
    segment = flown(3, duration_s=40.0)
    whole = watched(KNOWN, Record.of(segment))
    aircraft = plain_aircraft(["x"], "s9254")
    surface = aircraft.surfaces["x"].model_copy(update={"calibrated": KNOWN, "threshold": "interval"})
    pace = Pace(segment.period_s, segment.command_s[:101], segment.sent_period_s)
    stream = Healthy(surface, aircraft.model("x")).stream(pace)
    pieces = []
    events = [(t, 0, v) for t, v in zip(segment.command_s, segment.command_deg, strict=True)]
    events += [(t, 1, v) for t, v in zip(segment.measured_s, segment.measured_deg, strict=True)]
    for at_s, which, value in sorted(events):
        if which:
            stream.position(float(at_s), float(value))
        else:
            stream.commands(np.array([at_s]), np.array([value]))
        piece = stream.evaluate()
        pieces += [piece] if piece is not None else []
    last = stream.evaluate(final=True)
    pieces += [last] if last is not None else []
    residual_deg = np.concatenate([piece.residuals.residual_deg for piece in pieces])
    sigma_deg = np.concatenate([piece.threshold.sigma_deg for piece in pieces])
    known = segment.measured_s <= segment.command_s[-1]
    assert np.array_equal(residual_deg[known], whole.error_deg[known], equal_nan=True)
    assert np.array_equal(sigma_deg[known], whole.sigma_deg[known])


@pytest.mark.slow
@pytest.mark.parametrize("servo", ["s9254", pytest.param("hs225bb-eq31", marks=pytest.mark.nightly)])
def test_what_a_servo_was_asked_between_rare_commands_accuses_nobody(servo: str) -> None:
    """Commands at 50 Hz of which a table holds six a second: two of three healthy surfaces were at fault or suspect."""
    command = "flight" if servo == "s9254" else "steps"
    flown = simulate_flight(
        plain_aircraft(["a", "b", "c"], servo), command=command, duration_s=120.0, rate_hz=50.0, seed=1, noise_deg=0.02
    )
    logged = np.where(np.arange(flown.time_s.size) % 8 == 0, 1.0, np.nan)
    log = {"time_s": flown.time_s}
    for k, name in ((0, "a"), (2, "c")):
        log |= {f"{name}_cmd_deg": flown.command_deg[:, k] * logged, f"{name}_pos_deg": flown.measured_deg[:, k]}
    (found,) = servofd.audit(log)
    assert all(surface.status in ("healthy", "unknown") for surface in found.surfaces)
    assert any("commands come at 6.2 Hz" in surface.reason for surface in found.surfaces)
