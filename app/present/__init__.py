"""Results laid out for a reader: one `Document` per result, and a renderer each for terminal, HTML page and JSON.

Heavy libraries (matplotlib, rich, jinja2) are loaded by the modules that draw or print, never by this package itself.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
