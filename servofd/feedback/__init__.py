"""Servo feedback in the logs of autopilots: which output each position belongs to, and what it means."""
