"""Servo physics: transfer functions, effects, faults, and the compiled kernel."""
