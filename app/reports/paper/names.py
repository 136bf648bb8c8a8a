"""Names of the files that the report consists of."""

REPORT = "report.html"
MODEL_FILE = "model.toml"
"""The identified friction model, as the simulator loads it."""
TABLES = (
    "elements",
    "skew-maximum",
    "skew-resistance",
    "coulomb",
    "forces",
    "parameters",
    "combinations",
    "joint-runs",
    "drag",
    "determination",
    "eq15-examples",
    "findings",
)
"""Stems of the CSV files, in the order of the report."""
