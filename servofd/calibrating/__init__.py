"""Calibration of an aircraft from flights that are known to be good."""
