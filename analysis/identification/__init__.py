"""From runs to the parameters of a nominal model, with their uncertainty.

| module | content |
|---|---|
| `identify` | the identification of a specimen: one fit of a nominal model to all runs, and each kind on its own |
| `identification` | its result, as values |
| `relaxation_elements`, `maxwell_fit` | the five elements of each relaxation run, and how they depend on strain |
| `coulomb_friction` | the friction coefficient from the vacuum fixture |
| `steady_drag`, `speed_dependence` | the steady drag against speed, beside the model |
| `steady_sliding` | the steady force of one sliding run |
"""
