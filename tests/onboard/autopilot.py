"""An ArduPilot that runs a script: real Lua 5.3 with 32-bit numbers, and as much around it as a script of ours sees."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.onboard.float32 import in_32_bits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.core.types import FloatArray, IntArray

__all__ = ["Flight", "Flown", "fly"]

_STUBS_FILE = Path(__file__).with_name("autopilot.lua")
_STUBS = _STUBS_FILE.read_text()
_LOGGED = [
    ("time_us", "<i4"),
    ("output", "<u2"),
    *((n, "<f4") for n in ("command", "simulated", "measured", "residual", "level")),
]


@dataclass(frozen=True)
class Flight:
    """What a script is shown: calls at `time_us` [us since boot, beyond 2^31 too]."""

    time_us: IntArray
    pulse_us: Mapping[int, FloatArray | IntArray]
    """Output (from 1) to pulses; 0 where there is none."""
    position_deg: Mapping[int, FloatArray]
    """NaN where no new position came."""
    armed: bool = True


@dataclass(frozen=True)
class Flown:
    """What the script did."""

    texts: list[tuple[int, str]]
    """Time [us, as an int32] and text."""
    refusals: list[str]
    """Of arming, in order; empty where it is allowed."""
    log: Any
    """Rows of SFD."""
    most_instructions: int
    heap_kb: float
    named: int
    ended: bool

    def of(self, output: int) -> Any:
        """Its rows of SFD."""
        return self.log[self.log["output"] == output]

    def said(self, name: str) -> list[str]:
        """Texts about one surface."""
        return [text for _, text in self.texts if text.startswith(name)]


def fly(
    script: str,
    flight: Flight,
    folder: Path,
    *,
    counted: bool = False,
    old: bool = False,
    parameters: Mapping[str, float] | None = None,
) -> Flown:
    """Run a script through a flight; `counted` counts its instructions, `old` is an autopilot without telemetry."""
    from lupa.lua53 import LuaRuntime

    outputs = rows_of(flight, folder)
    lua = LuaRuntime(unpack_returned_tuples=True)
    world = lua.globals()
    world.SCRIPT = script if counted else in_32_bits(script)
    world.INPUT, world.OUTPUT = str(folder / "rows.bin"), str(folder / "log.bin")
    world.OUTPUTS = lua.table_from(outputs)
    world.PARAMETERS = lua.table_from(dict(parameters or {}))
    world.COUNTED, world.OLD = counted, old
    result = lua.execute(_STUBS)
    return Flown(
        texts=[(text[1], text[3]) for text in result.texts.values()],
        refusals=list(result.refusals.values()),
        log=np.fromfile(folder / "log.bin", dtype=_LOGGED),
        most_instructions=result.most_instructions,
        heap_kb=result.most_heap_kb,
        named=result.named,
        ended=bool(result.ended),
    )


def rows_of(flight: Flight, folder: Path) -> list[int]:
    """Write the rows that the stubs read; the outputs that are in them."""
    outputs = list(flight.pulse_us)
    fields = [("time_us", "<i4"), ("armed", "<i4")]
    for output in outputs:
        fields += [(f"pulse_{output}", "<f4"), (f"deg_{output}", "<f4"), (f"ms_{output}", "<i4")]
    rows = np.zeros(flight.time_us.size, dtype=fields)
    rows["time_us"] = (flight.time_us & 0xFFFFFFFF).astype(np.uint32).view(np.int32)
    rows["armed"] = flight.armed
    for output in outputs:
        deg = flight.position_deg[output].astype(np.float32)
        came = np.maximum.accumulate(np.where(np.isfinite(deg), np.arange(deg.size), -1))
        rows[f"pulse_{output}"] = flight.pulse_us[output]
        rows[f"deg_{output}"] = np.where(came >= 0, deg[came], np.nan)
        rows[f"ms_{output}"] = np.where(came >= 0, (flight.time_us[came] // 1000) & 0x7FFFFFFF, -1)
    rows.tofile(folder / "rows.bin")
    return outputs
