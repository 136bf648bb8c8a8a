"""Nominal models: the readings of a rig without a fault.

| module | content |
|---|---|
| `experiment` | one run as a model sees it: protocol, specimen, and the measured motion; velocity from encoder counts |
| `nominal_model` | the interface of a model, and the base class of a user's own |
| `capsule_model` | the paper's friction model |
| `drive_model` | the stage alone, from its recorded motor force |
| `catalogue` | models by name, by entry point, or from a user's file, checked before use |

A user's own model takes `ChannelModel`, `MotionState` and `Parameter` from here. `__init__.pyi` lists the public names
and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
