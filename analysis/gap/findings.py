"""Everything that was tried on the force of a campaign."""

from dataclasses import dataclass
from functools import cached_property

from dragrig.analysis.gap.design import Design
from dragrig.analysis.gap.evidence import Nameless
from dragrig.analysis.gap.explanation import Explanation, in_time
from dragrig.analysis.gap.ranking import Ranked
from dragrig.analysis.gap.study import Study


@dataclass(frozen=True, eq=False)
class Findings:
    """Everything that was tried on the force of a campaign.

    Attributes
    ----------
    nominal
        The nominal model refitted, with the dictionary.
    squares
        Whitened squares that it leaves.
    ranked
        The best shape of each effect against it.
    singles
        Those that were refitted, the best first; then further effects that were refitted on their own.
    steps
        Each further effect beside those before that was tried, with what it took away beforehand.
    """

    study: Study
    nominal: Design
    squares: float
    ranked: tuple[Ranked, ...]
    singles: tuple[Explanation, ...]
    steps: tuple["Step", ...]

    @property
    def blocks(self) -> int:
        """Number of blocks: what the squares of noise come to."""
        return sum(self.nominal.blocks)

    @cached_property
    def excess(self) -> float:
        """Squares above noise that the nominal model leaves."""
        return self.squares - self.blocks

    def share(self, squares: float) -> float:
        """Return the share of the excess that is explained when so many squares remain."""
        return 1.0 - (squares - self.blocks) / max(self.excess, 1.0)

    def merit(self, one: Explanation) -> float:
        """Return how well an explanation does: its share as it is, and with a foreign form.

        What is periodic in time may have lost its phase from run to run, and counts as the latter alone.
        """
        plain, flexible = self.share(one.plain), self.share(one.flexible)
        return flexible if any(in_time(each.effect) for each in one.point.candidates) else 0.5 * (plain + flexible)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A further effect beside those before, whose form is in doubt in all of these numbers.

    Attributes
    ----------
    effect
        Which.
    gain
        Half the squares that it takes away beside the others, which may have foreign forms.
    rival_gain
        What the next best takes away in its place.
    left
        Squares that remain without it.
    laws
        What laws without a name leave in its place, the best first.
    together
        The refit; None where the gain was not worth one.
    """

    effect: str
    gain: float
    rival_gain: float
    left: float
    laws: tuple[Nameless, ...]
    together: Explanation | None
