"""Pre-flight check: judges a short commanded sweep on the ground."""
