"""The current of a servo as a second witness: where it comes from, what a healthy one is, and what it tells."""
