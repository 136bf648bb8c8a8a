"""Two campaigns, two runs, or a campaign and the friction model, side by side: the plain look before a diagnosis.

| module | what |
|---|---|
| `measured` | one measure of two runs, and the judgement of its difference |
| `results` | everything that a comparison says, as values |
| `sources` | the runs of either side, and which are left out and why |
| `resimulated` | a run as the friction model has it, on the motion that was recorded |
| `conditions`, `pairing` | what was done in a run, and which runs belong together by it |
| `clock`, `overlay` | two traces on one clock, and their difference |
| `spread` | by how much repeats differ anyway |
| `differences` | the measures of two runs side by side |
| `motions` | position against command |
| `groups` | what the pairs of one kind and speed say together |
| `sentences` | the same in words |
| `compare` | puts it together |
"""
