"""Odds and calibrations as pictures: what a threshold costs in false alarms, and the smallest faults that show."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.files import write_whole
from servofd.detection.probability import (
    WITHIN_S,
    bias_response,
    detect,
    false_alarms_per_hour,
    persistent_delay_s,
    settled_bias,
)
from servofd.outputs.picture import new_figure, saved

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from servofd.core.types import FloatArray
    from servofd.detection.probability import SurfaceOdds

_COLOURS = ("#0072b2", "#009e73", "#e69f00", "#d55e00", "#cc79a7")
"""Okabe and Ito's palette."""
_FAULT_SIGMAS = (3.0, 4.0, 5.0, 6.0, 8.0)
"""Sizes of the bias faults of the left chart, in standard deviations of the residual; larger where the threshold
is."""
_LOWEST_RATE, _HIGHEST_RATE = 1e-6, 1e3
"""Ends of the axis of false alarms [1/h]."""
_THRESHOLDS, _SIZES = 30, 14
"""Points of a curve over the threshold, and of one over the size of the fault."""
_LARGEST_SIZE = 2.5
"""Largest fault of the right chart, in thresholds."""
_SMALLEST_DELAY_S, _LONGEST_DELAY_S = 3e-3, 100.0
"""Ends of the axis of delays [s]."""
_SIMULATED_S = 20.0
"""Time after the onset for which the residual is simulated [s]."""
_MOST_SAMPLES = 4000
"""Samples after the onset that are simulated at most."""


def save_odds_figure(odds: SurfaceOdds, path: Path) -> None:
    """Draw the odds of one surface into a PNG file.

    Left, the receiver operating characteristic: probability of detection within 0.2 s against false alarms per hour,
    one curve for each size of a bias fault; dashed against the false alarms of the measured tail, if there is one.
    Right, the expected delay against the size of the fault, for three alarm rules with the wanted rate of false alarms.
    """
    figure, (left, right) = new_figure(1, 2, height=5.2, width=14.0, share_x=False)
    _draw_characteristic(left, odds)
    _draw_delays(right, odds)
    for axes in (left, right):
        axes.grid(visible=True, color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    origin = f"{odds.hours:.2g} h of healthy data" if odds.hours else "from the design"
    figure.suptitle(
        f"{odds.surface}   {odds.servo}, residual sigma {odds.noise.sigma_deg:.3g} deg, {origin}",
        x=0.01,
        ha="left",
        fontsize=11,
    )
    write_whole(path, saved(figure, Path(path).suffix.lstrip(".") or "png"))


def _draw_characteristic(axes: Axes, odds: SurfaceOdds) -> None:
    noise, tail = odds.noise, odds.tail
    thresholds = abs(noise.mean_deg) + noise.sigma_deg * np.linspace(3.0, 8.0, _THRESHOLDS)
    if tail is not None:
        rates = np.geomspace(_LOWEST_RATE, tail.peaks_per_hour, 2 * _THRESHOLDS)
        thresholds = np.sort(np.append(thresholds, [tail.threshold_deg(rate).value for rate in rates]))
    gaussian = np.array(
        [
            false_alarms_per_hour(noise.margin_deg(t), noise.sigma_deg, noise.correlation, noise.sample_time_s)
            for t in thresholds
        ]
    )
    response = bias_response(odds.design, WITHIN_S[0])
    for size_deg, colour in zip(_fault_sizes_deg(odds), _COLOURS, strict=True):
        seen = [float(detect(size_deg * response, t, noise).likely[-1]) for t in thresholds]
        axes.plot(gaussian, seen, color=colour, lw=1.6, label=f"{size_deg:.2g} deg")
        if tail is not None:
            rates = np.array([tail.false_alarms_per_hour(t).value for t in thresholds])
            known = (thresholds >= tail.level_deg) & (rates > 0.0)
            axes.plot(rates[known], np.array(seen)[known], color=colour, lw=1.2, ls="--")
    if tail is not None:
        axes.plot([], [], color="0.3", lw=1.2, ls="--", label="measured tail")
        axes.axvline(tail.lowest_rate_per_hour, color="0.6", lw=0.8, ls=":", label="extrapolation to the left")
    axes.axvline(odds.wish.false_alarms_per_hour, color="0.3", lw=0.8, label="wanted rate")
    axes.set_xscale("log")
    axes.set_xlim(_LOWEST_RATE, _HIGHEST_RATE)
    axes.set_ylim(-0.02, 1.02)
    axes.xaxis.set_major_formatter("{x:g}")  # the usual one writes formulas
    axes.set_xlabel("false alarms per flight hour")
    axes.set_ylabel(f"probability of detection within {WITHIN_S[0]:g} s")
    axes.legend(frameon=False, title="bias of", loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _fault_sizes_deg(odds: SurfaceOdds) -> FloatArray:
    """Sizes around the threshold for the wanted rate, where detection goes from unlikely to sure [deg]."""
    scale_deg = odds.noise.sigma_deg
    if odds.tail is not None:
        scale_deg = max(scale_deg, odds.wished.threshold_deg / _FAULT_SIGMAS[-1] * 1.2)
    return scale_deg * np.array(_FAULT_SIGMAS)


def _draw_delays(axes: Axes, odds: SurfaceOdds) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    noise, wish = odds.noise, odds.wish
    sizes_deg = noise.sigma_deg * np.geomspace(
        0.7, _LARGEST_SIZE * odds.gaussian_threshold_deg / noise.sigma_deg, _SIZES
    )
    response = settled_bias(odds.design)
    count = min(int(_SIMULATED_S / noise.sample_time_s), _MOST_SAMPLES)
    long_response = np.append(response, np.full(max(count - response.size, 0), response[-1]))
    three = odds.in_a_row_threshold_deg.get(3)
    curves = {
        "threshold": [detect(x * response, odds.gaussian_threshold_deg, noise).mean_delay_s for x in sizes_deg],
    }
    if three is not None:
        curves["3 in a row"] = [persistent_delay_s(x * long_response, three, noise, 3) for x in sizes_deg]
    for (label, delays_s), colour in zip(curves.items(), _COLOURS, strict=False):
        drawn = np.maximum(np.where(np.isfinite(delays_s), delays_s, np.nan), _SMALLEST_DELAY_S)
        axes.plot(sizes_deg, drawn, color=colour, lw=1.6, marker=".", label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(_SMALLEST_DELAY_S, _LONGEST_DELAY_S)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("size of the bias [deg]")
    axes.set_ylabel("expected delay [s]")
    axes.set_title(f"at {wish.false_alarms_per_hour:g} false alarms per hour, Gaussian residual", fontsize=10)
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
