"""One aircraft over many flights: how each servo changes, since when, and when it will be too much."""
