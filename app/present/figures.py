"""The figures of all results, loaded on first use: matplotlib takes a second to load.

`figures.pyi` lists them with their modules.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("dragrig.present", __file__)
