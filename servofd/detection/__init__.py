"""From model and measurement to residual, alarm and verdict."""
