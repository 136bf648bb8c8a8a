"""The simulated rig behind the device protocols of `dragrig.rig.devices`."""
