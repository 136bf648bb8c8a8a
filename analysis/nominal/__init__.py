"""Nominal models: what identifies, compares and diagnoses sees of a model.

| module | what |
|---|---|
| `protocol` | the protocol that a model fulfils: parameters with priors, predicted channels of a run |
| `experiment` | one run as a model sees it: what was done, and the measured motion |
| `capsule`, `capsule_parameters`, `capsule_forces`, `capsule_sliding` | the paper's friction model |
| `drive`, `load` | the stage alone, from its recorded motor force, and what hangs on it |
| `kinematics`, `velocity_chain` | velocity and acceleration from a position in counts |
| `own` | what a model of one's own is derived from |
| `catalogue` | models by name, by entry point, or from a person's own file |
| `guarded`, `declared` | checks of a model of one's own, told in one sentence |
"""
