"""Simulated flights with known truth."""
