"""What everything stands on: types, errors, evidence, numbers as text."""
