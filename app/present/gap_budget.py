"""The budget of a gap for a reader: its parts by name and colour, its sentences, and its JSON."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from dragrig.analysis import as_sentence, capitalise, join_names
from dragrig.analysis.gap import (
    MODEL,
    SPECIMEN,
    UNEXPLAINED,
    BudgetEntry,
    Diagnosis,
    GapBudget,
    UnexplainedGap,
    display_name,
)
from dragrig.present import (
    CYCLE,
    GREY,
    Bar,
    BarPart,
    Field,
    FormattedNumber,
    Table,
    decimals,
    percent,
    probability_text,
    significant,
)
from dragrig.sim_backend.effects import catalogue

MIN_SHOWN_SHARE = 0.02
"""Smaller parts are summed up as others in sentences and bars; the table has them all."""
MIN_WHOLE_PERCENT = 0.005
"""Shares below are 0 % when rounded."""
MAX_SENTENCE_PARTS = 4
"""Parts that a sentence names; it sums up further ones, which bar and table have."""
SHARE_DECIMALS = 4
_NAMES = {MODEL: "the model itself", SPECIMEN: "the specimen itself", UNEXPLAINED: "no name"}
_MEANINGS = {
    MODEL: "The nominal model's own parameters or structure",
    SPECIMEN: "What specimens and repeats vary in, beyond what is usual",
}
_WHOLE_PERCENT = percent()
_ROUGH = significant(2)


@dataclass(frozen=True, slots=True)
class ChannelBudget:
    """The parts of the gap in one channel: named ones, the largest first, and the rest, if any."""

    channel: str
    named: tuple[BudgetEntry, ...]
    rest: BudgetEntry | None

    @property
    def large(self) -> tuple[BudgetEntry, ...]:
        """Named parts that are large enough to be shown on their own."""
        return tuple(entry for entry in self.named if entry.share >= MIN_SHOWN_SHARE)

    @property
    def small_share(self) -> float:
        """Share of the other named parts together, without those that run against the gap."""
        return sum(entry.share for entry in self.named if 0 <= entry.share < MIN_SHOWN_SHARE)

    @property
    def opposed(self) -> tuple[BudgetEntry, ...]:
        """Named parts that run against the gap."""
        return tuple(entry for entry in self.named if entry.share < 0)


def budgets_by_channel(budget: GapBudget | None) -> tuple[ChannelBudget, ...]:
    """Return the budget of each channel, the force's first; parts without a finite share are left out."""
    entries = () if budget is None else tuple(entry for entry in budget.entries if isfinite(entry.share))
    channels = sorted(dict.fromkeys(entry.channel for entry in entries), key=lambda channel: channel != "force")
    return tuple(_channel_budget(channel, entries) for channel in channels)


def _channel_budget(channel: str, entries: Sequence[BudgetEntry]) -> ChannelBudget:
    here = [entry for entry in entries if entry.channel == channel]
    named = sorted((entry for entry in here if entry.cause != UNEXPLAINED), key=lambda entry: -entry.share)
    return ChannelBudget(channel, tuple(named), next((entry for entry in here if entry.cause == UNEXPLAINED), None))


def part_name(entry: BudgetEntry) -> str:
    """Name a part, together with the effects that cannot be separated from it: `adhesion or Stribeck friction`."""
    if entry.cause in _NAMES:
        return _NAMES[entry.cause]
    return " or ".join(map(display_name, (entry.cause, *entry.not_separable_from)))


def _gap_text(budget: GapBudget, channel: str) -> str:
    """Name the gap of a channel, with its size where that is known: `a gap of 12 mN`."""
    if channel != "force":
        return f"the gap in the {channel.replace('_', ' ')}"
    several = any(entry.channel != "force" for entry in budget.entries)
    gap = f"a gap of {_ROUGH(budget.gap_mN)} mN" if isfinite(budget.gap_mN) else "the gap"
    return f"{gap} in the force" if several else gap


def budget_sentences(budget: GapBudget | None) -> tuple[str, ...]:
    """Say what a gap is made of: a sentence for each channel, then what runs against its gap; none without a gap."""
    if budget is None:
        return ()
    channels = budgets_by_channel(budget)
    whole = tuple(f"Of {_gap_text(budget, here.channel)}, {_parts_text(here)}." for here in channels)
    opposed = (
        f"None of it is {part_name(entry)}: that runs against the gap ({_WHOLE_PERCENT(entry.share)})."
        for here in channels
        for entry in here.opposed
    )
    return *whole, *opposed


def _parts_text(here: ChannelBudget) -> str:
    """Say what share each part has; `nothing has a name`, `all is velocity ripple`."""
    rest = 0.0 if here.rest is None else here.rest.share
    shares = [(entry.share, part_name(entry)) for entry in here.large[:MAX_SENTENCE_PARTS]]
    others = here.small_share + sum(entry.share for entry in here.large[MAX_SENTENCE_PARTS:])
    if others >= MIN_WHOLE_PERCENT and shares:
        shares.append((others, "others"))
    if not shares:
        return "nothing has a name" if rest >= 1 - MIN_WHOLE_PERCENT else f"{_WHOLE_PERCENT(rest)} has no name"
    if len(shares) == 1 and rest < MIN_WHOLE_PERCENT:
        return f"all is {shares[0][1]}"
    (share, name), *further = shares
    parts = [f"{_WHOLE_PERCENT(share)} is {name}", *(f"{_WHOLE_PERCENT(share)} {name}" for share, name in further)]
    left = f"{_WHOLE_PERCENT(rest)} has no name" if rest >= MIN_WHOLE_PERCENT else "nothing is left without a name"
    return f"{', '.join(parts)}; {left}"


def budget_bars(budget: GapBudget | None) -> tuple[Bar, ...]:
    """Return a bar for each channel, cut into the parts of its gap; a part that runs against the gap has no width."""
    if budget is None:
        return ()
    colours = cause_colours(budget)
    return tuple(
        Bar(capitalise(_gap_text(budget, here.channel)), tuple(_bar_parts(here, colours)))
        for here in budgets_by_channel(budget)
    )


def cause_colours(budget: GapBudget) -> Mapping[str, str]:
    """Return the colour of each named cause, the same in every channel."""
    causes = dict.fromkeys(entry.cause for here in budgets_by_channel(budget) for entry in here.large)
    return {cause: CYCLE[number % len(CYCLE)] for number, cause in enumerate(causes)}


def _bar_parts(here: ChannelBudget, colours: Mapping[str, str]) -> Iterator[BarPart]:
    for entry in here.large:
        yield BarPart(part_name(entry), entry.share, colours[entry.cause])
    if here.small_share > 0:
        yield BarPart("others", here.small_share, GREY)
    if here.rest is not None and here.rest.share > 0:
        yield BarPart(_NAMES[UNEXPLAINED], here.rest.share, GREY, hatched=True)


def budget_table(diagnosis: Diagnosis) -> Table:
    """Tabulate the parts of a gap, the largest first and the rest last, by channel."""
    channels = budgets_by_channel(diagnosis.budget)
    entries = [entry for here in channels for entry in (*here.named, *(() if here.rest is None else (here.rest,)))]
    table = Table.of(
        "budget",
        "",
        entries,
        Field("channel", "channel", lambda entry: entry.channel.replace("_", " ")),
        Field("cause", "part of the gap", lambda entry: capitalise(part_name(entry))),
        Field("share", "share", lambda entry: entry.share, percent()),
        Field("share_95ci", "95 % interval", _interval_text),
        Field("rms_mN", "rms, mN", lambda entry: entry.rms_mN, decimals(1)),
        Field("presence", "probability that it is there", _presence_cell),
        Field("what", "what it is", lambda entry: _description(entry, diagnosis.unknown)),
    )
    single = len(channels) < 2
    return table.select(*(column.name for column in table.columns if not (single and column.name == "channel")))


def _interval_text(entry: BudgetEntry) -> str:
    if entry.share_95ci is None or not all(map(isfinite, entry.share_95ci)):
        return ""
    low, high = map(_WHOLE_PERCENT, entry.share_95ci)
    return f"{low} to {high}"


def _presence_cell(entry: BudgetEntry) -> FormattedNumber | str:
    if entry.presence is None:
        return ""
    return FormattedNumber(entry.presence, probability_text(entry.presence))


def _description(entry: BudgetEntry, unknown: UnexplainedGap | None) -> str:
    if entry.cause == UNEXPLAINED and entry.what:
        return f"Best described by {join_names([_cause_name(name) for name in _causes(entry)])}; not established"
    if entry.cause == UNEXPLAINED and unknown is not None:
        return as_sentence(unknown.location)
    if entry.cause in _MEANINGS:
        return f"{_MEANINGS[entry.cause]}{': ' if entry.what else ''}{entry.what}"
    if entry.what:
        return capitalise(entry.what)
    return catalogue()[entry.cause].summary if entry.cause in catalogue() else ""


def _causes(entry: BudgetEntry) -> tuple[str, ...]:
    """Return the causes that describe the rest best: free laws by name, and ids of effects that are not established."""
    return tuple(filter(None, entry.what.split(", ")))


def _cause_name(cause: str) -> str:
    return display_name(cause) if cause in catalogue() else cause


def presence_json(budget: GapBudget | None) -> Mapping[str, float | None]:
    """Return the probability that each effect is there."""
    return {} if budget is None else {effect: _rounded(value) for effect, value in budget.presence.items()}


def budget_json(diagnosis: Diagnosis) -> list[Mapping[str, object]]:
    """Return the parts of a gap as in a gap report; empty without a gap."""
    channels = budgets_by_channel(diagnosis.budget)
    described = _described_channel(diagnosis, [here.channel for here in channels])
    parts: list[Mapping[str, object]] = []
    for here in channels:
        parts += map(_entry_json, here.named)
        if here.rest is not None:
            parts.append({**_entry_json(here.rest), **_rest_json(here, diagnosis, here.channel == described)})
    return parts


def _entry_json(entry: BudgetEntry) -> Mapping[str, object]:
    interval = entry.share_95ci
    known = interval is not None and all(map(isfinite, interval))
    return {
        "cause": entry.cause,
        "channel": entry.channel,
        "share": _rounded(entry.share),
        "share_95ci": [_rounded(end) for end in interval] if interval is not None and known else None,
        "rms_mN": entry.rms_mN,
        "presence": None if entry.presence is None else _rounded(entry.presence),
        "what": entry.what or None,
        "not_separable_from": entry.not_separable_from,
    }


def _rest_json(here: ChannelBudget, diagnosis: Diagnosis, described: bool) -> Mapping[str, object]:
    """Return place, coordinate and law of the unexplained rest.

    A diagnosis says where the whole gap is; that is where the rest is only if no part of it has a name.
    """
    unknown = diagnosis.unknown if described else None
    whole = described and not here.named
    place: dict[str, object] = {
        location.name: location.document() for location in diagnosis.where.locations if whole and location.shares
    }
    if unknown is not None:
        place["in_words"] = unknown.location
    causes = () if here.rest is None else _causes(here.rest)
    coordinates = [catalogue()[cause].coordinate.value if cause in catalogue() else cause for cause in causes]
    depends_on = ", ".join(dict.fromkeys(coordinates))
    return {
        "where": place,
        "depends_on": depends_on or (diagnosis.where.domain if whole else "") or None,
        "resembles": [cause for cause in causes if cause in catalogue()],
        "law": unknown.expression or None if unknown is not None else None,
    }


def _described_channel(diagnosis: Diagnosis, channels: Sequence[str]) -> str:
    """Return the channel that the diagnosis describes what is left in: the one with most of the gap."""
    shares = next((location.shares for location in diagnosis.where.locations if location.name == "channel"), {})
    return max(channels, key=lambda channel: shares.get(channel, 0.0), default="")


def _rounded(value: float) -> float | None:
    return round(value, SHARE_DECIMALS) if isfinite(value) else None
