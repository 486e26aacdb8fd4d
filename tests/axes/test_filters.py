"""Filters of axes are those of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from servofd.axes.filters import Section, low_pass, warped

VALUES = np.cumsum(np.random.default_rng(1).normal(size=2000)) + 50.0


@pytest.mark.parametrize(("corner_hz", "rate_hz"), [(0.4, 10.0), (1.0, 25.0), (2.5, 25.0)])
def test_a_filter_and_its_slope_are_the_bilinear_ones(corner_hz: float, rate_hz: float) -> None:
    corner = 2.0 * np.pi * corner_hz
    bottom = [1.0, 1.6 * corner, corner**2]
    for top, section in zip(([corner**2], [corner**2, 0.0]), low_pass(corner_hz, rate_hz, 0.8), strict=True):
        b, a = signal.bilinear(top, bottom, rate_hz)
        expected = signal.lfilter(b, a, VALUES, zi=signal.lfilter_zi(b, a) * VALUES[0])[0]
        assert section.passed(VALUES) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_warped_one_is_butterworths_and_one_of_first_order_a_lag() -> None:
    b, a = signal.butter(2, 0.5, fs=25.0)
    expected = signal.lfilter(b, a, VALUES, zi=signal.lfilter_zi(b, a) * VALUES[0])[0]
    assert low_pass(warped(0.5, 25.0), 25.0, 0.5**0.5)[0].passed(VALUES) == pytest.approx(expected)
    expected = signal.lfilter([0.1], [1.0, -0.9], VALUES, zi=[0.9 * VALUES[0]])[0]
    assert Section((0.1, 0.0, 0.0), (-0.9, 0.0)).passed(VALUES) == pytest.approx(expected)
