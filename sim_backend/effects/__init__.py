"""What the nominal model leaves out: the catalogue of candidate effects, one file each.

Each is a parameterised change to the simulator at one named place. `catalogue` finds them, `scene` is what they see
of a run, `applied` puts several together.
"""
