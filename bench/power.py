"""Power cut while runs are recorded and finished: how many survive, and what is lost at most.

Run `python bench/power.py [CUTS] [MAX_LAG_S]`. Ten runs are recorded on an emulated disk whose syncs take up to
`MAX_LAG_S`; of each, cuts at random moments leave the pages, lengths and names that had not been synced in any state
that they had since. Every sample of every recovered run is compared with what was handed over. Loss is the time from
the handing over of the first lost sample to the cut.
"""

import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from power_cuts import lost_s, record_on_emulated_disk

RUNS = 10
BOUND_S = 0.25


def main() -> None:
    """Record, cut, recover, count."""
    cuts = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    max_lag_s = float(sys.argv[2]) if len(sys.argv) > 2 else 0.5
    losses: list[float] = []
    wrong = 0
    for seed in range(RUNS):
        draw = random.Random(seed)
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "recorded"
            folder.mkdir()
            recorded = record_on_emulated_disk(folder, seed, max_lag_s)
            for number in range(cuts // RUNS):
                copy = Path(place) / str(number)
                copy.mkdir()
                try:
                    losses.append(lost_s(recorded, draw.uniform(recorded.begun_s, recorded.ended_s), copy, draw))
                except AssertionError as error:
                    wrong += 1
                    print(f"run {seed}, cut {number}: {error}")
    print(f"{cuts} cuts, syncs of up to {max_lag_s:g} s: {wrong} runs destroyed or wrong, {max(losses):.2f} s lost at")
    print(f"most (bound {BOUND_S + max_lag_s:g} s), {sum(loss > BOUND_S + max_lag_s for loss in losses)} times more")


if __name__ == "__main__":
    main()
