"""The paper checked against its own model: what it prints, what that implies, and where the two disagree.

| module | content |
|---|---|
| `published` | the numbers that the paper prints, and the form of a finding |
| `wall_findings` | findings on the wall's parameters, on the contact and its pressure |
| `findings` | all findings, those on friction and R² among them; Table 1 beside identified elements |

Everything is computed from the model's equations on demand; no result is typed in.
"""
