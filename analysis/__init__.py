"""What is made of run files: filters, measures, tables, exports, and foreign measurements made run files.

| module | content |
|---|---|
| `savgol` | Savitzky–Golay filter: of a trace, of samples as they arrive, of run files |
| `measures` | steady, rest, peak and hold force and speed of a run, with errors |
| `campaign_table` | a campaign as rows and as a data frame; means of repeated runs |
| `comparison` | two campaigns, two runs, or a campaign and the friction model, side by side |
| `models` | nominal models: the capsule's friction model, the stage, models of a user's own |
| `inference`, `identification` | parameters of a nominal model from the runs of a specimen |
| `gap` | the difference between runs and nominal model, and its causes |
| `paper` | the paper checked against its own model |
| `export`, `importing` | runs to CSV, Parquet, MATLAB and NumPy files, and measurements from elsewhere to run files |

Names in `__all__` can be imported from here; each loads its module at first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.analysis.campaign_table import SpeedMean, TableRow, as_frame, mean_per_speed
    from dragrig.analysis.export import CsvStyle, ExportFormat, export_campaign, export_run
    from dragrig.analysis.importing.importer import import_file
    from dragrig.analysis.importing.mapping import ImportSettings, parse_map
    from dragrig.analysis.measures import RunMeasures, measure
    from dragrig.analysis.savgol import (
        FilteredRun,
        SavgolSettings,
        SavgolStream,
        default_filter_settings,
        filter_file,
        filter_run,
        smooth,
    )

__all__ = [
    "CsvStyle",
    "ExportFormat",
    "FilteredRun",
    "ImportSettings",
    "RunMeasures",
    "SavgolSettings",
    "SavgolStream",
    "SpeedMean",
    "TableRow",
    "as_frame",
    "default_filter_settings",
    "export_campaign",
    "export_run",
    "filter_file",
    "filter_run",
    "import_file",
    "mean_per_speed",
    "measure",
    "parse_map",
    "smooth",
]

_HOME = {
    "CsvStyle": "export",
    "ExportFormat": "export",
    "FilteredRun": "savgol",
    "ImportSettings": "importing.mapping",
    "RunMeasures": "measures",
    "SavgolSettings": "savgol",
    "SavgolStream": "savgol",
    "SpeedMean": "campaign_table",
    "TableRow": "campaign_table",
    "as_frame": "campaign_table",
    "export_campaign": "export",
    "export_run": "export",
    "filter_file": "savgol",
    "filter_run": "savgol",
    "import_file": "importing.importer",
    "mean_per_speed": "campaign_table",
    "measure": "measures",
    "parse_map": "importing.mapping",
    "smooth": "savgol",
    "default_filter_settings": "savgol",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
