"""Make every sample log anew, byte for byte: ``python sample_logs/make.py [FOLDER]``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from servofd.aircraft.schema import Aircraft, load_aircraft, plain_aircraft
from servofd.servo.faults import Failure
from servofd.servo.faults import Bias, DeadBand, Floating, HardOver, LossOfEffectiveness, Oscillation, Slow, Stuck
from servofd.simulation.flight import SimulatedFlight, simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.writers import write_flight

FLIGHT_S, CHIRP_S = 40.0, 120.0
RATE_HZ = 100.0
NOISE_DEG = 0.1

FLIGHTS: dict[str, dict[str, Failure]] = {
    "faser_healthy_flight": {},
    "faser_deadband_flight": {"aileron_right": DeadBand(start_s=0.0, width_deg=6.0)},
    "faser_stuck_flight": {"elevator": Stuck(start_s=5.0)},
}
CHIRPS: dict[str, dict[str, Failure]] = {
    "faser_healthy_chirp": {},
    "faser_deadband_chirp": {"aileron_right": DeadBand(start_s=0.0, width_deg=6.0)},
    "faser_stuck_chirp": {"aileron_right": Stuck(start_s=0.0)},
}
# The other failure modes, on surfaces whose positions FASER measured.
FAILURES: dict[str, dict[str, Failure]] = {
    "faser_bias_flight": {"rudder": Bias(start_s=12.0, bias_deg=3.0)},
    "faser_hardover_flight": {"elevator": HardOver(start_s=20.0, position_deg=-20.0)},
    "faser_floating_flight": {"aileron_left": Floating(start_s=12.0, amplitude_deg=4.0)},
    "faser_oscillation_flight": {"elevator": Oscillation(start_s=18.0, amplitude_deg=2.0, frequency_hz=3.0)},
    "faser_slow_flight": {"aileron_right": Slow(start_s=12.0, bandwidth_scale=0.4)},
    "faser_loss_flight": {"rudder": LossOfEffectiveness(start_s=12.0, gain=0.4)},
}
# Plain table, flown by hand: file, sample rate [Hz], what is hidden in it.
TABLES: dict[str, tuple[float, dict[str, Sequence[Failure]]]] = {
    "table_three_faults.csv": (
        40.0,
        {
            "elevator": (DeadBand(start_s=5.0, width_deg=6.0, end_s=14.0), Stuck(start_s=30.0)),
            "rudder": (Bias(start_s=10.0, bias_deg=2.5),),
        },
    ),
}
# File, generation of servo telemetry, sample rate [Hz], what is hidden in it.
AUTOPILOTS: dict[str, tuple[str | None, float, dict[str, Failure]]] = {
    "ardupilot_volz_stuck.bin": ("volz", 40.0, {"elevator": Stuck(start_s=20.0)}),
    "ardupilot_dronecan_healthy.bin": ("dronecan", 40.0, {}),
    "telemetry_stuck.tlog": (None, 40.0, {"elevator": Stuck(start_s=20.0)}),
    "px4_stuck.ulg": (None, 25.0, {"elevator": Stuck(start_s=20.0)}),
}
MEASURED = ("elevator", "rudder", "aileron_left", "aileron_right")
SURFACES = ("aileron", "elevator", "rudder")


def with_only(aircraft: Aircraft, surfaces: Iterable[str]) -> Aircraft:
    """The aircraft with some of its surfaces."""
    return aircraft.model_copy(update={"surfaces": {name: aircraft.surfaces[name] for name in surfaces}})


def flown_by_autopilot(name: str) -> tuple[Aircraft, SimulatedFlight]:
    """Aircraft and flight of one of `AUTOPILOTS`: the truth behind its log."""
    _, rate_hz, faults = AUTOPILOTS[name]
    aircraft = plain_aircraft(SURFACES, "hs225bb-eq31")
    flight = simulate_flight(
        aircraft,
        duration_s=FLIGHT_S,
        rate_hz=rate_hz,
        seed=7,
        faults=faults,
        noise_deg=NOISE_DEG,
        outputs=outputs_of(aircraft),
    )
    return aircraft, flight


def make(folder: Path) -> list[Path]:
    """Write all sample logs into a folder."""
    aircraft = load_aircraft("faser")
    written = []
    for command, duration_s, flown, cases in (
        ("flight", FLIGHT_S, aircraft, FLIGHTS),
        ("flight", FLIGHT_S, with_only(aircraft, MEASURED), FAILURES),
        ("chirp", CHIRP_S, with_only(aircraft, ["aileron_right"]), CHIRPS),
    ):
        for name, faults in cases.items():
            flight = simulate_flight(
                flown,
                command=command,
                duration_s=duration_s,
                rate_hz=RATE_HZ,
                seed=7,
                faults=faults,
                noise_deg=NOISE_DEG,
            )
            path = folder / f"{name}.mat"
            write_flight(path, flight, flown)
            written.append(path)
    for name, (rate_hz, several) in TABLES.items():
        plain = plain_aircraft(SURFACES, "hs225bb-eq31")
        flight = simulate_flight(
            plain,
            command="hand_flown",
            duration_s=FLIGHT_S,
            rate_hz=rate_hz,
            seed=7,
            faults=several,
            noise_deg=NOISE_DEG,
        )
        write_flight(folder / name, flight, plain)
        written.append(folder / name)
    for name, (generation, _, _) in AUTOPILOTS.items():
        aircraft, flight = flown_by_autopilot(name)
        write_flight(folder / name, flight, aircraft, generation=generation)
        written.append(folder / name)
    return written


if __name__ == "__main__":
    for path in make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent):
        print(path)
