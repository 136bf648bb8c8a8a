"""Five elements from one relaxation: Maxwell branches driven by the measured ramp, fitted to its force.

| module | what |
|---|---|
| `record` | one run made ready: motion, block means, response of any branch |
| `fit` | moduli and time constants by least squares on whitened block means |
| `residuals` | a fit beside its run |
| `third` | whether a third branch is needed |
"""
