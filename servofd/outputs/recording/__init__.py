"""Rerun recordings: written, read back, repaired; the only package that imports rerun."""
