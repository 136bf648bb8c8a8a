"""Foreign measurements in, run files out.

`import_file` reads a table (text in any dialect, MAT, Parquet, TDMS, NumPy), maps its columns, converts their
units, puts the rows onto an even time grid and writes a run file. Each name loads its module at first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.analysis.importing.importer import ImportedRun, import_file
    from dragrig.analysis.importing.mapping import ColumnMap, ColumnSource, ImportSettings, parse_map
    from dragrig.analysis.importing.readers import read_foreign

__all__ = ["ColumnMap", "ColumnSource", "ImportSettings", "ImportedRun", "import_file", "parse_map", "read_foreign"]

_HOME = {
    "ColumnMap": "mapping",
    "ColumnSource": "mapping",
    "ImportSettings": "mapping",
    "ImportedRun": "importer",
    "import_file": "importer",
    "parse_map": "mapping",
    "read_foreign": "readers",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
