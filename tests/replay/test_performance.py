"""The page of performance has the form that its script writes; its numbers are those of one machine."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PAGE = (ROOT / "docs" / "performance.md").read_text()
ROW = re.compile(r"^\| (.*?) \| (.*?) \| ([\d.e+]+) \| ([\d.e-]+) s \| ([\d.e-]+) s \| (.*?) \|$", re.MULTILINE)


@pytest.mark.slow
def test_the_page_has_the_form_of_its_script() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "make_performance.py"))
    rows = [
        script["Row"](what, peer, float(ours), float(theirs), remark)
        for what, peer, _, ours, theirs, remark in ROW.findall(PAGE)
    ]
    told = PAGE.partition("## Machine and versions\n\n")[2].partition("\n\n##")[0]
    written = script["page"](rows, told)
    ratio = re.compile(r" \| [\d.e+]+ \|")
    assert ratio.sub(" | # |", written) == ratio.sub(" | # |", PAGE)
    assert all(name in told for name in (*script["PACKAGES"], "Python"))


def test_the_ratios_are_those_of_the_times() -> None:
    """Times are rounded to two digits."""
    found = ROW.findall(PAGE)
    assert len(found) == 11
    for _, _, ratio, ours, theirs, _ in found:
        assert 0.88 < float(ratio) / (float(theirs) / float(ours)) < 1.13


def test_every_peer_that_was_promised_is_there() -> None:
    peers = " ".join(peer for _, peer, *_ in ROW.findall(PAGE))
    for name in ("pymavlink", "pyulog", "python-control", "scipy", "PySINDy", "rerun", "Parquet"):
        assert name in peers
