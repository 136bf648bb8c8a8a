"""Two campaigns, two runs, or a campaign and the friction model, side by side.

| module | content |
|---|---|
| `comparison` | two runs aligned on one clock; everything that a comparison says, as values and as a data frame |
| `compare` | the runs of either side, recorded or computed by the friction model; measured, paired and compared |
"""
