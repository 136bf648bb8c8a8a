"""Names of the files that the report consists of."""

REPORT = "report.html"
TABLES = (
    "elements",
    "skew-maximum",
    "skew-resistance",
    "coulomb",
    "forces",
    "drag",
    "determination",
    "eq15-examples",
    "findings",
)
"""Stems of the CSV files, in the order of the report."""
