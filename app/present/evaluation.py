"""What fresh runs say of an amended model, for a reader: KEPT, NOT KEPT or NO POWER, and the numbers behind it."""

from collections.abc import Mapping

from dragrig import present
from dragrig.analysis import as_sentence, capitalise, count_text, percent_text
from dragrig.analysis.gap import ModelEvaluation, PromiseVerdict, RelativeEffectSize, display_name
from dragrig.present import Document, Field, Figure, Section, Table, attributes_json, decimals, force_text, significant
from dragrig.present.diagnosis import FORMAT, r2_table, shrink_json

VERSION = 2
VERDICT_WORDS = {
    PromiseVerdict.KEPT: "The promise is KEPT",
    PromiseVerdict.NOT_KEPT: "The promise is NOT KEPT",
    PromiseVerdict.NO_POWER: "NO POWER: these runs cannot tell whether the promise is kept",
}
ABSENT_SIZE = 0.3
"""An effect of which no more than this is there counts as absent in a sentence."""


def evaluation_document(evaluation: ModelEvaluation) -> Document:
    """Lay out what fresh runs say of an amended model."""
    shrink, known = evaluation.reduction, evaluation.diagnosed_runs
    left_out = f"{count_text(known, 'run')} that took part in the diagnosis {'is' if known == 1 else 'are'} left out"
    return Document(
        title="The amended model on fresh runs",
        badges=evaluation.backends,
        answer=f"{VERDICT_WORDS[evaluation.verdict]}: {_reason(evaluation)}.",
        lead=tuple(
            as_sentence(text)
            for text in (_closed_text(evaluation), _residual_text(evaluation), left_out if known else "")
            if text
        ),
        sections=(
            Section("runs", "The fresh runs", _runs_figure(evaluation)),
            Section("sizes", "Effects in these runs", (_size_table(evaluation),)),
            Section("r2", "", (r2_table(shrink, named=True),)),
        ),
        data=evaluation_json(evaluation),
    )


def evaluation_json(evaluation: ModelEvaluation) -> Mapping[str, object]:
    """Return what fresh runs say of an amended model as a JSON document."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "verdict": evaluation.verdict.value,
        "diagnosed_runs_left_out": evaluation.diagnosed_runs,
        "promise": {"closed": evaluation.promised, "closed_95ci": evaluation.promised_95ci},
        "achieved": {
            "closed": evaluation.achieved,
            "closed_95ci": evaluation.achieved_95ci,
            "explained": evaluation.explained,
        },
        "sizes": [
            {**attributes_json(size, "effect", "size", "d_prime", "verdict"), "size_95ci": (size.low, size.high)}
            for size in evaluation.sizes
        ],
        "shrink": shrink_json(evaluation.reduction),
    }


def _reason(evaluation: ModelEvaluation) -> str:
    deciding = [size for size in evaluation.sizes if size.verdict is evaluation.verdict] or list(evaluation.sizes)
    sizes = "; ".join(f"{display_name(size.effect)} {_size_text(size)}" for size in deciding)
    if evaluation.verdict in {size.verdict for size in evaluation.sizes}:
        return sizes
    if evaluation.verdict is PromiseVerdict.NO_POWER:
        return f"{sizes}, but closed nothing of the gap in runs of the diagnosis that were held out: no promise to keep"
    return f"{sizes}, but most of what is wrong in these runs remains"


def _size_text(size: RelativeEffectSize) -> str:
    value, low, high = map(decimals(2), (size.size, size.low, size.high))
    interval = f"{value} of the promised size, 95 % interval {low} to {high}"
    if size.verdict is PromiseVerdict.NO_POWER:
        return f"could be of this size or of another ({interval})"
    if size.verdict is PromiseVerdict.KEPT:
        return f"is there ({interval})"
    if size.size < -ABSENT_SIZE:
        return f"acts the other way ({interval})"
    if size.size <= ABSENT_SIZE:
        return f"is absent ({interval})"
    return f"is of another size ({interval})"


def _closed_text(evaluation: ModelEvaluation) -> str:
    if evaluation.achieved is None:
        return ""
    promised = "" if evaluation.promised is None else f"; {percent_text(evaluation.promised)} was promised"
    if evaluation.achieved < 0:
        return f"with the effects the model predicts these runs worse than without{promised}"
    interval = ""
    if evaluation.achieved_95ci is not None:
        low, high = evaluation.achieved_95ci
        interval = f" (95 % interval: {percent_text(max(low, -1.0))} to {percent_text(high)})"
    return f"{percent_text(evaluation.achieved)} of the gap closes{interval}{promised}"


def _residual_text(evaluation: ModelEvaluation) -> str:
    shrink = evaluation.reduction
    return (
        f"residual (rms), the specimen's parameters fitted to these runs both times: "
        f"{force_text(shrink.gap_before_mN)} without the effects, {force_text(shrink.gap_after_mN)} with them; "
        f"noise alone: {force_text(shrink.noise_floor_mN)}"
    )


def _runs_figure(evaluation: ModelEvaluation) -> tuple[Figure, ...]:
    if not evaluation.traces:
        return ()
    floor_mN = evaluation.reduction.noise_floor_mN
    figure = Figure(
        "before-after",
        "A row for each run: left, the measurement and what the model says without and with the effects; right, the "
        "residual.",
        "Fresh drags at the lowest, a middle and the highest speed, and of each other kind the run that the model "
        "without the effects explains worst. The grey band is noise.",
        lambda: present.before_after_figure(present.representative_runs(evaluation.traces), floor_mN),
    )
    return (figure,)


def _size_table(evaluation: ModelEvaluation) -> Table:
    return Table.of(
        "sizes",
        "1 is the promised size, 0 an absent effect",
        evaluation.sizes,
        Field("effect", "effect", lambda size: capitalise(display_name(size.effect))),
        Field("size", "size", lambda size: size.size, decimals(2)),
        Field("low", "from", lambda size: size.low, decimals(2)),
        Field("high", "to", lambda size: size.high, decimals(2)),
        Field("d_prime", "d′ of the promise", lambda size: size.d_prime, significant(3)),
        Field("verdict", "verdict", lambda size: size.verdict.value.replace("_", " ")),
    )
