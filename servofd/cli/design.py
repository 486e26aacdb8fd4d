"""``servofd config --filter``: the residual filter of a servo, and its proof."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from logparsers.units import MS_PER_S
from servofd.cli.terminal import say
from servofd.core.errors import DesignError
from servofd.detection.nullspace import design_nullspace_filter
from servofd.detection.pulse import design_pulse_filter, fastest_pole_rad_s
from servofd.servo.library import servo_named

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.detection.pulse import PulseFilter
_SHOWN_S = 0.3
"""Time after the onset of a fault that is shown [s]."""


def run(options: Options) -> int:
    """Print the design."""
    servo = servo_named(options.servo)
    if not 1e-3 <= options.rate_hz <= 1e6:
        raise DesignError(f"--rate-hz {options.rate_hz}: give a rate between 0.001 and 1e6 Hz")
    sample_time_s = 1.0 / options.rate_hz
    plant = servo.printed if options.printed_gain else servo.transfer
    pole = abs(options.pole) if options.pole is not None else fastest_pole_rad_s(plant, sample_time_s)
    row = design_nullspace_filter(plant, pole).rows[0]
    sampled = design_pulse_filter(plant, servo.transport_delay_s, sample_time_s, pole)
    leakage = sampled.leakage(np.linspace(0.1, np.pi * options.rate_hz, 400))
    say(f"{servo.title}, filter pole {pole:g} rad/s, {options.rate_hz:g} Hz")
    say("\nQ(s) = [Qy Qu], residual = Qy measured + Qu command (thesis Eq. 4.7), without the delay:")
    say(f"  Qy numerator   {_polynomial(row.qy)}")
    say(f"  Qu numerator   {_polynomial(row.qu[0])}")
    say(f"  denominator    {_polynomial(row.denominator)}")
    say(f"  poles          {', '.join(f'{p.real:g}' for p in row.poles_rad_s)} rad/s")
    say(f"  dc gain        Qy {row.dc_qy:.6f}, Qu {row.dc_qu[0]:.6f}, fault to residual {row.faults[0].dc_gain:.6f}")
    say(f"\nOn samples (plant first: hold and a delay of {MS_PER_S * servo.transport_delay_s:g} ms exact):")
    say(f"  noise gain     {sampled.noise_gain:.4f} (residual noise per white noise on the measurement)")
    say(f"  leakage        {leakage:.1e} (largest gain from command to residual: the proof)")
    _print_step(sampled)
    return 0


def _polynomial(coefficients: tuple[float, ...]) -> str:
    order = len(coefficients) - 1
    return " + ".join(
        f"{c:.10g}" + ("" if order == i else " s" if order - i == 1 else f" s^{order - i}")
        for i, c in enumerate(coefficients)
    )


def _print_step(sampled: PulseFilter) -> None:
    """A few points of the response, the threshold of the thesis among them."""
    step = sampled.fault_step(max(2, round(_SHOWN_S / sampled.sample_time_s)) + 1)
    say("  residual after a fault of 1 deg on the command:")
    for share in (0.1, 0.25, 0.5, 0.9):
        reached = next((k for k, value in enumerate(step) if value >= share), None)
        when = f"{1e3 * reached * sampled.sample_time_s:.0f} ms" if reached is not None else "later than 300 ms"
        say(f"    {share:.0%} after {when}")
