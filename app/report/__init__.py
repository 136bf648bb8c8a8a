"""Reports as single HTML files, with their figures and styles inside: they need no network and no script.

| module | what |
|---|---|
| `tabular` | a table once, for the page and as CSV |
| `embedding` | figures as data of the page |
| `rendering` | templates into a page |
| `files` | pages and tables into a folder |
| `paper` | the report on the paper's programme |
"""
