"""The uses of run files: filters, measures, tables, exports, and foreign measurements made run files.

| module | content |
|---|---|
| `savgol` | Savitzky–Golay filter: of a trace, of samples as they arrive, of run files |
| `measures` | steady, rest, peak and hold force and speed of a run, with errors; a campaign as a table |
| `comparison` | two campaigns, two runs, or a campaign and the friction model, side by side |
| `models` | nominal models: the capsule's friction model, the stage, models of a user's own |
| `noise`, `linear_gaussian`, `identification` | parameters of a nominal model from the runs of a specimen |
| `gap` | the difference between runs and nominal model, and its causes |
| `paper` | the paper checked against its own model |
| `export`, `importing` | runs to CSV, Parquet, MATLAB and NumPy files, and measurements from elsewhere to run files |

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
