"""Make the pictures of ``docs/odds.md``: ``python docs/make_odds.py [FOLDER]``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from servofd.aircraft.schema import plain_aircraft
from servofd.detection.probability import SurfaceOdds, Wish
from servofd.detection.pulse import design_pulse_filter
from servofd.jobs.odds import Part, odds_from_design, odds_from_logs
from servofd.outputs.odds_figure import save_odds_figure
from servofd.servo.library import servo_named

SERVO, RATE_HZ, POLE_RAD_S, NOISE_DEG, HOURS, DEGREES_OF_FREEDOM = "hs225bb-eq31", 100.0, 50.0, 0.1, 10, 6


def main(folder: Path) -> None:
    wish = Wish(false_alarms_per_hour=0.1)
    pictures = {
        "design.png": odds_from_design(
            plain_aircraft(["elevator"], "hs225bb-eq31"), wish, noise_deg=NOISE_DEG, rate_hz=RATE_HZ
        )[0],
        "heavy.png": heavy_tailed(wish),
    }
    (folder / "odds").mkdir(exist_ok=True)
    for name, odds in pictures.items():
        save_odds_figure(odds, folder / "odds" / name)
        print(folder / "odds" / name)


def heavy_tailed(wish: Wish) -> SurfaceOdds:
    """Ten healthy hours whose measurement noise is Student's t with six degrees of freedom."""
    design = design_pulse_filter(servo_named(SERVO).transfer, 0.004, 1.0 / RATE_HZ, POLE_RAD_S)
    white = np.random.default_rng(1).standard_t(DEGREES_OF_FREEDOM, round(3600 * HOURS * RATE_HZ))
    noise_deg = NOISE_DEG * np.sqrt((DEGREES_OF_FREEDOM - 2.0) / DEGREES_OF_FREEDOM) * white
    record = lfilter(design.g * design.a, design.md, noise_deg)
    (odds,) = odds_from_logs([Part("elevator", SERVO, "ten healthy hours", 1.5, design, record)], wish)
    if not isinstance(odds, SurfaceOdds):
        raise TypeError(odds.reason)
    return odds


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
