"""The velocity-dependent friction model as pure functions of motion and parameters.

`prepare` gives the force of an acquisition at any sample times, `steady_forces` and `skew_resistance` the paper's
curves, `wall_parameters` and `parameter_set_differences` the two published parameter sets, `model_wall` the wall of a
model. `__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
