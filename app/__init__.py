"""dragrig: runs a linear-motor drag tester, real or simulated, and evaluates what it records.

`__init__.pyi` lists the public names and their modules, which are loaded on first use: the command line must start
without any of them.

Examples
--------
>>> import dragrig
>>> dragrig.check("drag").findings
()
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, _dir, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_names]  # noqa: PLE0604  # the names of the stub


def __dir__() -> list[str]:
    return sorted(__all__)
