"""The live monitor: a MAVLink stream in; alarms, a view and recordings out."""
