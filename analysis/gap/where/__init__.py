"""Where a gap is: shares of the excess over noise and repeatability, in bins fixed beforehand.

| module | what |
|---|---|
| `blocks` | what is looked at: residuals of each run and channel after the nominal refit |
| `bands` | mean squares of a steady phase by frequency |
| `axes` | the bins, and how much of the excess of each run lies in each |
| `permutation` | whether it lies there by chance: whole runs permuted |
| `predicting`, `periodic`, `domain` | what the residual is above all a function of |
| `results` | the answer as values and as JSON |
| `locate` | puts it together |
| `attributed` | what a named effect adds, where the excess is too small to share out |
"""

from dragrig.analysis.gap.where.attributed import attributed
from dragrig.analysis.gap.where.bands import BANDS_HZ, band_powers
from dragrig.analysis.gap.where.blocks import BandPower, ResidualBlocks
from dragrig.analysis.gap.where.locate import locate
from dragrig.analysis.gap.where.results import Bin, Cell, Location, Where

__all__ = [
    "BANDS_HZ",
    "BandPower",
    "Bin",
    "Cell",
    "Location",
    "ResidualBlocks",
    "Where",
    "attributed",
    "band_powers",
    "locate",
]
