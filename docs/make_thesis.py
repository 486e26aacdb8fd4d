"""Make ``docs/thesis.md`` and its pictures: ``python docs/make_thesis.py [FOLDER]``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import servofd
from servofd.aircraft.series import Series
from servofd.core.types import BoolArray, ComplexArray, FloatArray
from servofd.detection.nullspace import design_nullspace_filter
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import ResidualGenerator
from servofd.identification.identify import identify
from servofd.outputs.figure import chart_png, save_figure
from servofd.outputs.identify_report import identify_charts
from servofd.servo.effects.commands import Delay
from servofd.servo.faults import DeadBand, Failure, Stuck
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from servofd.simulation.commands import chirp, flight

HERE = Path(__file__).parent
SAMPLES = HERE.parent / "sample_logs"
RATE_HZ, POLE_RAD_S, THRESHOLD_DEG = 100.0, 50.0, 1.5
FLEET = 40
BENCH_SERVOS, BENCH_SCATTER, BENCH_DELAY_S, BENCH_NOISE_DEG = 3, 0.05, 5e-4, 0.2

PRINTED = {
    "s9254": ("127.6, 5074", "127.2"),
    "s9256": ("110.1, 469.2", "104.5"),
    "s3151": ("-8.63 ± 24.74i", "5.8"),
    "9360th": ("31.87, 3423", "31.73"),
    "hs225bb-fig310": ("-30.85, -52.4 ± 57.11i", "30.8"),
}
FIGURES = {
    "4.1, 4.2 (healthy)": ("faser_healthy_flight", "aileron_right"),
    "4.3": ("faser_healthy_chirp", "aileron_right"),
    "4.4": ("faser_deadband_chirp", "aileron_right"),
    "4.2 (faulty), 4.5": ("faser_deadband_flight", "aileron_right"),
    "4.6": ("faser_stuck_chirp", "aileron_right"),
    "4.7": ("faser_stuck_flight", "elevator"),
}


def main(folder: Path) -> None:
    sections = [
        introduction(),
        servo_table(),
        eq_3_1(),
        validation(folder),
        filter_design(),
        thresholds(),
        chirp_residual(),
        detection_times(),
        sample_figures(folder),
        decisions(),
    ]
    (folder / "thesis.md").write_text("\n".join(sections), encoding="utf-8")
    print(folder / "thesis.md")


def introduction() -> str:
    return """# The thesis, number by number

*Model-based Fault Detection for Low-cost UAV Actuators*, University of Minnesota, 2016: what its sections 3.4 and 4
print, beside what servofd computes. `python docs/make_thesis.py` writes this page. The flight and bench data of the
thesis are not published; where a number depends on them, servofd's stands on simulated data, and the line says so.
"""


def servo_table() -> str:
    rows = []
    for name, (poles, bandwidth) in PRINTED.items():
        servo = servo_named(name)
        transfer = servo.printed
        rows.append(
            f"| {name} | {poles} | {_poles(transfer.poles_rad_s)} | {bandwidth} | {transfer.bandwidth_rad_s:.2f} "
            f"({transfer.bandwidth_rad_s / (2 * np.pi):.2f} Hz) | {servo.rate_limit_deg_s:g} | "
            f"{1e3 * servo.delay_s:g} | {1e3 * servo.transport_delay_s:g} |"
        )
    return "\n".join(
        [
            "## Fig. 3.10: five servos",
            "",
            "| servo | poles printed | poles computed [rad/s] | bandwidth printed | computed [rad/s] | rate limit [deg/s] "
            "| delay printed [ms] | transport delay [ms] |",
            "|---|---|---|---|---|---|---|---|",
            *rows,
            "",
            "Bandwidth is the first frequency 3.00 dB below dc; no other definition gives the printed column. S3151's",
            "printed 5.8 is in Hz in a column of rad/s, and its 24.74 has two digits swapped. Three servos lost the signs",
            "of their poles. The printed delays were read off the frequency response of 100 Hz samples, which contains",
            "half a sample of hold (5 ms); the last column is what is left for the cable and the electronics.",
            "",
        ]
    )


def eq_3_1() -> str:
    transfer = servo_named("hs225bb-eq31").printed
    return f"""## Eq. 3.1: HS-225BB

| | thesis | servofd |
|---|---|---|
| poles [rad/s] | -24.84 and roots of s² + 70.04 s + 4921 | {_poles(transfer.poles_rad_s)} |
| dc gain | – | {transfer.dc_gain:.5f} (rounding; servofd scales it to 1, as Appendix A does) |
| bandwidth | 4.5 Hz (text, Fig. 3.6) | {transfer.bandwidth_rad_s / (2 * np.pi):.3f} Hz |

Eq. 3.1 and the HS-225BB of Fig. 3.10 are two fits, not two roundings of one; they are two entries of the library.
"""


def validation(folder: Path) -> str:
    found = identify([[bench_chirp(seed)] for seed in range(BENCH_SERVOS)])
    (folder / "images").mkdir(exist_ok=True)
    (folder / "images" / "bench_response.png").write_bytes(chart_png(identify_charts(found)["response"]))
    inside = [(r.frequency_rad_s >= 10.0) & (r.frequency_rad_s <= 100.0) for r in found.responses]
    smallest = min(e[w].min() for e, w in zip(found.normalized_errors(), inside, strict=True))
    largest = max(e[w].max() for e, w in zip(found.normalized_errors(), inside, strict=True))
    coherence = min(r.coherence[w].min() for r, w in zip(found.responses, inside, strict=True))
    linear = found.servo.linear
    figures = "![Magnitude, phase, coherence and normalised error over frequency](images/bench_response.png)"
    (healthy,) = servofd.audit(SAMPLES / "faser_healthy_flight.mat")
    aileron = next(s for s in healthy.surfaces if s.surface == "aileron_right")
    error_deg = aileron.statistics.simulation_error_rms_deg if aileron.statistics else float("nan")
    return f"""## Figs 3.6 to 3.9: validation

| | thesis | servofd |
|---|---|---|
| poles of the fit [rad/s] (Eq. 3.1) | -24.84, -35.02 ± 60.78i | {_poles(found.poles_rad_s)} |
| delay without the hold [ms] | 4 | {1e3 * linear.delay_s:.1f} |
| bandwidth (Fig. 3.6) | 4.5 Hz | {linear.transfer.bandwidth_rad_s / (2 * np.pi):.2f} Hz |
| normalised error, 10 to 100 rad/s (Fig. 3.8, Eq. 3.2) | 0.01 to 0.37 | {smallest:.1g} to {largest:.2f} |
| coherence, 10 to 100 rad/s (Fig. 3.7) | above 0.8 | above {np.floor(100.0 * coherence) / 100.0:.2f} |
| simulation error on FASER commands (Fig. 3.9) | 0.2 deg | {error_deg:.2f} deg on the simulated flight (noise put in: 0.10) |

The bench data are replaced by chirps (thesis 3.2.3) of {BENCH_SERVOS} simulated servos of Eq. 3.1 whose bandwidth differs by
{100 * BENCH_SCATTER:g} % and whose delay differs by {1e3 * BENCH_DELAY_S:g} ms, read with {BENCH_NOISE_DEG} deg of noise; `servofd identify` fits their mean. Figs 3.5 and 3.6, 3.7,
and 3.8:

{figures}
"""


def bench_chirp(seed: int) -> Series:
    """Chirp test of one of several servos of a kind."""
    servo, rng = servo_named("hs225bb-eq31"), np.random.default_rng(seed)
    shift = seed - (BENCH_SERVOS - 1) / 2
    transfer = servo.transfer.with_bandwidth_scaled(1.0 + BENCH_SCATTER * shift)
    model = ServoModel(transfer) + Delay(servo.delay_s + BENCH_DELAY_S * shift)
    time_s = np.round(np.arange(12000) / RATE_HZ, 9)
    command_deg = chirp(time_s, rng)
    measured_deg = model.simulate(time_s, command_deg, time_s) + BENCH_NOISE_DEG * rng.standard_normal(time_s.size)
    return Series(f"servo {seed + 1}", time_s, command_deg, time_s, measured_deg)


def filter_design() -> str:
    transfer = servo_named("hs225bb-eq31").printed
    row = design_nullspace_filter(transfer, POLE_RAD_S).rows[0]
    sampled = design_pulse_filter(transfer, 0.004, 1.0 / RATE_HZ, POLE_RAD_S)
    step = sampled.fault_step(11)
    x = POLE_RAD_S * np.arange(11) / RATE_HZ
    exact = 1.0 - np.exp(-x) * (1.0 + x + x**2 / 2.0 + x**3 / 6.0)
    cells = "\n".join(f"| {10 * k} | {exact[k]:.4f} | {step[k]:.4f} |" for k in range(1, 11))
    return f"""## Eqs 4.10 and 4.11: the filter

`servofd config --filter hs225bb-eq31 --pole 50 --printed-gain` prints Eq. 4.10 with its fractions multiplied out:

    Qy = ({row.qy[0]:.8f} s³ + {row.qy[1]:.6f} s² + {row.qy[2]:.4f} s + {row.qy[3]:.3f}) / (s + 50)⁴
    Qu = {row.qu[0][0]:.0f} / (s + 50)⁴

Eq. 4.9 drops the 4 ms delay without a word; servofd keeps it, and discretises the plant first. Residual after a fault
of 1 deg on the command, Eq. 4.11 and the sampled filter (held and delayed by 4 ms):

| time [ms] | Eq. 4.11 | servofd |
|---|---|---|
{cells}

Noise gain {sampled.noise_gain:.3f}; leakage from command to residual {_power_of_ten(sampled.leakage(np.linspace(1, 314, 99)))}.
"""


def thresholds() -> str:
    peaks, spread = [], np.random.default_rng(0)
    nominal = servo_named("hs225bb-eq31")
    time_s = np.arange(12_000) / RATE_HZ
    generator = ResidualGenerator(ServoModel.of(nominal), POLE_RAD_S)
    for seed in range(FLEET):
        gain, bias_deg = spread.uniform(0.97, 1.03), spread.uniform(-0.3, 0.3)
        transfer = nominal.transfer.with_bandwidth_scaled(spread.uniform(0.9, 1.1))
        scaled = TransferFunction(tuple(gain * c for c in transfer.numerator), transfer.denominator)
        real = ServoModel(scaled) + Delay(nominal.delay_s + spread.uniform(-0.003, 0.003))
        command_deg = flight(time_s, spread)
        noise_deg = 0.1 * spread.standard_normal(time_s.size)
        measured_deg = real.simulate(time_s, command_deg, time_s) + bias_deg + noise_deg
        residuals = generator.run(Series(str(seed), time_s, command_deg, time_s, measured_deg))
        peaks.append(float(np.max(np.abs(residuals.residual_deg[residuals.settled]))))
    return f"""## Figs 4.1 and 4.2: the threshold

| | thesis | servofd |
|---|---|---|
| largest residual of healthy servos on FASER commands | within ±1.5 | {max(peaks):.2f} deg in a fleet of {FLEET} |

The fleet: simulated HS-225BB, delay ±3 ms, bandwidth ±10 %, gain ±3 %, bias ±0.3 deg, noise 0.1 deg, 120 s each; median
of the largest residuals {np.median(peaks):.2f} deg. ±1.5 deg is what healthy servos of one type differ by, not a law.
"""


def chirp_residual() -> str:
    time_s = np.arange(12_000) / RATE_HZ
    command_deg = chirp(time_s, np.random.default_rng(0))
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    measured_deg = model.simulate(time_s, command_deg, time_s)
    segment = Series("chirp", time_s, command_deg, time_s, measured_deg)
    exact = ResidualGenerator(model, POLE_RAD_S).run(segment)
    undelayed = ResidualGenerator(ServoModel(model.transfer), POLE_RAD_S).run(segment)
    noisy = measured_deg + 0.25 * np.random.default_rng(1).standard_normal(time_s.size)
    with_noise = ResidualGenerator(model, POLE_RAD_S).run(Series("chirp", time_s, command_deg, time_s, noisy))

    def variance(residual_deg: FloatArray, settled: BoolArray) -> str:
        return f"{float(np.var(residual_deg[settled])):.4f}"

    return f"""## Fig. 4.3: healthy chirp

| residual of a healthy servo | mean | variance [deg²] |
|---|---|---|
| thesis (bench) | 0.00 | 0.02 |
| servofd, simulated, no noise | 0.00 | {variance(exact.residual_deg, exact.settled)} |
| the same, with the 4 ms delay left out of the filter | 0.00 | {variance(undelayed.residual_deg, undelayed.settled)} |
| servofd, with 0.25 deg of noise on the position | 0.00 | {variance(with_noise.residual_deg, with_noise.settled)} |

So the delay that Eq. 4.9 drops accounts for a good part of the thesis' variance, and noise for the rest.
"""


def detection_times() -> str:
    rows: list[tuple[str, str, Failure]] = [
        ("stuck (Fig. 4.7: 2.97 s to 3.05 s)", "0.08", Stuck(5.0)),
        ("increased dead band (Fig. 4.5: 7.98 s to 8.05 s)", "0.07", DeadBand(0.0, width_deg=8.0)),
    ]
    lines = []
    for name, printed, fault in rows:
        cells = [f"{delay_s:.2f}" for delay_s in (_delay(fault, 12.0, rate) for rate in (1e6, 205.0, 160.0, 50.0))]
        lines.append(f"| {name} | {printed} | {' | '.join(cells)} |")
    return "\n".join(
        [
            "## Figs 4.5 and 4.7: time from the first large manoeuvre to the alarm",
            "",
            "Manoeuvre of 12 deg, reached at the rate given (205 deg/s is the peak of the simulated flights); 100 Hz,",
            "threshold ±1.5 deg; times in seconds.",
            "",
            "| fault | thesis | step | 205 deg/s | 160 deg/s | 50 deg/s |",
            "|---|---|---|---|---|---|",
            *lines,
            "",
            "The thesis' figures are those of a fast input by a pilot. Slower manoeuvres, an autopilot's trimming among them,",
            "cannot be that fast: the filter's own response (Eq. 4.11) takes the time.",
            "",
        ]
    )


def _delay(fault: Failure, size_deg: float, rate_deg_s: float) -> float:
    """Seconds from the start of a ramp to the first sample over the threshold."""
    time_s, begin_s = np.arange(1200) / RATE_HZ, 8.0
    command_deg = np.clip((time_s - begin_s + 1e-9) * rate_deg_s, 0.0, size_deg)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    measured_deg = fault.deflection(model, time_s, command_deg, time_s)
    residuals = ResidualGenerator(model, POLE_RAD_S).run(Series("x", time_s, command_deg, time_s, measured_deg))
    return float(time_s[np.argmax(np.abs(residuals.residual_deg) >= THRESHOLD_DEG)]) - begin_s


def sample_figures(folder: Path) -> str:
    (folder / "images").mkdir(exist_ok=True)
    lines = ["## The figures of chapter 4", ""]
    for figure, (name, surface) in FIGURES.items():
        (result,) = servofd.audit(SAMPLES / f"{name}.mat")
        verdict = next(s for s in result.surfaces if s.surface == surface)
        save_figure(verdict, folder / "images" / f"{name}.png", f"{name}.mat")
        lines += [f"**Fig. {figure}**: {verdict.reason}.", "", f"![{name}, {surface}](images/{name}.png)", ""]
    return "\n".join(lines)


def decisions() -> str:
    return """## Where the thesis leaves a choice

| question | servofd |
|---|---|
| two models of the HS-225BB | both: `hs225bb-eq31` (default, behind chapter 4) and `hs225bb-fig310` |
| dc gain 1.00051 of Eq. 3.1 | scaled to 1; `unity_dc = false` in a servo entry keeps it |
| delay in the filter | exact, plant first |
| does the printed delay contain the hold? | field `hold`: Eq. 3.1 "zoh" (no), Fig. 3.10 "none" (yes) |
| order of the filter's inputs, and the sign | [measured, command]; a positive residual is output beyond the model |
| unit of the threshold | degrees; alarm when the residual's size is equal to it or above |
| "fault is declared in the first instance" | yes, and it latches: it ends when the surface has proved to be well |
| where the rate limit sits | on the output shaft, with exact instants of saturation and release |
| rate limit of the HS-225BB | 370 deg/s (Fig. 3.10); 332, 417 and 429 deg/s are given elsewhere |
| a residual that is not a number | never counts as healthy |
| Appendix A's numbers (30 ms, second order) | a template for another servo: taken as method, not as data |
| Appendix B as printed | does not parse, and gives zero for two inputs and two outputs; its purpose is followed |
"""


def _poles(poles_rad_s: ComplexArray) -> str:
    real = [f"{p.real:.2f}" for p in poles_rad_s if p.imag == 0.0]
    return ", ".join(real + [f"{p.real:.2f} ± {p.imag:.2f}i" for p in poles_rad_s if p.imag > 0.0])


def _power_of_ten(value: float) -> str:
    return "below 1e-12" if value < 1e-12 else f"{value:.0e}"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
