"""The surveillance as a Lua script that runs on an ArduPilot autopilot itself."""
