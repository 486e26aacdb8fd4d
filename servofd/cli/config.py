"""``servofd config``: an aircraft file drafted from a log; ``--servos``: the library; ``--filter``: a filter."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from logparsers.units import MS_PER_S
from servofd.cli.options import Options
from servofd.cli.terminal import print_table, say
from servofd.core.errors import DesignError, NoMeasurement
from servofd.detection.nullspace import design_nullspace_filter
from servofd.detection.pulse import design_pulse_filter, fastest_pole_rad_s
from servofd.feedback.draft import draft_to_toml
from servofd.feedback.flown import flown_aircraft, one_log
from servofd.servo.library import Servo, library, servo_named

_SHOWN_S = 0.3
"""Time after the onset of a fault that is shown [s]."""


def run(options: Options) -> int:
    """Print the draft."""
    # Of what was booted more than once, the longest flight tells most.
    log = max(one_log(options.log).by_boots(), key=lambda flight: flight.duration_s)
    if log.is_of_autopilot:
        say(draft_to_toml(log), end="")
    elif log.format == "faser":
        raise NoMeasurement(f"{log.label}: FASER logs have their aircraft file: configs/faser.toml")
    else:
        aircraft = flown_aircraft(log)
        if not any(surface.model.predicts for surface in aircraft.surfaces.values()):
            raise NoMeasurement(
                f"{log.label}: no servo can be fitted to {', '.join(aircraft.surfaces)}: record commands and positions "
                "of a flight in which they move"
            )
        say(draft_to_toml(log, aircraft), end="")
    return 0


def run_servos(options: Options) -> int:
    """Print the servo library."""
    servos = library()
    if options.json:
        say(json.dumps({name: _record(servo) for name, servo in servos.items()}, indent=2))
        return 0
    rows = []
    for name, servo in servos.items():
        printed, delay = servo.printed, f"{MS_PER_S * servo.transport_delay_s:g}"
        bandwidth = f"{printed.bandwidth_rad_s:.2f}  {printed.bandwidth_rad_s / (2 * math.pi):.2f}"
        rate = f"{servo.rate_limit_deg_s:g}" if servo.rate_limit_deg_s else "-"
        delay += "" if servo.hold == "zoh" else f" ({MS_PER_S * servo.delay_s:g})"
        # Real poles, then pairs, of which each is listed once.
        real = [f"{p.real:.2f}" for p in printed.poles_rad_s if p.imag == 0.0]
        poles = ", ".join(real + [f"{p.real:.2f} ± {p.imag:.2f}i" for p in printed.poles_rad_s if p.imag > 0.0])
        rows.append([name, poles, f"{printed.dc_gain:.5f}", bandwidth, rate, delay, servo.source])
    head = ("servo", "poles [rad/s]", "dc gain", "bandwidth [rad/s] [Hz]", "rate [deg/s]", "delay [ms]", "source")
    print_table(head, rows)
    say(
        "Bandwidth: 3.00 dB below dc. Delay: transport delay used in simulation, without the hold of the sampled\n"
        "command; in brackets the printed one where it contains that hold. dc gain: as printed; servofd scales it to 1."
    )
    if options.notes:
        for name, servo in servos.items():
            say(f"\n{name}: {servo.title}")
            for note in servo.notes:
                say(f"  - {note}")
    return 0


def _record(servo: Servo) -> dict[str, Any]:
    transfer, names = servo.printed, ("numerator", "denominator", "poles_rad_s", "dc_gain", "bandwidth_rad_s")
    known = servo.model_dump(exclude_none=True) | {name: getattr(transfer, name) for name in names}
    poles_rad_s = [[p.real, p.imag] for p in transfer.poles_rad_s]
    return known | {"poles_rad_s": poles_rad_s, "transport_delay_s": servo.transport_delay_s}


def run_design(options: Options) -> int:
    """Print the residual filter of a servo, and its proof."""
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
    # A few points of the response, the threshold of the thesis among them.
    step = sampled.fault_step(max(2, round(_SHOWN_S / sample_time_s)) + 1)
    say("  residual after a fault of 1 deg on the command:")
    for share in (0.1, 0.25, 0.5, 0.9):
        reached = next((k for k, value in enumerate(step) if value >= share), None)
        when = f"{1e3 * reached * sample_time_s:.0f} ms" if reached is not None else "later than 300 ms"
        say(f"    {share:.0%} after {when}")
    return 0


def _polynomial(coefficients: tuple[float, ...]) -> str:
    order = len(coefficients) - 1
    return " + ".join(
        f"{c:.10g}" + ("" if order == i else " s" if order - i == 1 else f" s^{order - i}")
        for i, c in enumerate(coefficients)
    )
