"""Clocks: overflow, delay, drift, restarts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from logparsers.telemetry.timeline import build_timeline, despike, find_breaks, lower_line, place, unwrap


@pytest.mark.slow
@given(
    start=st.integers(0, 2**40),
    steps=st.lists(st.integers(-(2**20), 2**31 - 1), min_size=1, max_size=50),
)
def test_unwrapping_undoes_wrapping(start: int, steps: list[int]) -> None:
    true = start + np.concatenate([[0], np.cumsum(steps)])
    counted = unwrap((true % 2**32).astype(np.uint32))
    np.testing.assert_array_equal(counted - counted[0], true - true[0])


@pytest.mark.slow
@given(
    gaps=st.lists(st.integers(0, 2**36), min_size=1, max_size=20),
    jitter=st.integers(-(2**30), 2**30),
)
def test_a_second_clock_bridges_any_gap(gaps: list[int], jitter: int) -> None:
    true = np.concatenate([[5], 5 + np.cumsum(gaps)])
    elapsed = true + np.arange(true.size) % 2 * jitter
    counted = unwrap((true % 2**32).astype(np.uint32), elapsed=elapsed)
    np.testing.assert_array_equal(counted - counted[0], true - true[0])


@pytest.mark.slow
@given(st.lists(st.floats(0.0, 0.5), min_size=3, max_size=60), st.data())
def test_one_wild_stamp_is_replaced_and_others_are_kept(steps: list[float], data: st.DataObject) -> None:
    true = np.cumsum(steps)
    where = data.draw(st.integers(1, true.size - 2))
    hurt = true.copy()
    hurt[where] = data.draw(st.sampled_from([-1e6, 1e6, 1e12, np.nan]))
    clean = despike(hurt)
    np.testing.assert_array_equal(np.delete(clean, where), np.delete(true, where))
    assert abs(clean[where] - true[where]) <= 0.5 + 1e-9


def test_delay_and_congestion_do_not_bend_the_clock() -> None:
    rng = np.random.default_rng(0)
    sent = np.arange(10.0, 10_800.0, 0.1)
    congested = np.where(sent % 600 < 30, 3 * rng.random(sent.size), 0.0)
    fastest = sent * (1 + 40e-6) + 1000.01
    arrived = np.maximum.accumulate(fastest + rng.exponential(0.03, sent.size) + congested)
    line, breaks = build_timeline(np.round(sent, 3), arrived, np.arange(sent.size))
    assert not breaks
    assert line.drift[0] == pytest.approx(40e-6, abs=1e-8)
    np.testing.assert_allclose(line.from_arrival(fastest, np.arange(sent.size)), sent, atol=1e-4)


def test_the_line_never_lies_above_a_point() -> None:
    rng = np.random.default_rng(1)
    x = np.sort(rng.random(5000)) * 5000
    y = 2.0 - 1e-5 * x + rng.exponential(0.1, x.size)
    offset, slope = lower_line(x, y)
    assert np.all(y - (offset + slope * x) > -1e-9)


def test_a_clock_set_back_is_no_reboot() -> None:
    arrival = np.linspace(0.0, 60.0, 600)
    stamp = 5000.0 + arrival
    stamp[300:] -= 20.0
    breaks = find_breaks(stamp, arrival)
    assert [(b.kind, b.index) for b in breaks] == [("clock_jump", 300)]


def test_a_clock_set_forward_is_continued_by_arrival() -> None:
    stamp = 10.0 + 0.1 * np.arange(600)
    stamp[300:] += 1.7e9
    arrival = 0.1 * np.arange(600)
    line, breaks = build_timeline(stamp, arrival, np.arange(600))
    assert [b.kind for b in breaks] == ["clock_jump"]
    np.testing.assert_allclose(line.from_arrival(arrival, np.arange(600)), 10.0 + arrival, atol=1e-6)


def test_two_reboots_and_a_foreign_clock_with_its_own() -> None:
    vehicle = np.concatenate([300 + 0.1 * np.arange(400), 3 + 0.1 * np.arange(400), 2 + 0.1 * np.arange(400)])
    arrival = 0.1 * np.arange(1200) + np.repeat([0.0, 10.0, 30.0], 400)
    where = np.arange(1200)
    line, breaks = build_timeline(vehicle, arrival, where)
    assert [b.kind for b in breaks] == ["reboot", "reboot"]
    foreign = np.concatenate([7e6 + 0.1 * np.arange(700), 50.0 + 0.1 * np.arange(500)])
    foreign[700:] += arrival[700] - arrival[699] - 0.1
    stamps = np.round(foreign * 1000).astype(np.uint64)
    placed = place(stamps, 1e-3, bits=64, arrival_s=arrival, positions=where, timeline=line)
    assert np.all(np.diff(placed) > 0)
    np.testing.assert_allclose(placed, 300.0 + arrival, atol=2e-3)
