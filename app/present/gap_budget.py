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
    RunContributions,
    UnexplainedGap,
    Verdict,
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
    attributes_json,
    decimals,
    percent,
    probability_text,
    round_to_sum,
    significant,
)
from dragrig.sim_backend.effects import catalogue

MIN_SHOWN_SHARE = 0.02
"""Smaller parts are summed up as others in sentences and bars; the table has them all."""
MAX_SENTENCE_PARTS = 4
"""Parts that a sentence names; it sums up further ones, which bar and table have."""
MAX_ALTERNATIVES = 2
"""Effects that cannot be separated from each other are named up to this many, and one more rather than counting it."""
SHARE_DECIMALS = 4
MAX_PERCENT_DIGITS = 2
MOSTLY, NEARLY_ALL = 0.5, 0.9
"""Shares from which on a gap is mostly, or simply, that of the model or the specimen."""
ROUGH_WIDTH = 0.3
"""A share whose 95 % interval is wider stands beside its interval in a sentence."""
VAGUE_WIDTH = 1.0
"""A share whose 95 % interval is wider is not stated: it may be next to nothing or all."""
LEAST_STATED = 0.05
SURE = 0.9
"""An effect whose probability of presence is smaller is called probable in sentences."""
ALL = "all"
_NAMES = {MODEL: "the model itself", SPECIMEN: "the specimen itself", UNEXPLAINED: "unexplained"}
OTHERS = "others"
_OWNERS = {MODEL: "the nominal model's", SPECIMEN: "the specimen's"}
_IN_RELAXATIONS = " in relaxations"
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

    @property
    def shown(self) -> tuple[BudgetEntry, ...]:
        """Large parts and the rest."""
        return (*self.large, *(() if self.rest is None else (self.rest,)))

    @property
    def vague(self) -> bool:
        """Whether the shares of large parts are next to unknown."""
        return any(_interval_width(entry) > VAGUE_WIDTH for entry in self.large)

    @property
    def single(self) -> bool:
        """Whether one part has all of the gap."""
        percents = self.percents
        return len(self.large) == 1 and percents[OTHERS] <= 0 and percents.get(UNEXPLAINED, 0) <= 0

    @property
    def percents(self) -> Mapping[str, int]:
        """Shares of the large parts, of the others and of the rest in whole per cent, which sum up as the shares do."""
        shares = {entry.cause: 100 * entry.share for entry in self.large} | {OTHERS: 100 * self.small_share}
        if self.rest is not None:
            shares[UNEXPLAINED] = 100 * self.rest.share
        return dict(zip(shares, round_to_sum(tuple(shares.values())), strict=True))


def _interval_width(entry: BudgetEntry) -> float:
    low, high = entry.share_95ci or (0.0, 0.0)
    return high - low if isfinite(high - low) else 0.0


def budgets_by_channel(budget: GapBudget | None) -> tuple[ChannelBudget, ...]:
    """Return the budget of each channel, the force's first; parts without a finite share are left out."""
    entries = () if budget is None else tuple(entry for entry in budget.entries if isfinite(entry.share))
    channels = sorted(dict.fromkeys(entry.channel for entry in entries), key=lambda channel: channel != "force")
    return tuple(_channel_budget(channel, entries) for channel in channels)


def _channel_budget(channel: str, entries: Sequence[BudgetEntry]) -> ChannelBudget:
    here = [entry for entry in entries if entry.channel == channel]
    named = sorted((entry for entry in here if entry.cause != UNEXPLAINED), key=lambda entry: -entry.share)
    return ChannelBudget(channel, tuple(named), next((entry for entry in here if entry.cause == UNEXPLAINED), None))


def part_name(entry: BudgetEntry, at_most: int | None = MAX_ALTERNATIVES) -> str:
    """Name a part, together with the effects that cannot be separated from it: `adhesion or Stribeck friction`.

    Parameters
    ----------
    at_most
        Effects that are named; further ones are counted. None names all.
    """
    names = [_NAMES.get(cause) or display_name(cause) for cause in (entry.cause, *entry.not_separable_from)]
    if at_most is not None and len(names) > at_most + 1:
        names[at_most:] = [f"{len(names) - at_most} other effects"]
    return " or ".join(names)


def owner_of_gap(budget: GapBudget | None) -> str:
    """Say whose own most of the force's gap is: `the nominal model's own`; nothing where it is neither's."""
    here = next((here for here in budgets_by_channel(budget) if here.channel == "force"), None)
    return "" if here is None else _owner(here)[0]


def _owner(here: ChannelBudget) -> tuple[str, float]:
    """Return whose own the gap of a channel is, and how much of it."""
    own = {entry.cause: entry for entry in here.named if entry.cause in _OWNERS and entry.share > 0}
    sure = any(entry.share_95ci is None or entry.share_95ci[0] > 0 for entry in own.values())
    total = sum(entry.share for entry in own.values())
    if not sure or total < MOSTLY:
        return "", 0.0
    most = max(own.values(), key=lambda entry: entry.share)
    if most.share >= MOSTLY:
        return f"{_OWNERS[most.cause]} own", most.share
    return f"{' and '.join(_OWNERS.values())} own", total


def _stated_name(entry: BudgetEntry) -> str:
    """Name a part in a sentence; an effect as probable where its presence is not sure."""
    probable = entry.presence is not None and entry.presence < SURE and entry.cause not in _NAMES
    return f"{'probably ' if probable else ''}{part_name(entry)}"


def _gap_text(budget: GapBudget, channel: str, article: str = "a gap of ") -> str:
    """Name the gap of a channel, with its size where that is known: `a gap of 12 mN`."""
    if channel != "force":
        return f"the gap in the {channel.replace('_', ' ')}"
    several = any(entry.channel != "force" for entry in budget.entries)
    gap = f"{article}{_ROUGH(budget.gap_mN)} mN" if isfinite(budget.gap_mN) else "the gap"
    return f"{gap} in the force" if several else gap


def budget_sentences(budget: GapBudget | None) -> tuple[str, ...]:
    """Say what a gap is made of: a sentence for each channel, then how sure its shares are, then what runs against it.

    None without a gap.
    """
    if budget is None:
        return ()
    channels = budgets_by_channel(budget)
    whole = tuple(_channel_sentence(budget, here) for here in channels)
    rough = filter(None, map(_roughness_sentence, channels))
    opposed = (
        f"None of it is {part_name(entry)}: that runs against the gap ({_WHOLE_PERCENT(entry.share)})."
        for here in channels
        for entry in here.opposed
    )
    return *whole, *rough, *opposed


def _channel_sentence(budget: GapBudget, here: ChannelBudget) -> str:
    parts = _vague_parts_text(here) if here.vague else _parts_text(here)
    owner, share = _owner(here) if here.channel == "force" else ("", 0.0)
    if not owner:
        return f"Of {_gap_text(budget, here.channel)}, {parts}."
    mostly = "" if share >= NEARLY_ALL and not here.vague else "mostly "
    return f"The gap is {mostly}{owner}: of {_gap_text(budget, here.channel, '')}, {parts}."


def _parts_text(here: ChannelBudget) -> str:
    """Say what share each part has; `nothing is explained`, `all is velocity ripple`."""
    percents = here.percents
    rest = percents.get(UNEXPLAINED, 0)
    shares = [(percents[entry.cause], _stated_name(entry)) for entry in here.large[:MAX_SENTENCE_PARTS]]
    others = percents[OTHERS] + sum(percents[entry.cause] for entry in here.large[MAX_SENTENCE_PARTS:])
    if others > 0 and shares:
        shares.append((others, OTHERS))
    if not shares:
        return "nothing is explained" if rest >= 100 else f"{rest} % is unexplained"
    if here.single:
        return f"{ALL} is {shares[0][1]}"
    (share, name), *further = shares
    parts = [f"{share} % is {name}", *(f"{share} % {name}" for share, name in further)]
    return f"{', '.join(parts)}; {f'{rest} % is unexplained' if rest > 0 else 'nothing is left unexplained'}"


def _vague_parts_text(here: ChannelBudget) -> str:
    """Say what is known of shares that may be next to nothing or all."""
    parts = [f"at least {_WHOLE_PERCENT(low)} is {_stated_name(entry)}" for entry, low in _surely(here) if low > 0]
    possible = [part_name(entry) for entry, low in _surely(here) if not low]
    if possible:
        parts.append(f"these runs leave open how much is {join_names(possible)}")
    return ", ".join(parts)


def _surely(here: ChannelBudget) -> list[tuple[BudgetEntry, float]]:
    """Return the large parts with the share that each has at least; 0 where it may be next to nothing."""
    lows = [0.0 if entry.share_95ci is None else entry.share_95ci[0] for entry in here.large]
    return [(entry, low if low >= LEAST_STATED else 0.0) for entry, low in zip(here.large, lows, strict=True)]


def _roughness_sentence(here: ChannelBudget) -> str:
    """Give the intervals of shares that are only roughly known; nothing where all are known well."""
    rough = [entry for entry in here.shown if _interval_width(entry) > ROUGH_WIDTH]
    if not rough:
        return ""
    parts = ", ".join(f"{part_name(entry)} {_interval_text(entry)}" for entry in rough)
    over = any(entry.share_95ci is not None and entry.share_95ci[1] > 1 for entry in rough)
    return f"The shares are rough: {parts}{'; above 100 % a part overshoots the gap' if over else ''}."


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
    if here.vague:
        yield from _vague_bar_parts(here, colours)
        return
    percents = here.percents
    for entry in here.large:
        size = ALL if here.single else f"{percents[entry.cause]} %"
        yield BarPart(part_name(entry), entry.share, size, colours[entry.cause])
    if percents[OTHERS] > 0:
        yield BarPart(OTHERS, here.small_share, f"{percents[OTHERS]} %", GREY)
    if here.rest is not None and percents[UNEXPLAINED] > 0:
        yield BarPart(_NAMES[UNEXPLAINED], here.rest.share, f"{percents[UNEXPLAINED]} %", GREY, hatched=True)


def _vague_bar_parts(here: ChannelBudget, colours: Mapping[str, str]) -> Iterator[BarPart]:
    """Yield what each part has at least; what lies between that and the whole is any of them, or unexplained."""
    surely = _surely(here)
    for entry, low in surely:
        if low > 0:
            yield BarPart(part_name(entry), low, f"at least {_WHOLE_PERCENT(low)}", colours[entry.cause])
    left = 1.0 - sum(low for _, low in surely)
    if left >= MIN_SHOWN_SHARE:
        names = " or ".join((*(part_name(entry) for entry in here.large), _NAMES[UNEXPLAINED]))
        yield BarPart(names, left, _WHOLE_PERCENT(left), GREY, hatched=True)


def budget_table(diagnosis: Diagnosis) -> Table:
    """Tabulate the parts of a gap, the largest first and the rest last, by channel."""
    channels = budgets_by_channel(diagnosis.budget)
    entries = [entry for here in channels for entry in (*here.named, *(() if here.rest is None else (here.rest,)))]
    # Without a named effect, a diagnosis says where the whole gap is, not where the rest beside model or specimen is.
    of_whole = diagnosis.verdict is Verdict.UNKNOWN and any(here.named for here in channels)
    percents = {(here.channel, cause): value for here in channels for cause, value in here.percents.items()}

    def share(entry: BudgetEntry) -> FormattedNumber:
        whole_percent = percents.get((entry.channel, entry.cause), 100 * entry.share)
        return FormattedNumber(entry.share, _WHOLE_PERCENT(whole_percent / 100))

    table = Table.of(
        "budget",
        "",
        entries,
        Field("channel", "channel", lambda entry: entry.channel.replace("_", " ")),
        Field("cause", "part of the gap", lambda entry: capitalise(part_name(entry, None))),
        Field("share", "share", share),
        Field("share_95ci", "95 % interval", _interval_text),
        Field("rms_mN", "rms, mN", lambda entry: entry.rms_mN, decimals(1)),
        Field("presence", "probability that it is there", _presence_cell),
        Field("what", "what it is", lambda entry: _description(entry, None if of_whole else diagnosis.unknown)),
    )
    single = len(channels) < 2
    return table.select(*(column.name for column in table.columns if not (single and column.name == "channel")))


def _interval_text(entry: BudgetEntry) -> str:
    if entry.share_95ci is None or not all(map(isfinite, entry.share_95ci)):
        return ""
    # With as many digits as it takes to tell the ends apart.
    texts = [tuple(map(percent(digits), entry.share_95ci)) for digits in range(MAX_PERCENT_DIGITS + 1)]
    low, high = next((ends for ends in texts if ends[0] != ends[1]), texts[-1])
    return f"{low} to {high}" if low != high else ""


def _presence_cell(entry: BudgetEntry) -> FormattedNumber | str:
    if entry.presence is None:
        return ""
    return FormattedNumber(entry.presence, probability_text(entry.presence))


def _description(entry: BudgetEntry, unknown: UnexplainedGap | None) -> str:
    if entry.cause == UNEXPLAINED and entry.what:
        named = [display_name(name) if name in catalogue() else name for name in _causes(entry)]
        return f"Best described by {join_names(named)}; not established"
    if entry.cause == UNEXPLAINED and unknown is not None:
        return as_sentence(unknown.location)
    if entry.cause == MODEL:
        return _model_description(entry)
    if entry.cause == SPECIMEN:
        what = ", by a factor on their force" if entry.what in {"", "gain of a run"} else f": {entry.what}"
        return f"Runs or specimens differ more than usual{what}"
    if entry.what:
        return capitalise(entry.what)
    return catalogue()[entry.cause].summary if entry.cause in catalogue() else ""


def _model_description(entry: BudgetEntry) -> str:
    """Say what of the nominal model is off, in all runs and in relaxations alone."""
    names = [name.replace(" of the model", "") for name in _causes(entry)]
    everywhere = join_names([name for name in names if not name.endswith(_IN_RELAXATIONS)])
    in_relaxations = join_names(
        [name.removesuffix(_IN_RELAXATIONS) for name in names if name.endswith(_IN_RELAXATIONS)]
    )
    if not in_relaxations:
        return f"The nominal model's {everywhere or 'own parameters or structure'} are off"
    if not everywhere:
        return f"The nominal model's {in_relaxations} are off in relaxations"
    return f"The nominal model's {everywhere} are off, and in relaxations {in_relaxations} beyond that"


def _causes(entry: BudgetEntry) -> tuple[str, ...]:
    """Return the causes that describe the rest best: free laws by name, and ids of effects that are not established."""
    return tuple(filter(None, entry.what.split(", ")))


def presence_json(budget: GapBudget | None) -> Mapping[str, float | None]:
    """Return the probability that each effect is there."""
    return {} if budget is None else {effect: _rounded(value) for effect, value in budget.presence.items()}


def budget_json(diagnosis: Diagnosis, run_ids: Mapping[str, str] | None = None) -> list[Mapping[str, object]]:
    """Return the parts of a gap as in a gap report; empty without a gap.

    Parameters
    ----------
    run_ids
        Ids of the runs by the names of their files; a file without one is named.
    """
    channels = budgets_by_channel(diagnosis.budget)
    runs = () if diagnosis.budget is None else diagnosis.budget.runs
    # What is left is described in the channel with most of the gap.
    shares = next((location.shares for location in diagnosis.where.locations if location.name == "channel"), {})
    described = max((here.channel for here in channels), key=lambda channel: shares.get(channel, 0.0), default="")
    parts: list[Mapping[str, object]] = []
    for here in channels:
        parts += (
            {**_entry_json(entry), "largest_in": _largest_json(entry, runs, run_ids or {})} for entry in here.named
        )
        if here.rest is not None:
            parts.append({**_entry_json(here.rest), **_rest_json(here, diagnosis, here.channel == described)})
    return parts


def _largest_json(
    entry: BudgetEntry, runs: Sequence[RunContributions], run_ids: Mapping[str, str]
) -> Mapping[str, object] | None:
    """Return the run where a part adds most, and how much; None where no run shows it."""
    showing = [run for run in runs if run.channel == entry.channel and run.rms(entry.cause) > 0]
    if not showing:
        return None
    largest = max(showing, key=lambda run: run.rms(entry.cause))
    return {"run": run_ids.get(largest.file, largest.file), "rms": largest.rms(entry.cause), "unit": largest.unit}


def _entry_json(entry: BudgetEntry) -> Mapping[str, object]:
    interval = entry.share_95ci
    known = interval is not None and all(map(isfinite, interval))
    return {
        **attributes_json(entry, "cause", "channel", "rms_mN", "not_separable_from"),
        "share": _rounded(entry.share),
        "share_95ci": [_rounded(end) for end in interval] if interval is not None and known else None,
        "presence": None if entry.presence is None else _rounded(entry.presence),
        "what": entry.what or None,
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


def _rounded(value: float) -> float | None:
    return round(value, SHARE_DECIMALS) if isfinite(value) else None
