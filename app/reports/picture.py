"""What a page knows of a figure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from markupsafe import Markup


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of a page.

    Attributes
    ----------
    svg
        The drawing, an element of the page; it says what it shows to those who cannot see it.
    caption
        What stands below.
    glyphs
        Letters that the drawing refers to, by id; a page has each of them once.
    """

    svg: Markup
    caption: str
    glyphs: Mapping[str, str]


def glyphs_of(pictures: Iterable[Picture]) -> Markup:
    """Return the letters of several drawings, each once."""
    together = {name: path for picture in pictures for name, path in picture.glyphs.items()}
    return Markup("".join(together.values()))  # noqa: S704  # serialised by ElementTree
