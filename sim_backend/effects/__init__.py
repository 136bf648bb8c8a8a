"""The catalogue of candidate effects, which the nominal model leaves out: one file each.

Each is a parameterised change to the simulator at one named place. `base` says what an effect declares, finds them and
combines several, `run_state` is what they may depend on in a run.
"""
