"""From runs to the parameters of a nominal model, with their uncertainty.

| module | what |
|---|---|
| `selection` | which runs may be used, and why the others are left out |
| `results` | everything that an identification says, as values |
| `relaxation`, `strain_law` | the five elements of each relaxation run, and how they depend on strain |
| `coulomb` | the friction coefficient from the vacuum fixture |
| `drag`, `boundary`, `determination` | the steady drag against speed, beside the model |
| `joint` | one fit of everything |
"""
