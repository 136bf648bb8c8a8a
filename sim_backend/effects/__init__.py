"""The catalogue of candidate effects, which the nominal model leaves out: one file each.

Each is a parameterised change to the simulator at one named place. `base` has the declarations of an effect, finds them
and combines several, `run_state` holds the facts of a run that they may depend on.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
