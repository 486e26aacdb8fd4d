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
from typing import TYPE_CHECKING, Any

import numpy as np

from hidden_physics import CONVERTER_DEG, HiddenRecord, hidden
from hidden_runs import columns

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["SURFACE", "TRUTH", "Recipe", "make", "seal", "table", "unseal", "write"]

SURFACE = "elevator"
TRUTH = "truth.json"
_FORMATS = {
    "time_s": "%.6g",
    "cmd_deg": "%.2f",
    "pos_deg": "%.3f",
    "airspeed_m_s": "%.1f",
    "servo_voltage_v": "%.2f",
    "run": "%d",
    "load_g": "%g",
}
"""Time to 0.1 ms, commands and loads as they are, positions to 1 % of the converter's step, sensors by their noise."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a log is made of; see `hidden_physics.hidden`, and `hidden_runs.columns` for one with a scene."""

    file: str
    seed: int
    effects: Mapping[str, Mapping[str, float]]
    excitation: str
    noise_deg: float
    spread: float = 0.0
    jitter_s: float = 0.0
    row_loss: float = 0.0
    scene: str = ""
    servo: str = "hs225bb-eq31"
    """What its user knows the servo to be."""

    @property
    def floor_deg(self) -> float:
        """Noise with that of the converter, as far as it is no hidden effect [deg]."""
        if self.scene:
            return self.noise_deg
        return math.hypot(self.noise_deg, CONVERTER_DEG / math.sqrt(12.0))

    def columns(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """What happened, by the names of columns; those of command and position without the surface's."""
        if self.scene:
            return columns(self.scene, self.seed, self.effects, self.noise_deg)
        return _columns(self._flown())

    def _flown(self) -> HiddenRecord:
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


def table(of: HiddenRecord | Recipe) -> bytes:
    """Plain table of a log."""
    named = of.columns() if isinstance(of, Recipe) else _columns(of)
    header = ",".join(f"{SURFACE}_{name}" if name in ("cmd_deg", "pos_deg") else name for name in named)
    text, formats = io.BytesIO(), [_FORMATS[name] for name in named]
    # Adding nothing turns a negative zero into a zero.
    np.savetxt(text, np.column_stack([*named.values()]) + 0.0, fmt=formats, delimiter=",", header=header, comments="")
    return text.getvalue()


def _columns(record: HiddenRecord) -> dict[str, NDArray[np.floating[Any]]]:
    return {
        "time_s": record.time_s,
        "cmd_deg": record.command_deg,
        "pos_deg": record.measured_deg,
        "airspeed_m_s": record.airspeed_m_s,
        "servo_voltage_v": record.servo_voltage_v,
    }


def write(of: HiddenRecord | Recipe, path: Path) -> Path:
    """Write a log as a plain table."""
    path.write_bytes(table(of))
    return path


def make(truth: Path, folder: Path) -> list[Path]:
    """Write all logs of a truth file into a folder."""
    return [write(recipe, folder / recipe.file) for recipe in unseal(truth.read_text())]
