"""Everything that leaves servofd as a file: JSON, figures, recordings."""
