"""The report on a gap diagnosis.

| module | what |
|---|---|
| `tables` | its tables |
| `pictures` | its figures |
| `page` | the page |
"""
