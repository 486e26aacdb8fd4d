"""One flight alone: what its own columns tell, without feedback, other flights, or an aircraft file."""
