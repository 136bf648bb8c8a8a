"""The report on the paper's programme, simulated and identified.

| module | what |
|---|---|
| `results` | what the report is about |
| `tables` | its tables, for the page and as CSV |
| `joint_tables` | those of the joint fit |
| `pictures` | its figures |
| `page` | the page |
"""
