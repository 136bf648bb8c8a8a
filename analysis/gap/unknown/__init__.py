"""What is known of a gap that no effect of the catalogue explains: where it is, what it depends on, and a law of it.

| module | what |
|---|---|
| `part` | which blocks the gap is in |
| `place` | where it is, as a sentence |
| `trend`, `shape` | what it is a function of and how, as a sentence |
| `any_law` | which coordinate alone it may depend on, beside the effect most like it, as a sentence |
| `swing` | the same of a swing that is there also while the stage stands still |
| `terms` | the library that a law is put together from |
| `selecting` | few terms by what they predict of runs that took no part |
| `law` | the law with its coefficients, if one holds up |
| `telling` | all of it |
"""

from dragrig.analysis.gap.unknown.law import Law, find_law
from dragrig.analysis.gap.unknown.part import Part, part_of
from dragrig.analysis.gap.unknown.place import place
from dragrig.analysis.gap.unknown.shape import shape
from dragrig.analysis.gap.unknown.telling import unknown_gap

__all__ = ["Law", "Part", "find_law", "part_of", "place", "shape", "unknown_gap"]
