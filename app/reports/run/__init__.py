"""The report on one run.

| module | what |
|---|---|
| `values` | settings and checks in words |
| `tables` | its tables |
| `page` | the page |
"""
