"""Logs of benches for the hidden set: a servo of another structure, and runs of one that nobody knows.

What moves is that of `places` and of `validity`, neither of which shares code with servofd. A recipe names the scene
and its seed; what is hidden is in its effects, and beside them what else an answer has to tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import places
import validity

__all__ = ["SCENES", "columns"]

Floats = NDArray[np.floating[Any]]
_NATURAL_RAD_S, _DAMPING, _SLEW_DEG_S = 38.0, 0.8, 260.0
_TORQUE_S, _TORQUE_HZ, _TORQUE_RUNS = 12.0, 50.0, 6
_LAW_S, _LAW_HZ, _HELD_S = 6.0, 100.0, 0.8
_LOAD_G: Final = np.arange(0.0, 400.0, 50.0)


def _structure(seed: int, effects: Mapping[str, Mapping[str, float]], noise_deg: float) -> dict[str, Floats]:
    """A lively command of a servo whose slow pole is after its loop."""
    rng = np.random.default_rng([93, seed])
    time_s = np.arange(3000) / places.RATE_HZ
    command_deg = np.round(places.command(rng, "aerobatic", time_s), 2)
    supply_v = np.round(6.0 - 0.8 * time_s / time_s[-1], 2)
    truth = {name: value for parameters in effects.values() for name, value in parameters.items()}
    known = {"deadband": truth.get("width_deg", 0.0), "rate_limit": truth.get("rate_limit_deg_s", 1e9)}
    moved_deg = places.moved("after", known, [1.02, 0.98], 1.03, command_deg, supply_v, late_s=0.004)
    measured_deg = moved_deg + noise_deg * rng.standard_normal(time_s.size)
    return {"time_s": time_s, "cmd_deg": command_deg, "pos_deg": measured_deg, "servo_voltage_v": supply_v}


def _torque(seed: int, effects: Mapping[str, Mapping[str, float]], noise_deg: float) -> dict[str, Floats]:
    """Six runs; in one of them the motor does nothing from an instant on."""
    rng = np.random.default_rng([94, seed])
    time_s = np.arange(round(_TORQUE_S * _TORQUE_HZ)) / _TORQUE_HZ
    lost = effects["torque_lost"]
    grip_deg, runs = effects["friction"]["friction_deg"], []
    for run in range(_TORQUE_RUNS):
        waves = [
            rng.uniform(4.0, 9.0) * np.sin(2.0 * np.pi * rng.uniform(0.2, 1.4) * time_s + rng.uniform(0.0, 6.3))
            for _ in range(4)
        ]
        command_deg = np.round(np.sum(waves, axis=0), 2)
        first = lost["start_s"] if run == round(lost["run"]) else np.inf
        numbers = np.array([_NATURAL_RAD_S, _DAMPING, _SLEW_DEG_S, grip_deg, 0.0, first, np.inf, 2.0])
        moved_deg = validity.moved(numbers, command_deg, _TORQUE_HZ)
        measured_deg = moved_deg + noise_deg * rng.standard_normal(time_s.size)
        runs.append(_run(run, time_s, command_deg, measured_deg))
    return _joined(runs)


def _law(seed: int, effects: Mapping[str, Mapping[str, float]], noise_deg: float) -> dict[str, Floats]:
    """Eight runs of steps; the highest speed falls with the load that is logged beside each."""
    rng = np.random.default_rng([95, seed])
    time_s = np.arange(round(_LAW_S * _LAW_HZ)) / _LAW_HZ
    limit = effects["rate_limit"]
    grip_deg, runs = effects["friction"]["friction_deg"], []
    for run, load_g in enumerate(_LOAD_G):
        levels = np.round(rng.uniform(-20.0, 20.0, time_s.size), 2)
        command_deg = levels[(time_s / _HELD_S).astype(int)]
        slew = limit["at_zero"] + limit["slope"] * load_g
        numbers = np.array([_NATURAL_RAD_S, _DAMPING, slew, grip_deg, 0.0, np.inf, np.inf, 0.0])
        late_deg = np.append(command_deg[:1], command_deg[:-1])  # by a pulse frame of 10 ms
        moved_deg = validity.moved(numbers, late_deg, _LAW_HZ)
        measured_deg = moved_deg + noise_deg * rng.standard_normal(time_s.size)
        runs.append(_run(run, time_s, command_deg, measured_deg) | {"load_g": np.full(time_s.size, load_g)})
    return _joined(runs)


def _run(number: int, time_s: Floats, command_deg: Floats, measured_deg: Floats) -> dict[str, Floats]:
    full = np.full(time_s.size, float(number))
    return {"run": full, "time_s": time_s, "cmd_deg": command_deg, "pos_deg": measured_deg}


def _joined(runs: list[dict[str, Floats]]) -> dict[str, Floats]:
    return {name: np.concatenate([each[name] for each in runs]) for name in runs[0]}


SCENES: Final = {"structure": _structure, "torque": _torque, "law": _law}


def columns(
    scene: str, seed: int, effects: Mapping[str, Mapping[str, float]], noise_deg: float
) -> Mapping[str, Floats]:
    """Columns of the table, by name.

    >>> hidden = {"rate_limit": {"at_zero": 380.0, "slope": -0.5}, "friction": {"friction_deg": 0.3}}
    >>> [*columns("law", 1, hidden, 0.1)]
    ['run', 'time_s', 'cmd_deg', 'pos_deg', 'load_g']
    """
    return SCENES[scene](seed, effects, noise_deg)
