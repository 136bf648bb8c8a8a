"""The rig: devices, protocols, guard, engine and run files."""
