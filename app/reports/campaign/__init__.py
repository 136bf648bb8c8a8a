"""The report on a campaign.

| module | what |
|---|---|
| `results` | what it is made of |
| `tables` | its tables |
| `pictures` | its figures |
| `page` | the page |
"""
