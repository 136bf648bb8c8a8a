"""The run file: one run, one HDF5 file.

`__init__.pyi` lists the public names and their modules, which are loaded on first use: h5py takes a tenth of a second.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
