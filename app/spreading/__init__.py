"""Independent pieces of work, done side by side: in this process, in several of this machine, or on a Dask cluster.

| module | what |
|---|---|
| `choosing` | from what was asked for to an executor |
| `serial` | one piece after another, here |
| `processes` | processes of this machine, of which any may be killed |
| `cluster` | a Dask cluster |
| `pieces` | pieces through an executor, results in the order of the pieces |
"""

from dragrig.spreading.choosing import cores, executor, require_workers
from dragrig.spreading.pieces import spread, spread_counted

__all__ = ["cores", "executor", "require_workers", "spread", "spread_counted"]
