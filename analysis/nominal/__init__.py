"""Nominal models: what identifies, compares and diagnoses sees of a model.

| module | what |
|---|---|
| `protocol` | the protocol that a model fulfils: parameters with priors, predicted channels of a run |
| `experiment` | one run as a model sees it: what was done, and the measured motion |
| `capsule` | the paper's friction model |
| `drive` | the stage alone, from its recorded motor force |
| `catalogue` | models by name, by entry point, or from a person's own file |
"""
