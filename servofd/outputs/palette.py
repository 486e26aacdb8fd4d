"""The colours of servofd, the same in recordings, figures, pages and terminals.

From M. Okabe and K. Ito, Color Universal Design (2008): eyes with any of the common colour deficiencies can tell them
apart, and all but ``other``, the last resort, stand out (contrast above 2.2) from white paper as well as from the
viewer's black.
"""

from __future__ import annotations

from collections.abc import Mapping

COLOURS: Mapping[str, str] = {
    "command": "#8c8c8c",
    "simulated": "#0072b2",
    "measured": "#e69f00",
    "residual": "#009e73",
    "threshold": "#8c8c8c",
    "ok": "#009e73",
    "suspect": "#cc79a7",
    "fault": "#d55e00",
    "no_data": "#8c8c8c",
    "unknown": "#56b4e9",
    "other": "#f0e442",
}
"""What is drawn, to ``#rrggbb``. A residual has the colour of a healthy surface until it is not one."""

SERIES = ("simulated", "measured", "ok", "suspect", "unknown", "other", "command", "fault")
"""Names of colours for curves that stand for nothing else, the first eight of them."""

STATUS_COLOURS: Mapping[str, str] = {
    "healthy": COLOURS["ok"],
    **{status: COLOURS[status] for status in ("suspect", "fault", "no_data", "unknown")},
}
"""Status of a surface, to ``#rrggbb``."""


BANNER_COLOURS: Mapping[str, str] = {
    "healthy": "#00694d",
    "suspect": "#8a3d68",
    "fault": "#a33c00",
    "no_data": "#555b66",
    "unknown": "#1f5f8b",
}
"""Ground under white letters, of the same hues: contrast above 6, where 4.5 is asked for (WCAG 2.1, AA)."""


def rgba(name: str, opacity: float = 1.0) -> int:
    """Colour as one number 0xRRGGBBAA, as Rerun takes it."""
    return (int(COLOURS[name][1:], 16) << 8) | round(255 * opacity)
