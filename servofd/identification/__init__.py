"""From bench tests to a servo: frequency response, fit, rate limits, calibration (thesis chapter 3)."""
