"""The report on an exam of the gap diagnosis.

| module | what |
|---|---|
| `tables` | its tables |
| `pictures` | its figures |
| `page` | the page |
"""
