"""Colours of all figures and of the window (Okabe and Ito), distinguishable with any kind of colour vision."""

from typing import Final

BLACK: Final = "#1A1A1A"
BLUE: Final = "#0072B2"
SKY: Final = "#56B4E9"
GREEN: Final = "#009E73"
ORANGE: Final = "#E69F00"
VERMILLION: Final = "#D55E00"
PURPLE: Final = "#B0578D"
GREY: Final = "#5F6670"
PALE: Final = "#A9B4C0"
PAPER: Final = "#FFFFFF"
GRID: Final = "#D3D9DF"

CYCLE: Final = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Colours of curves that stand side by side, in order."""


def tint(colour: str, share: float = 0.35) -> str:
    """Return a colour on paper as pale as if it covered a share of it; opaque, which is drawn much faster."""
    parts = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
    return "#" + "".join(f"{round(255 + share * (part - 255)):02X}" for part in parts)
