"""Settle a gap: make runs, diagnose, choose the next runs, make them, until the answer is sure or the time is spent.

Decisions are kept beside the runs after each step, so that the loop goes on from there after any end of the program.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, Unpack

from pydantic import ValidationError

from dragrig.analysis.gap import (
    DEFAULT_HANDS_MIN,
    DEFAULT_UNTIL,
    SETTLE_FILE,
    Batch,
    Diagnosis,
    NextExperiment,
    SettleRecord,
    batch_budget,
    ending_of,
    mounting,
    plan_of_next_runs,
    require_hands,
    run_text,
    settle_step,
)
from dragrig.api.gap import DiagnosedCampaign, DiagnosisRequest, require_minutes, stage_range
from dragrig.api.measure import check, resume, run
from dragrig.config import DragrigError, PlanError, RunFileError, SettingsError
from dragrig.rig import Mirror, ignore, latest_session_record, read_campaign, read_session_records, replace_text
from dragrig.setup import PlanLike, SetupChoices, resolve

if TYPE_CHECKING:
    from dragrig.campaign_session import Made
    from dragrig.hosted_session import SessionOperator
    from dragrig.setup import Pace

DEFAULT_SETTLE_MIN = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Settlement:
    """A settled gap, or how far it was settled."""

    folder: Path
    """The campaign."""
    record: SettleRecord
    """The decision after each batch, and the reason of the end."""
    diagnosed: DiagnosedCampaign
    """The last diagnosis."""
    made: "Made | None" = None
    """How the last session ended; None where no run was made this time."""


class SettleHands(TypedDict, total=False):
    """Who is at the rig, and how its runs are made; arguments of `dragrig.run`; only `tell` hears of warnings."""

    operator: str
    note: str
    pace: "Pace | None"
    person: "SessionOperator | None"
    mirror: str | Path | None
    tell: Callable[[str], None]


def gap_settle(
    plan: PlanLike,
    *,
    minutes: float = DEFAULT_SETTLE_MIN,
    until: float = DEFAULT_UNTIL,
    hands_min: float = DEFAULT_HANDS_MIN,
    out: str | Path | None = None,
    hands: SettleHands | None = None,
    step: Callable[[SettleRecord], None] | None = None,
    **choices: Unpack[SetupChoices],
) -> Settlement:
    """Make the runs of a plan, and after them those that tell most of the cause of the gap, until that is settled.

    Parameters
    ----------
    plan
        The first runs; a few of each kind suffice, as the shipped plan `first`.
    minutes
        Rig time of all runs, rests and returns included; a person's hands are not counted.
    until
        Probability of verdict and causes from which the gap counts as settled.
    hands_min
        Minutes of a person at a change of fixture or capsule: the more, the more a run must tell that needs one.
    out
        Folder of the campaign, new or without runs (default: a new one in the rig's data root).
    hands
        Who answers prompts, and how the runs are made.
    step
        Called after each decision with all decisions so far.
    choices
        As of `check`.

    Returns
    -------
    The last diagnosis, and the decisions on the way.

    Raises
    ------
    SettingsError
        For a time, also of hands, or a probability that cannot be.
    PlanError
        When the first runs take longer than all of the time.
    AbortedError, TrippedError, DeviceError
        When a session ended early; `gap_settle_resume` goes on.

    Examples
    --------
    >>> import dragrig
    >>> settled = dragrig.gap_settle("first", minutes=20)  # doctest: +SKIP
    >>> settled.record.ending, settled.diagnosed.result.effects  # doctest: +SKIP
    """
    from dragrig.campaign_session import require_mirror_in_reach, require_no_runs

    require_minutes(minutes)
    require_hands(hands_min)
    if not 0.5 <= until < 1.0:
        raise SettingsError(f"until {until:g}: is a probability from 0.5 to below 1.")
    setup = resolve(plan, **choices)
    first_min = setup.programme().duration_s / 60
    if first_min > minutes:
        raise PlanError(
            f"{setup.plan.name}: takes {first_min:.1f} min of rig time, more than the {minutes:g} minutes given; "
            "begin with a shorter plan, as first, or give more time."
        )
    check(plan, out=out, **choices).require()
    if out is not None:
        # Before anything is written: the decisions of an earlier loop stand there.
        require_no_runs(Path(out))
    if hands is not None and (mirror := hands.get("mirror")) is not None:
        require_mirror_in_reach(Path(mirror))
    now = datetime.now().astimezone()
    folder = setup.data_root / f"{now:%Y%m%d-%H%M%S}-settle-{setup.plan.name}" if out is None else Path(out)
    first = Batch(plan=setup.plan, minutes=first_min, reason="the first runs")
    record = SettleRecord(
        plan=setup.plan.name, begun_at=now, minutes=minutes, until=until, hands_min=hands_min, batches=(first,)
    )
    with _settling(folder, hands or SettleHands(), step or ignore) as settling:
        with _no_trace_if_nothing_began(folder):
            settling.keep(record)
            made = run(plan, out=folder, **settling.hands, **choices)
        made.session.require()
        return settling.go_on(record, made)


def gap_settle_resume(
    campaign: str | Path,
    *,
    hands: SettleHands | None = None,
    step: Callable[[SettleRecord], None] | None = None,
    minutes: float | None = None,
) -> Settlement:
    """Go on with settling a gap, whatever ended it; runs that are missing are made first.

    Parameters
    ----------
    campaign
        The campaign's folder.
    minutes
        Rig time of all runs (default: as it began); more makes a settling go on that had spent its time.

    Raises
    ------
    RunFileError
        Where nothing was being settled.
    DragrigError
        As `settle`.
    """
    folder = Path(campaign)
    record = read_settle_record(folder)
    if minutes is not None:
        require_minutes(minutes)
        record = record.model_copy(update={"minutes": minutes, "ending": None})
    with _settling(folder, hands or SettleHands(), step or ignore) as settling:
        made = settling.made_last_batch(record) if lacks_runs(folder, record) else None
        return settling.go_on(record, made)


def read_settle_record(folder: Path) -> SettleRecord:
    """Read the decisions of a campaign; raises `RunFileError` where nothing was, or it cannot be read."""
    path = folder / SETTLE_FILE
    try:
        return SettleRecord.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise RunFileError(
            f"{folder}: holds no {SETTLE_FILE}, so nothing was being settled there; name the folder that gap settle "
            "printed."
        ) from None
    except (OSError, ValidationError) as error:
        raise RunFileError(
            f"{path}: cannot be read ({type(error).__name__}); the runs are sound: dragrig gap diagnose {folder}."
        ) from error


def write_settle_record(folder: Path, record: SettleRecord) -> None:
    """Write decisions into a campaign."""
    replace_text(folder / SETTLE_FILE, record.model_dump_json(indent=1))


@contextmanager
def mirrored_decisions(
    folder: Path, mirror: str | Path | None, tell: Callable[[str], None]
) -> Iterator[Callable[[SettleRecord], None]]:
    """Yield a writer of decisions into a campaign, and into its mirror as run files are: verified, and not waited for.

    At the end of the block the last copy is waited for. Of a session that never began, nothing is left in the mirror.

    Parameters
    ----------
    mirror
        Folder of the mirror; None for none.
    tell
        Called, from any thread, with a sentence about a copy that could not be made.
    """
    copies = None if mirror is None else Mirror(Path(mirror), folder.resolve().name, tell)

    def write(record: SettleRecord) -> None:
        write_settle_record(folder, record)
        if copies is not None:
            copies.submit(folder / SETTLE_FILE, partial(_is_earlier_state, record.begun_at))

    try:
        yield write
    finally:
        if copies is not None:
            _close_mirror(copies, folder, tell)


def _close_mirror(copies: Mirror, folder: Path, tell: Callable[[str], None]) -> None:
    report = copies.close()
    for name, why in report.missing.items():
        tell(f"NOT MIRRORED: {name} is not in {report.folder} as it is in {folder}: {why}.")
    original, copy = folder / SETTLE_FILE, report.folder / SETTLE_FILE
    if report.copied and not original.exists() and copy.resolve() != original.resolve():
        with suppress(OSError):
            copy.unlink(missing_ok=True)
            report.folder.rmdir()


def _is_earlier_state(begun_at: datetime, copy: Path) -> bool:
    """Whether decisions in a mirror are of the loop that began then."""
    try:
        return SettleRecord.model_validate_json(copy.read_bytes()).begun_at == begun_at
    except ValidationError:
        return False


def take_up_settling(folder: Path, minutes: float) -> SettleRecord:
    """Return the decisions in a campaign with so much rig time for further runs; its runs so far count as the first.

    Nothing is written.

    Parameters
    ----------
    minutes
        Rig time of the further runs.

    Raises
    ------
    RunFileError
        Where there is no campaign, or its decisions cannot be read.
    """
    from dragrig.campaign_session import rig_time_s

    if (folder / SETTLE_FILE).exists():
        record = read_settle_record(folder)
        spent_min = sum(batch.minutes for batch in record.batches[: len(record.steps)])
        return record.model_copy(update={"minutes": spent_min + minutes, "ending": None})
    plan, spent_min = latest_session_record(folder)[0].plan, rig_time_s(folder) / 60
    so_far = Batch(plan=plan, minutes=spent_min, reason="the runs so far")
    now = datetime.now().astimezone()
    return SettleRecord(
        plan=plan.name, begun_at=now, minutes=spent_min + minutes, until=DEFAULT_UNTIL, batches=(so_far,)
    )


def lacks_runs(folder: Path, record: SettleRecord) -> bool:
    """Whether runs of the last batch are missing and can be made; those that a settling began with may be incomplete.

    Where a person went on with another plan meanwhile, missing ones are not made, as with any plan before the latest.
    """
    from dragrig.campaign_session import missing_runs

    if len(record.steps) == len(record.batches) or not (folder / SETTLE_FILE).exists():
        return False
    sessions = {session.plan.name for session in read_session_records(folder)[0]}
    return record.batches[-1].plan.name not in sessions or (has_begun(folder, record) and missing_runs(folder) > 0)


def has_begun(folder: Path, record: SettleRecord) -> bool:
    """Whether the campaign's latest session is of the last batch, and so can be resumed."""
    return latest_session_record(folder)[0].plan.name == record.batches[-1].plan.name


def settle_request(folder: Path, record: SettleRecord, nominal: str | Path = "capsule") -> DiagnosisRequest:
    """Return how the campaign is diagnosed: with the rig time that is left for its next runs."""
    limits = stage_range(resolve("drag", folder=folder, campaign=latest_session_record(folder)[0]))
    return DiagnosisRequest(nominal=nominal, next_runs=batch_budget(record.left_min, limits, record.hands_min))


def after_diagnosis(folder: Path, record: SettleRecord, diagnosis: Diagnosis) -> SettleRecord:
    """Return the decisions with that on a diagnosis by `settle_request`: the next batch, or why to end."""
    left_min = record.left_min
    if len(record.steps) < len(record.batches):
        record = record.model_copy(update={"steps": (*record.steps, settle_step(diagnosis, record))})
    ending = ending_of(diagnosis, record.until, left_min)
    if ending is not None or diagnosis.next_experiment is None:
        return record.model_copy(update={"ending": ending})
    return record.model_copy(update={"batches": (*record.batches, _batch(folder, diagnosis.next_experiment, record))})


def _batch(folder: Path, experiment: NextExperiment, record: SettleRecord) -> Batch:
    runs = [info for info in read_campaign(folder).runs if info.kind != "return"]
    name = f"{record.plan}-then-{len(record.batches)}"
    gains = [run.gain_bits for run in experiment.runs if run.gain_bits is not None]
    return Batch(
        plan=plan_of_next_runs(experiment, name, mounting(runs[-1].kind)),
        minutes=experiment.minutes,
        runs=tuple(run_text(run.step) for run in experiment.runs),
        reason=experiment.reason,
        gain_bits=sum(gains) if gains else None,
    )


@contextmanager
def _no_trace_if_nothing_began(folder: Path) -> Iterator[None]:
    """Leave no folder behind where a session did not even begin."""
    try:
        yield
    except DragrigError:
        if not read_session_records(folder)[0]:
            (folder / SETTLE_FILE).unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def _settling(folder: Path, hands: SettleHands, step: Callable[[SettleRecord], None]) -> Iterator["_Settling"]:
    chosen: SettleHands = {"tell": ignore, **hands}
    with mirrored_decisions(folder, chosen.get("mirror"), chosen["tell"]) as write:
        yield _Settling(folder, chosen, step, write)


@dataclass(frozen=True, slots=True)
class _Settling:
    """The steps after the first runs."""

    folder: Path
    hands: SettleHands
    step: Callable[[SettleRecord], None]
    write: Callable[[SettleRecord], None]

    def keep(self, record: SettleRecord) -> None:
        """Write the decisions, and tell of them."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.write(record)
        self.step(record)

    def made_last_batch(self, record: SettleRecord) -> "Made":
        """Make the runs of the last batch that are missing."""
        if has_begun(self.folder, record):
            made = resume(self.folder, **self.hands)
        else:
            made = run(record.batches[-1].plan, append=self.folder, **self.hands)
        made.session.require()
        return made

    def go_on(self, record: SettleRecord, made: "Made | None") -> Settlement:
        """Diagnose, and make further runs, until there is a reason to end."""
        while True:
            diagnosed = settle_request(self.folder, record).diagnose(self.folder)
            record = after_diagnosis(self.folder, record, diagnosed.result)
            self.keep(record)
            if len(record.steps) == len(record.batches):
                return Settlement(self.folder, record, diagnosed, made)
            made = self.made_last_batch(record)
