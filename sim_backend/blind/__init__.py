"""Campaigns with hidden effects: a separate plant that examines the diagnosis.

The nominal equations are written a second time here, and no formula of an effect is shared with the catalogue.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
