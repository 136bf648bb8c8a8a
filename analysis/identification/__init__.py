"""From runs to the parameters of a nominal model, with their uncertainty.

| module | content |
|---|---|
| `identify` | the identification of a specimen: one fit of a nominal model to all runs, and each kind on its own |
| `identification` | its result, as values |
| `population` | specimens of one rig together: means and spreads of their parameters |
| `relaxation_elements` | the five elements of each relaxation run, and how they depend on strain |
| `steady_sliding` | friction coefficient from the vacuum fixture, and steady drag against speed, beside the model |
| `speed_dependence` | law and regimes of the drag against speed |
"""
