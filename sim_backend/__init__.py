"""The simulated rig and gut: friction model, candidate effects, simulated devices, and a plant for blind checks."""
