"""What a verdict is made of, in numbers alone: small enough to be kept beside every diagnosis and learnt from."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Nameless:
    """A law that bears no name: a force that is any function of one coordinate.

    Attributes
    ----------
    law
        What it is a function of.
    squares
        Whitened squares that remain, and what so many free values cost: twice the logarithm of the evidence.
    changed_mN
        By how much it changes what is predicted: root mean square where it does.
    """

    law: str
    squares: float
    changed_mN: float


@dataclass(frozen=True, slots=True)
class Tried:
    """Effects that were refitted together, and what they leave.

    Attributes
    ----------
    effects
        Their ids, in the order in which they were taken up.
    plain, flexible
        Whitened squares that remain as they are, and when each may have a foreign form.
    changed_mN
        By how much they change what is predicted, the nominal parameters refitted: root mean square where they act.
    periodic
        Whether one of them is periodic on the session's clock, whose phase may be lost from run to run.
    gain
        Half the squares that the last of them takes away; beside others, where these do little (`doubting`).
    left
        Squares that remain without the last one, the form of the others in the same doubt.
    rival_gain
        What the best other effect takes away in its place; 0 where there is no other.
    laws
        Beside the others: the laws without a name that leave least in the place of the last of them.
    elsewhere
        What is left in runs where they add nothing, in standard deviations of chance.
    at_limit
        Whether one of them is as large as it can be, and would be larger.
    untold
        How many effects, which the nominal model leaves no place for and which were therefore not tried, may look the
        same in these runs.
    """

    effects: tuple[str, ...]
    plain: float
    flexible: float
    changed_mN: float
    periodic: bool = False
    gain: float = 0.0
    left: float = 0.0
    rival_gain: float = 0.0
    laws: tuple[Nameless, ...] = ()
    elsewhere: float = 0.0
    at_limit: bool = False
    untold: int = 0


@dataclass(frozen=True, slots=True)
class Evidence:
    """All that a verdict is made of.

    Attributes
    ----------
    blocks, squares
        Of the force: number of blocks, and whitened squares that the nominal model leaves.
    tried
        Explanations of the force.
    mains_gain, line_gain
        Log likelihood ratios of lines at the mains' frequency and elsewhere.
    position
        Families of position errors with the share each explains, the best first.
    strays
        Whether there are such errors at all.
    without
        Effects that were not to be considered.
    nameless
        Laws of one coordinate that bear no name, the best first.
    """

    blocks: int
    squares: float
    tried: tuple[Tried, ...] = ()
    mains_gain: float = 0.0
    line_gain: float = 0.0
    position: tuple[tuple[str, float], ...] = ()
    strays: bool = False
    without: tuple[str, ...] = ()
    nameless: tuple[Nameless, ...] = ()

    @property
    def excess(self) -> float:
        """Squares above noise that the nominal model leaves."""
        return self.squares - self.blocks
