"""Takes the pictures of docs/recordings.md in the viewer itself, without a window: ``python docs/make_recordings.py``."""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
FAULT_SEEN_S = 36.0
"""A moment at which the pilot pulls and the elevator does not follow."""
_MENU = 26 / 788
"""Share of the picture that is the viewer's menu."""


def main(docs: Path = ROOT / "docs") -> None:
    sys.path.insert(0, str(ROOT))
    import servofd
    from servofd.outputs.recording.write import save_recording
    from tests.pictures.viewer import viewer

    folder = docs / "recordings"
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name, viewer() as view:
        recording = Path(name) / "faser_stuck_flight.rrd"
        save_recording(next(iter(servofd.audit(ROOT / "sample_logs" / "faser_stuck_flight.mat"))), recording)
        tabs = view.open(recording)
        view.set_time(FAULT_SEEN_S)
        for tab, what in ((0, "overview"), (1, "fault")):
            target = folder / f"viewer_{what}.png"
            target.write_bytes(without_menu(view.picture(tabs[tab])))
            print(target.name)


def without_menu(png: bytes) -> bytes:
    """The same picture without the viewer's menu, which tells on what machine it was taken."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB")
    top = round(_MENU * picture.height)
    cropped = io.BytesIO()
    picture.crop((0, top, picture.width, picture.height)).save(cropped, "PNG", optimize=True)
    return cropped.getvalue()


if __name__ == "__main__":
    main()
