"""How often a gap diagnosis is right, from campaigns whose hidden effects are known.

| module | what |
|---|---|
| `records` | answers and diagnoses as far as they are scored |
| `rates` | rates with Wilson intervals, kind of campaign by kind |
| `withheld` | what is said when the true effect is not in the catalogue |
| `confusion` | what was said against what was hidden |
| `detection` | how often an effect of some size is seen, and named |
| `calibration` | whether probabilities mean what they say |
| `promises` | the promised shrink against fresh runs |
| `scoring` | all of it |
| `document` | as JSON |
"""

from dragrig.gap_scoring.records import Answer
from dragrig.gap_scoring.scoring import Score, score

__all__ = ["Answer", "Score", "score"]
