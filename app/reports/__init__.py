"""Reports as single HTML files, with their figures and styles inside: they need no network.

| module | what |
|---|---|
| `tabular` | a table once, for the page and as CSV |
| `svg` | a figure as an element of a page |
| `picture` | what a page knows of a figure |
| `embedding` | figures into a page |
| `rendering` | templates into a page |
| `files` | pages and tables into a folder |
| `run`, `campaign` | the reports on a run, on a campaign |
| `gap` | the report on a diagnosis |
| `paper` | the report on the paper's programme |
"""
