"""Pictures of ``docs/detection.md``, from the trials that ``make_detection.py`` flies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from detection import FLIGHT_S, NAMES, limits, quantile
from fleet import KINDS, flight
from servofd.aircraft.schema import DEFAULT_SIGMAS
from servofd.outputs.palette import COLOURS
from trial import CONSTANT_DEG, Trial, judged

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw"]

FLIGHT_H = FLIGHT_S / 3600.0
EXAMPLE = (3, "hand_flown", "loss_of_effectiveness", "medium")


def draw(folder: Path, faulty: Sequence[Trial], healthy: Sequence[Trial]) -> None:
    """All pictures."""
    from matplotlib.figure import Figure

    pictures = {
        "names": (draw_names, (9.0, 5.5)),
        "roc": (draw_roc, (8.0, 5.0)),
        "delays": (draw_delays, (10.0, 5.0)),
        "example": (draw_example, (10.0, 6.0)),
    }
    for name, (picture, size) in pictures.items():
        figure = Figure(figsize=size, layout="constrained")
        picture(figure, faulty, healthy)
        figure.savefig(folder / f"{name}.png", dpi=100)


def draw_names(figure: Figure, faulty: Sequence[Trial], _: Sequence[Trial]) -> None:
    """Confusion matrix as a heat map."""
    large = [one for one in faulty if one.enough_motion and one.case.size != "small"]
    counts = np.array([[sum(t.case.kind == k and t.name == n for t in large) for n in NAMES] for k in KINDS])
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes = figure.subplots()
    axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        if count:
            axes.text(
                column,
                row,
                str(count),
                ha="center",
                va="center",
                color="white" if share[row, column] > 0.5 else "black",
            )
    axes.set_xticks(range(len(NAMES)), [_words(n) for n in NAMES], rotation=40, ha="right")
    axes.set_yticks(range(len(KINDS)), [_words(k) for k in KINDS])
    axes.set_xlabel("named")
    axes.set_ylabel("true")
    axes.set_title(f"Medium and large faults with enough motion: {len(large)} flights", loc="left", fontsize=11)


def draw_roc(figure: Figure, faulty: Sequence[Trial], healthy: Sequence[Trial]) -> None:
    """False alarms against detections within a second, as thresholds are scaled."""
    axes = figure.subplots()
    seen = [one for one in faulty if np.isfinite(one.motion_wait_s)]
    sets = (("constant", COLOURS["measured"], "constant_peak"), ("interval", COLOURS["simulated"], "interval_peak"))
    for name, colour, field in sets:
        well, ill = (np.array([getattr(one, field) for one in trials]) for trials in (healthy, seen))
        scale = np.geomspace(0.2, 5.0, 300)
        per_hour = (well[:, None] >= scale).sum(axis=0) / max(len(well) * FLIGHT_H, 1e-9)
        detected = (ill[:, None] >= scale).mean(axis=0)
        axes.plot(per_hour, 100.0 * detected, color=colour, label=f"{name} threshold, scaled", drawstyle="steps-post")
        at = ((well >= 1.0).sum() / max(len(well) * FLIGHT_H, 1e-9), 100.0 * float((ill >= 1.0).mean()))
        axes.plot(*at, "o", color=colour, label=f"{name} threshold as it is")
    axes.set_xscale("symlog", linthresh=0.1, linscale=0.5)
    axes.set_xticks([0.0, 0.1, 1.0, 10.0], ["0", "0.1", "1", "10"])
    axes.set_xlim(left=-0.01)
    axes.set_ylim(0.0, 100.0)
    axes.set_xlabel("healthy flights with a false alarm, per hour flown")
    axes.set_ylabel("faults of all sizes detected within 1 s\nof the onset, or of the first motion [%]")
    _plain(axes)
    axes.legend(frameon=False, loc="lower right")


def draw_delays(figure: Figure, faulty: Sequence[Trial], _: Sequence[Trial]) -> None:
    """Median delays of each detector and the bound."""
    axes = figure.subplots()
    large = [one for one in faulty if one.enough_motion and one.case.size != "small"]
    limit = limits(faulty)
    detectors: tuple[tuple[str, str, Callable[[Trial], float]], ...] = (
        ("constant 1.5 deg", COLOURS["measured"], lambda t: t.constant_delay_s),
        ("interval threshold and bank", COLOURS["simulated"], lambda t: t.bank_delay_s),
        ("bound", COLOURS["ok"], lambda t: t.bound_delay_s(limit[t.case.kind or ""][1])),
    )
    kinds = [kind for kind in KINDS if any(one.case.kind == kind for one in large)]
    for number, (name, colour, delay) in enumerate(detectors):
        medians = [quantile([delay(one) for one in large if one.case.kind == kind], 0.5) for kind in kinds]
        axes.bar(np.arange(len(kinds)) + 0.27 * (number - 1), medians, 0.25, color=colour, label=name)
    axes.set_yscale("log")
    axes.set_ylabel("median delay from the onset [s]")
    axes.set_xticks(range(len(kinds)), [_words(kind).replace(" of ", "\nof ") for kind in kinds])
    axes.set_title("Medium and large faults with enough motion", loc="left", fontsize=11)
    _plain(axes)
    axes.legend(frameon=False)


def draw_example(figure: Figure, _: Sequence[Trial], __: Sequence[Trial]) -> None:
    """One flight with its interval threshold."""
    log = judged(flight(*EXAMPLE))
    truth, (fault, *_rest), levels = log.flight.truth, log.seen.found.faults, log.seen.threshold
    assert truth is not None  # noqa: S101 - the example has a fault
    shown = np.abs(log.seen.residuals.time_s - truth.start_s) <= 10.0
    time_s = log.seen.residuals.time_s[shown]
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 3])
    upper.plot(time_s, log.seen.residuals.simulated_deg[shown], color=COLOURS["simulated"], lw=1.0, label="simulated")
    upper.plot(time_s, log.seen.residuals.measured_deg[shown], color=COLOURS["measured"], lw=1.0, label="measured")
    upper.set_ylabel("deflection [deg]")
    upper.set_title(
        f"{_words(truth.kind)} (gain {truth.parameters['gain']:g}) from {truth.start_s:.2f} s; named "
        f"{_words(fault.kind)} since {fault.start_s:.2f} s, alarm {fault.alarm_s:.2f} s",
        loc="left",
        fontsize=10,
    )
    level_deg, noise_deg = levels.level_deg[shown], DEFAULT_SIGMAS * levels.sigma_deg[shown]
    lower.fill_between(time_s, 0.0, noise_deg, color="0.85", lw=0, label="noise, 6 sigma")
    lower.fill_between(time_s, noise_deg, level_deg, color="0.93", lw=0, label="and tolerances")
    lower.plot(time_s, level_deg, color="0.4", lw=1.0, label="interval threshold")
    lower.axhline(CONSTANT_DEG, color="0.4", lw=1.0, ls="--", label="constant threshold")
    lower.plot(
        time_s, np.abs(log.seen.residuals.residual_deg[shown]), color=COLOURS["simulated"], lw=0.9, label="|residual|"
    )
    lower.set_ylabel("|residual| [deg]")
    lower.set_xlabel("time [s]")
    lower.set_ylim(0.0, 4.0)
    for axes in (upper, lower):
        axes.axvline(truth.start_s, color=COLOURS["fault"], lw=1.2, label="onset")
        axes.axvline(fault.alarm_s, color=COLOURS["fault"], lw=1.2, ls=":", label="alarm")
        _plain(axes)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _plain(axes: Axes) -> None:
    axes.grid(visible=True, color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _words(kind: str) -> str:
    return kind.replace("_", " ")
