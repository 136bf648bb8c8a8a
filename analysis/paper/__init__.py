"""The paper checked against its own model: what it prints, what that implies, and where the two disagree.

| module | content |
|---|---|
| `published` | the numbers that the paper prints, and the form of a finding |
| `wall_findings` | findings on the wall's parameters and on the contact |
| `friction_findings` | findings on friction, the Coulomb test and R² |
| `reproduction` | all findings in the order of the paper; Table 1 beside what was identified |

Everything is computed from the model's equations on demand; no result is typed in.
"""
