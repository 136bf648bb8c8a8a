"""The paper beside its own model: what it prints, what that implies, and where the two do not fit together.

| module | what |
|---|---|
| `printed` | the numbers that the paper prints |
| `finding` | a finding, with its numbers |
| `wall`, `relaxation_test`, `contact`, `pressure`, `friction`, `coulomb_test`, `statistics` | findings by subject |
| `findings` | all of them, in the order of the paper |
| `elements` | Table 1 and Eq. 14 side by side, beside what was identified |
| `curves` | skew resistance, forces and Eq. 14 as tables |

Everything is computed from the model's equations when it is asked for; no result is typed in.
"""
