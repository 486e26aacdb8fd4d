"""The sample logs in which an effect is hidden: their recipes, sealed, and the tables made from them.

The seal keeps truths from eyes and from programs that look for words; it keeps no secret from who wants to know. The
logs are made from the sealed recipes, so that nothing else has to say what is in them.
"""

from __future__ import annotations

import base64
import io
import json
import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from hidden_physics import CONVERTER_DEG, HiddenRecord, hidden

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["SURFACE", "TRUTH", "Recipe", "make", "seal", "table", "unseal", "write"]

SURFACE = "elevator"
TRUTH = "truth.json"
_FORMATS = ("%.6g", "%.2f", "%.3f", "%.1f", "%.2f")
"""Of time, command, position, airspeed, voltage: 0.1 ms, exact, 1 % of the converter's step, noise of the sensors."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a log is made of; see `hidden_physics.hidden`."""

    file: str
    seed: int
    effects: Mapping[str, Mapping[str, float]]
    excitation: str
    noise_deg: float
    spread: float = 0.0
    jitter_s: float = 0.0
    row_loss: float = 0.0

    @property
    def floor_deg(self) -> float:
        """Noise with that of the converter, as far as it is no hidden effect [deg]."""
        return math.hypot(self.noise_deg, CONVERTER_DEG / math.sqrt(12.0))

    def log(self) -> HiddenRecord:
        """What happened."""
        return hidden(
            self.seed,
            self.effects,
            self.excitation,
            self.noise_deg,
            spread=self.spread,
            jitter_s=self.jitter_s,
            row_loss=self.row_loss,
        )


def seal(recipes: Iterable[Recipe]) -> str:
    """Text of a truth file.

    >>> recipe = Recipe("a.csv", 1, {"gain": {"gain": 0.8}}, "flight", 0.1)
    >>> "gain" in seal([recipe]), unseal(seal([recipe])) == (recipe,)
    (False, True)
    """
    plain = json.dumps([asdict(recipe) for recipe in recipes]).encode()
    return json.dumps({"sealed": base64.b64encode(zlib.compress(plain, 9)).decode()}) + "\n"


def unseal(text: str) -> tuple[Recipe, ...]:
    """Recipes in the text of a truth file."""
    plain = zlib.decompress(base64.b64decode(json.loads(text)["sealed"]))
    return tuple(Recipe(**entry) for entry in json.loads(plain))


def table(record: HiddenRecord) -> bytes:
    """Plain table of a log, with airspeed and voltage."""
    columns = (record.time_s, record.command_deg, record.measured_deg, record.airspeed_m_s, record.servo_voltage_v)
    header = f"time_s,{SURFACE}_cmd_deg,{SURFACE}_pos_deg,airspeed_m_s,servo_voltage_v"
    text = io.BytesIO()
    # Adding nothing turns a negative zero into a zero.
    np.savetxt(text, np.column_stack(columns) + 0.0, fmt=_FORMATS, delimiter=",", header=header, comments="")
    return text.getvalue()


def write(record: HiddenRecord, path: Path) -> Path:
    """Write a log as a plain table."""
    path.write_bytes(table(record))
    return path


def make(truth: Path, folder: Path) -> list[Path]:
    """Write all logs of a truth file into a folder."""
    return [write(recipe.log(), folder / recipe.file) for recipe in unseal(truth.read_text())]
