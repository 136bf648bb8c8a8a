"""What is made of run files: filters, measures, tables, exports, and foreign measurements made run files.

| module | what |
|---|---|
| `savgol`, `savgol_stream` | Savitzky–Golay smoothing of a whole trace, and of samples as they arrive |
| `filtering` | the filter of whole runs: forces smoothed, speed from position, stored beside the raw trace |
| `measures` | steady, rest, peak and hold force and speed of a run, each with its error or why it is missing |
| `correlated_mean` | mean of correlated samples with an honest standard error |
| `table` | a campaign as rows and as a data frame; means of repeated runs |
| `comparison` | two campaigns, two runs, or a campaign and the friction model, side by side |
| `paper` | the paper beside its own model: its numbers, and where they do not fit together |
| `export` | runs to CSV, Parquet, MATLAB and NumPy files |
| `importing` | measurements from elsewhere to run files |

Names in `__all__` can be taken from here; libraries are loaded when one is first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.analysis.export import ExportFormat, export_campaign, export_run
    from dragrig.analysis.exporting.text import CsvStyle
    from dragrig.analysis.filtering import Filtered, filter_file, filter_run, usual_settings
    from dragrig.analysis.importing.importer import import_file
    from dragrig.analysis.importing.mapping import ImportSettings, parse_map
    from dragrig.analysis.measures import RunMeasures, measure
    from dragrig.analysis.savgol import SavgolSettings, smooth
    from dragrig.analysis.savgol_stream import SavgolStream
    from dragrig.analysis.table import SpeedMean, TableRow, as_frame, mean_per_speed

__all__ = [
    "CsvStyle",
    "ExportFormat",
    "Filtered",
    "ImportSettings",
    "RunMeasures",
    "SavgolSettings",
    "SavgolStream",
    "SpeedMean",
    "TableRow",
    "as_frame",
    "export_campaign",
    "export_run",
    "filter_file",
    "filter_run",
    "import_file",
    "mean_per_speed",
    "measure",
    "parse_map",
    "smooth",
    "usual_settings",
]

_HOME = {
    "CsvStyle": "exporting.text",
    "ExportFormat": "export",
    "Filtered": "filtering",
    "ImportSettings": "importing.mapping",
    "RunMeasures": "measures",
    "SavgolSettings": "savgol",
    "SavgolStream": "savgol_stream",
    "SpeedMean": "table",
    "TableRow": "table",
    "as_frame": "table",
    "export_campaign": "export",
    "export_run": "export",
    "filter_file": "filtering",
    "filter_run": "filtering",
    "import_file": "importing.importer",
    "mean_per_speed": "table",
    "measure": "measures",
    "parse_map": "importing.mapping",
    "smooth": "savgol",
    "usual_settings": "filtering",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
