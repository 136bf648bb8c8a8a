"""A gap that is a swing of the channel while the stage stands still, as sentences."""

from dragrig.analysis.gap.lines import Line


def swinging(line: Line, channel: str) -> tuple[str, str]:
    """Return where a line is that no effect of the catalogue explains, and how it goes."""
    there = f"It is in the {channel.replace('_', ' ')}, also while the stage stands still"
    how = (
        f"A swing at about {line.frequency_hz:.3g} Hz with an amplitude of some {line.amplitude:.2g} mN, "
        "looked for at rest and in holds. What else there may be cannot be told beside it"
    )
    return f"{there}.", f"{how}."
