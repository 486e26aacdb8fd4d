"""An identification as one HTML page that needs nothing else: no network, no script."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from servofd.outputs.identify_figures import identify_figures

if TYPE_CHECKING:
    from servofd.identification.result import Identification
    from servofd.outputs.identify_figures import Picture

__all__ = ["identify_page"]

_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>servofd identify: {{ surface }}</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; margin: 2rem auto; max-width: 60rem;
  padding: 0 1rem; }
table { border-collapse: collapse; }
th, td { text-align: left; padding: .25rem 1rem .25rem 0; border-bottom: 1px solid #ddd; }
td { font-variant-numeric: tabular-nums; }
figure { margin: 2rem 0; }
figure svg { width: 100%; height: auto; }
figcaption { color: #444; }
</style>
</head>
<body>
<main>
<h1>{{ surface }}: servo of order {{ order }}</h1>
<p>Identified from {{ source }}, method {{ method }}. Delay without the hold of the sampled command.</p>
<table>
<caption>Numbers and their 95&nbsp;% intervals</caption>
<thead><tr><th scope="col">quantity</th><th scope="col">value</th><th scope="col">interval</th></tr></thead>
<tbody>
{% for row in rows %}<tr><th scope="row">{{ row[0] }}</th><td>{{ row[1] }}</td><td>{{ row[2] }}</td></tr>
{% endfor %}</tbody>
</table>
{% if notes %}<h2>Notes</h2>
<ul>
{% for note in notes %}<li>{{ note }}</li>
{% endfor %}</ul>
{% endif %}{% for picture in pictures %}<figure>
<h2>{{ picture.title }}</h2>
{{ picture.svg }}
<figcaption>{{ picture.text }}</figcaption>
</figure>
{% endfor %}</main>
</body>
</html>
"""


def identify_page(found: Identification, source: str) -> str:
    """Text of the page.

    Parameters
    ----------
    found : Identification
        What was identified.
    source : str
        Where the data came from.
    """
    from jinja2 import Environment
    from markupsafe import Markup

    pictures = [
        {"title": p.title, "text": p.text, "svg": Markup(_inline(p))}  # noqa: S704 - our own figures, no user's text
        for p in identify_figures(found)
    ]
    return (
        Environment(autoescape=True)
        .from_string(_TEMPLATE)
        .render(
            surface=found.surface,
            order=found.servo.linear.order,
            method=found.method,
            source=source,
            rows=_rows(found),
            notes=found.notes,
            pictures=pictures,
        )
    )


def _rows(found: Identification) -> list[tuple[str, str, str]]:
    linear, servo = found.servo.linear, found.servo
    values: dict[str, tuple[str, float | None, float]] = {
        "dc_gain": ("dc gain", linear.gain, 1.0),
        "delay_s": ("delay [ms]", linear.delay_s, 1e3),
        "lag_s": ("total lag [ms]", linear.lag_s, 1e3),
        "bandwidth_rad_s": ("bandwidth [rad/s]", linear.transfer.bandwidth_rad_s, 1.0),
        "rate_up_deg_s": ("rate limit up [deg/s]", servo.rate_up_deg_s, 1.0),
        "rate_down_deg_s": ("rate limit down [deg/s]", servo.rate_down_deg_s, 1.0),
        "dead_band_deg": ("dead band [deg]", servo.dead_band_deg, 1.0),
    }
    for k, pole in enumerate(found.poles_rad_s):
        values[f"pole_{k}_real_rad_s"] = (f"pole {k + 1}, real part [rad/s]", pole.real, 1.0)
        if pole.imag:
            values[f"pole_{k}_imag_rad_s"] = (f"pole {k + 1}, imaginary part [rad/s]", pole.imag, 1.0)
    rows = []
    for name, (label, value, scale) in values.items():
        if value is not None and math.isfinite(value):
            interval = found.intervals.get(name)
            shown = "" if interval is None else f"{scale * interval.low:.5g} to {scale * interval.high:.5g}"
            rows.append((label, f"{scale * value:.5g}", shown))
    return [*rows, ("rms error [deg]", f"{found.rms_deg:.4g}", "")]


def _inline(picture: Picture) -> str:
    """SVG element with names of its own, so that several can stand in one page, and its text for screen readers."""
    svg = picture.svg()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{picture.name}-", svg)
    label: dict[str, Any] = {"&": "&amp;", '"': "&quot;", "<": "&lt;"}
    text = "".join(label.get(letter, letter) for letter in f"{picture.title}. {picture.text}")
    return svg.replace("<svg", f'<svg role="img" aria-label="{text}"', 1)
