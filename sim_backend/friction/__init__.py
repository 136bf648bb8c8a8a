"""The velocity-dependent friction model as pure functions of motion and parameters."""
