"""Residuals of a 30-minute flight with six surfaces at 100 Hz, against python-control on the same data.

Run it from anywhere: ``python benchmarks/residual.py``. Absolute times depend on the machine; the ratio, measured
in one run, hardly does. python-control computes the same residual with the same filter, Q(z) applied to measured
deflection and command by `forced_response`; it is timed on a part of the flight and scaled (its time is
proportional to the number of samples).
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import control
import numpy as np

from servofd.aircraft.series import Series
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import ResidualGenerator
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight

if TYPE_CHECKING:
    from collections.abc import Callable

SURFACES, RATE_HZ, DURATION_S, POLE_RAD_S = 6, 100.0, 1800.0, 50.0
PEER_SAMPLES = 10_000
REPEATS = 5


def main() -> None:
    servo = servo_named("hs225bb-eq31")
    model = ServoModel.of(servo)
    generator = ResidualGenerator(model, POLE_RAD_S)
    time_s = np.round(np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ, 9)
    segments = []
    for seed in range(SURFACES):
        command_deg = flight(time_s, np.random.default_rng(seed))
        measured_deg = model.simulate(time_s, command_deg, time_s)
        segments.append(Series(str(seed), time_s, command_deg, time_s, measured_deg))
    samples = SURFACES * time_s.size

    def last(segment: Series) -> float:
        """Last residual; the rest is given back, so that fresh memory is not what is measured."""
        return float(generator.run(segment).residual_deg[-1])

    last(segments[0])  # compile
    one = min(timed(lambda: [last(segment) for segment in segments]) for _ in range(REPEATS))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        many = min(timed(lambda: list(pool.map(last, segments)), time.perf_counter) for _ in range(REPEATS))
    peer_time, difference_deg = peer(segments[0], generator)
    peer_full = peer_time * samples / PEER_SAMPLES
    jitter = jittered(segments[0], model, generator)
    print(f"residuals of {DURATION_S / 60:.0f} min x {SURFACES} surfaces at {RATE_HZ:.0f} Hz ({samples:,} samples)")
    print(f"  servofd, one thread       {one:8.3f} s   {samples / one / 1e6:6.1f} million samples/s")
    print(f"  servofd, {os.cpu_count()} threads        {many:8.3f} s   {samples / many / 1e6:6.1f} million samples/s")
    print(
        f"  servofd, jittered stamps  {jitter * samples:8.3f} s   {1e-6 / jitter:6.1f} million samples/s (one thread)"
    )
    print(
        f"  python-control            {peer_full:8.1f} s   {samples / peer_full / 1e6:6.3f} million samples/s (scaled)"
    )
    print(f"  ratio python-control / servofd: {peer_full / one:.0f} on one thread, {peer_full / many:.0f} on all")
    print(f"  largest difference of the two residuals: {difference_deg:.1e} deg")


def timed(action: object, clock: Callable[[], float] = time.thread_time) -> float:
    """Processor time, as the peer's; of several threads the time that passes."""
    begin = clock()
    action()  # type: ignore[operator]
    return clock() - begin


def peer(segment: Series, generator: ResidualGenerator) -> tuple[float, float]:
    """Processor time of python-control for the first samples, and how far its residual is from ours."""
    design = design_pulse_filter(generator.model.transfer, generator.model.delay_s, 1.0 / RATE_HZ, POLE_RAD_S)
    order = max(design.b[0].size, design.md.size)
    md = np.append(design.md, np.zeros(order - design.md.size))
    parts = [
        control.tf2ss(control.tf(np.append(p, np.zeros(order - p.size)) * design.g, md, dt=1.0 / RATE_HZ))
        for p in (design.a, -design.b[0])
    ]
    both = control.append(*parts)
    filter_q = control.ss(both.A, both.B, np.ones((1, 2)) @ both.C, np.ones((1, 2)) @ both.D, 1.0 / RATE_HZ)
    rest_deg = segment.command_deg[0]
    inputs = np.vstack([segment.measured_deg, segment.command_deg])[:, :PEER_SAMPLES] - rest_deg
    begin = time.process_time()
    response = control.forced_response(filter_q, segment.measured_s[:PEER_SAMPLES], inputs)
    elapsed = time.process_time() - begin
    ours = generator.run(segment).residual_deg[:PEER_SAMPLES]
    return elapsed, float(np.max(np.abs(np.ravel(response.outputs) - ours)))


def jittered(segment: Series, model: ServoModel, generator: ResidualGenerator) -> float:
    """Seconds per sample when every interval differs and nothing can be kept."""
    time_s = segment.command_s + np.random.default_rng(0).uniform(-0.003, 0.003, segment.command_s.size)
    measured_deg = model.simulate(time_s, segment.command_deg, time_s)
    irregular = Series("jittered", time_s, segment.command_deg, time_s, measured_deg)
    return min(timed(lambda: generator.run(irregular)) for _ in range(REPEATS)) / time_s.size


if __name__ == "__main__":
    main()
