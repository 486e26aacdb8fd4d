"""The ``[motion]`` table of an aircraft file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.toml_text import toml_lines, toml_value

if TYPE_CHECKING:
    from servofd.axes.schema import MotionModel

_COMMENTS = {
    "rate_hz": "samples a second at which it is judged",
    "reference_m_s": "airspeed at which the gains below hold",
    "days": "of the calibration flights: the more, the fewer false alarms",
    "explained": "share of the command's effect explained on days the model had not seen",
    "own_command": "false: its command always was a copy of another axis'",
    "suspect": "multiple of the largest statistic of the calibration flights",
    "fault": "multiple that is exceeded wrongly once in a hundred hours",
}


def motion_to_toml(model: MotionModel) -> str:
    """Text of the table, to stand at the end of an aircraft file."""
    document = model.model_dump(exclude_none=True)
    axes, regime = document.pop("axes"), document.pop("regime")
    lines = [
        "# What the aircraft's motion tells of its axes: fitted to healthy flights by servofd calibrate.",
        "[motion]",
    ]
    lines += toml_lines(document, _COMMENTS)
    lines += [
        "",
        "[motion.regime] # where the calibration flights were: nothing is judged outside",
        *toml_lines(regime, _COMMENTS),
    ]
    for name, axis in axes.items():
        spreads = axis.pop("spreads")
        lines += ["", f"[motion.axes.{name}]", *toml_lines(axis, _COMMENTS), "spreads = ["]
        lines += [f"    {toml_value(spread)}," for spread in spreads]
        lines += ["]"]
    return "\n".join(lines) + "\n"
