"""A servo's model fitted to good flights: its parameters, how sure they are, and what they do to the position."""
