"""Rerun recordings: written, read back, repaired; the only package that imports rerun."""

from servofd.outputs.recording.write import save_recording

__all__ = ["save_recording"]
