"""The stand-in for rig and gut: the friction model and the simulated devices."""
