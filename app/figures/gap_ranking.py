"""The ranking of a diagnosis: how probable each hypothesis is."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from dragrig.analysis.gap.results import Diagnosis, Ranked
from dragrig.analysis.gap.sentences import capital, chance_in_words, is_verdict, name_of, verdict_sentences
from dragrig.figures.header import fitting, headline
from dragrig.figures.panels import Place, add_panel
from dragrig.figures.style import BLACK, BLUE, GREY, PALE, SKY, SMALL_PT, TEXT_PT, drawing, new_figure, text_width_in

WIDTH_IN, ROW_IN, HEAD_IN, FOOT_IN, LEFT_IN, RIGHT_IN = 13.0, 0.42, 1.75, 0.85, 0.4, 1.1
MOST_ROWS, LEAST_SHOWN = 10, 0.002


def gap_ranking_figure(diagnosis: Diagnosis) -> Figure:
    """Draw the hypotheses of a diagnosis that are not next to impossible, the most probable first.

    Dark: what the verdict names; light blue: what these runs cannot tell from it; grey: the others.
    """
    rows = _shown(diagnosis.ranking)
    with drawing():
        names = [capital(name_of(one.hypothesis)) for one in rows]
        left = LEFT_IN + max((text_width_in(name, TEXT_PT) for name in names), default=1.0) + 0.2
        tall = HEAD_IN + ROW_IN * len(rows) + FOOT_IN
        figure = new_figure(WIDTH_IN, tall)
        said = fitting(verdict_sentences(diagnosis)[0], SMALL_PT, WIDTH_IN - 2 * LEFT_IN)
        headline(figure, LEFT_IN, "How probable each hypothesis is", said)
        axes = add_panel(figure, Place(left, FOOT_IN, WIDTH_IN - left - RIGHT_IN, ROW_IN * len(rows)))
        for row, one in enumerate(rows):
            axes.barh(row, one.probability, height=0.62, color=_colour(one, diagnosis), linewidth=0)
            text = chance_in_words(one.probability)
            axes.annotate(
                text, (one.probability, row), (6, 0), textcoords="offset points", va="center", fontsize=TEXT_PT
            )
        axes.set_yticks(range(len(rows)), names, fontsize=TEXT_PT)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0.0, 1.0)
        axes.set_xlabel("Probability")
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        _legend(figure, diagnosis)
        return figure


def _shown(ranking: Sequence[Ranked]) -> list[Ranked]:
    ordered = sorted(ranking, key=lambda one: -one.probability)
    return [one for at, one in enumerate(ordered) if at < 3 or one.probability >= LEAST_SHOWN][:MOST_ROWS]


def _colour(one: Ranked, diagnosis: Diagnosis) -> str:
    if is_verdict(one, diagnosis):
        return BLUE
    return SKY if set(one.hypothesis.split("+")) & set(diagnosis.confusable_with) else PALE


def _legend(figure: Figure, diagnosis: Diagnosis) -> None:
    width, height = figure.get_size_inches()
    words = [(BLUE, "the verdict")]
    if diagnosis.confusable_with:
        words.append((SKY, "cannot be told from it with these runs"))
    words.append((PALE, "others"))
    x, y = LEFT_IN, height - 1.3
    for colour, word in words:
        figure.text(x / width, y / height, "■", color=colour, fontsize=TEXT_PT, va="center")
        ink = GREY if colour == PALE else BLACK
        figure.text((x + 0.22) / width, y / height, word, color=ink, fontsize=SMALL_PT, va="center")
        x += 0.22 + text_width_in(word, SMALL_PT) + 0.35
