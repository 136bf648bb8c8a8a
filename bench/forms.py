"""How far the plant's hidden effects lie from the catalogue's forms of the same name.

`python bench/forms.py` fits the catalogue's effect to the noise-free signature of every form, size and shapes by
nonlinear least squares from several starts within their prior ranges, and prints the share of the signature's norm that
is left. Every run counts alike; repeats are left out. Beside it stands d′ of the signature, and the share of that
which is left when nominal directions are projected out and the fit has moved on to where that is least.
`python bench/forms.py stribeck folds --draws 3` looks at some effects alone.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
from dataclasses import dataclass, replace
from itertools import product
from zlib import crc32

import numpy as np
from form_fits import Floats, Seen, bounds, changed, hidden_change, left, left_run_by_run, nominal, seen_of

from dragrig.sim_backend.blind import CATALOGUE, BlindCampaign
from dragrig.sim_backend.blind.effect_sizes import NuisanceDirections, nuisance_directions, residual_chi2, whiten
from dragrig.sim_backend.blind.effects.hidden_effect import HiddenEffect as Hidden
from dragrig.sim_backend.effects.base import Coordinate, Effect, find_effect

NEAR, FAR = 0.10, 0.40
"""Share of the signature that the best fit should leave at least and at most."""
MAX_STEPS = 6


@dataclass(frozen=True, slots=True)
class Bench:
    """A campaign without noise, its runs at samples for slow and for ringing effects, and for hum."""

    secret: BlindCampaign
    usual: list[Seen]
    ringing: list[Seen]
    fast: list[Seen]
    nominal: NuisanceDirections

    @classmethod
    def of(cls, seed: int) -> "Bench":
        """Lay it out."""
        secret = nominal(seed)
        usual = seen_of(secret, fine_s=0.15)
        remaining = replace(
            secret, runs=tuple(entry.plan for entry in usual), variations=secret.variations[: len(usual)]
        )
        ringing, fast = seen_of(secret, fine_s=1.0), seen_of(secret, fine_s=0.15, shortest=5)
        return cls(secret, usual, ringing, fast, nuisance_directions(remaining))

    def seen(self, residuals: dict[int, Floats]) -> float:
        """Return d′ of force residuals of some runs."""
        filled = [residuals.get(entry.index, np.zeros_like(entry.bare.time)) for entry in self.usual]
        return float(np.sqrt(max(residual_chi2(self.nominal, filled), 0.0)))

    def smallest_detected(
        self, effect: Effect, acting: list[Seen], marks: list[Floats], values: dict[str, float]
    ) -> float:
        """Return d′ of what the effect leaves, moved on from a fit by steps that count nominal directions as free."""
        names = list(values)
        low, high = bounds(effect)
        unit = np.array([abs(parameter.default) or 1.0 for parameter in effect.parameters])

        def rest(at: Floats) -> dict[int, Floats]:
            now = dict(zip(names, at.tolist(), strict=True))
            shown = [entry.everywhere(changed(effect, entry, now)) for entry in acting]
            return {entry.index: mark - now_shown for entry, mark, now_shown in zip(acting, marks, shown, strict=True)}

        at = np.array(list(values.values()))
        left, minimum = rest(at), np.inf
        step = np.ones(0)
        for _ in range(MAX_STEPS):
            now = self.seen(left)
            if now < minimum:
                minimum, best = now, at
                ends = [np.where(at + 1e-3 * unit > high, -1e-3, 1e-3) * unit * entry for entry in np.eye(at.size)]
                moved = [rest(at + end) for end in ends]
                step = self._step(left, [{key: left[key] - entry[key] for key in left} for entry in moved])
                step *= np.array([end.sum() for end in ends])
            else:
                step = step / 3
            at = np.clip(best + step, low, high)
            left = rest(at)
        return min(minimum, self.seen(left))

    def _step(self, left: dict[int, Floats], slopes: list[dict[int, Floats]]) -> Floats:
        """Return how many slopes to take, by least squares through the noise beside the nominal directions."""
        size = self.nominal.shared[0].shape[1] + len(slopes)
        gram, right = np.zeros((size, size)), np.zeros(size)
        for entry, shared, own in zip(self.usual, self.nominal.shared, self.nominal.own, strict=True):
            if entry.index not in left:
                gram += np.pad(_beside(shared, own), (0, len(slopes)))
                continue
            columns = np.column_stack([*(slope[entry.index] for slope in slopes), left[entry.index]])
            both = _beside(np.column_stack([shared, whiten(columns, self.nominal.noise)]), own)
            gram += both[:-1, :-1]
            right += both[:-1, -1]
        priors = np.append(np.ones(size - len(slopes)), np.full(len(slopes), 1e-9))
        return np.asarray(np.linalg.solve(gram + np.diag(priors), right)[-len(slopes) :])

    def row(self, hidden: Hidden) -> tuple[float, str]:
        """Fit one form; return the share that is left, and the rest of its line."""
        effect = find_effect(hidden.name)
        by_run = effect.coordinate is Coordinate.FREQUENCY
        runs = self.fast if by_run else self.ringing if effect.coordinate is Coordinate.TRANSIENT else self.usual
        acting = [run for run in runs if run.plan.kind in hidden.kinds]
        marks = [hidden_change(self.secret, hidden, entry) for entry in acting]
        targets = [mark[entry.chosen] for entry, mark in zip(acting, marks, strict=True)]
        share, values = (left_run_by_run if by_run else left)(effect, acting, targets)
        seen = f"{'':9s}"
        if effect.channel == "force" and not by_run:
            whole = self.seen({entry.index: mark for entry, mark in zip(acting, marks, strict=True)})
            seen = f"{whole:4.0f} {self.smallest_detected(effect, acting, marks, values) / whole:4.0%}"
        return share, f"{seen}  " + " ".join(f"{key}={value:.3g}" for key, value in values.items())


def _beside(columns: Floats, own: Floats) -> Floats:
    """Return the products of columns once a run's own directions are taken out within their priors."""
    inner = np.linalg.inv(np.eye(own.shape[1]) + own.T @ own)
    return np.asarray(columns.T @ columns - (columns.T @ own) @ inner @ (own.T @ columns))


def verdict(share: float) -> str:
    """Return whether a form lies nearer or further than it should."""
    return "NEAR" if share < NEAR else "FAR" if share > FAR else ""


def summary(shares: dict[str, list[float]]) -> None:
    """Print the range, and the effects that lie outside of what it should be."""
    everything = np.array([share for result in shares.values() for share in result])
    low, middle, high = np.quantile(everything, (0.0, 0.5, 1.0))
    near, far = np.count_nonzero(everything < NEAR), np.count_nonzero(everything > FAR)
    print(f"{everything.size} forms leave {low:.0%} to {high:.0%}, median {middle:.0%}")
    print(f"{near} lie nearer than {NEAR:.0%}, {far} further than {FAR:.0%}:")
    for name, result in shares.items():
        if any(verdict(share) for share in result):
            print(f"  {name}: {', '.join(f'{share:.0%}' for share in result)}")


def main() -> None:
    """Fit every form and print what is left."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("effects", nargs="*", help="ids; all of the catalogue unless given")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=1, help="of each form's shape")
    options = parser.parse_args()
    bench = Bench.of(options.seed)
    shares: dict[str, list[float]] = {}
    print(f"{'effect':20s} {'form':28s} {'left':>6s}        d′ left  best fit")
    for name, forms in CATALOGUE.items():
        if options.effects and name not in options.effects:
            continue
        for form, number in product(forms, range(options.draws)):
            random = np.random.default_rng((options.seed, number, crc32(form.form.encode())))
            share, rest = bench.row(form.drawn(random, 1.0))
            shares.setdefault(name, []).append(share)
            print(f"{name:20s} {form.form:28s} {share:6.1%} {verdict(share):4s} {rest}", flush=True)
    summary(shares)


if __name__ == "__main__":
    main()
