"""Between simulation and rig: where a gap is, which effect causes it, and how far an amended simulator closes it.

One way, from runs to the next run:

`run_data` → `design` (linearised campaign, candidates, and fits in it) → `studies` → `hypothesis_fit` →
`forward_selection` → `features` → `classifier` → `presence` and `budget` (which causes, and how much of the gap each
has) → `excess` and `localise` (where) → `gap_reduction` (how far it closes) → `weighing` (all that a verdict stands
on) → `unknown_gap` → `isolability`, `information` and `next_run` (what next) → `diagnose` → `settling` (whether
anything is left to run).
Campaigns of one rig: `pooled_evidence` → `pooled_force` → `together`.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
