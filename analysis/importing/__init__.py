"""Foreign measurements in, run files out.

`import_file` reads a table (text in any dialect, MAT, Parquet, TDMS, NumPy), maps its columns, converts their
units, puts the rows onto an even time grid and writes a run file. `__init__.pyi` lists the
public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
