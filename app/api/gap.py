"""Diagnose the gap between runs and model, of one campaign or many, and find the next measurement.

Amended model and report are written on the way; a plan or a campaign also says beforehand which effects it can isolate.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypedDict, Unpack

from dragrig.analysis import (
    CapsuleModel,
    NominalModel,
    Progress,
    RunSelection,
    count_text,
    find_model,
    no_progress,
    parse_model_settings,
    parts_of,
)
from dragrig.analysis.gap import (
    DEFAULT_HANDS_MIN,
    Diagnosis,
    ExperimentBudget,
    Isolability,
    ModelEvaluation,
    NextExperiment,
    RigLimits,
    choose_runs,
    without_runs,
)
from dragrig.api.measure import simulate
from dragrig.config import (
    UNSTATED,
    AnalysisError,
    DragrigError,
    ModelSettings,
    SettingsError,
    absolute_if_file,
    find_table,
    refuse_unknown,
    suggestion,
    to_toml,
)
from dragrig.parallel import map_tasks, open_executor, parallel_map, parallel_map_with_progress
from dragrig.present import write_text
from dragrig.rig import Campaign, Run, RunInfo, read_campaign
from dragrig.setup import PlanLike, Setup, SetupChoices, resolve

if TYPE_CHECKING:
    from dragrig.analysis.gap import CampaignEvidence, DiagnosisOptions, PooledDiagnosis, VerdictCalibration


READING_COST, DIAGNOSIS_COST = 1, 19
LOOKING_COST, DIAGNOSING_COST, POOLING_COST = 1, 97, 2
COLLECTING_COST, ISOLATION_COST = 1, 30
"""Relative times of reading, or simulating, a campaign's runs and of what is made of them; of campaigns together, of
reading what their runs are, diagnosing each, and pooling."""


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedCampaign:
    """A diagnosis, and the runs that it was made of."""

    result: Diagnosis
    selection: RunSelection
    source: str

    @property
    def run_ids(self) -> Mapping[str, str]:
        """Ids of the runs by the names of their files."""
        return {experiment.file: experiment.run.info.header.run_id for experiment in self.selection.experiments}


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedFolder:
    """The diagnosis of one of many campaigns."""

    source: str
    """Its folder."""
    result: Diagnosis | None
    """None where the campaign could not be diagnosed."""
    run_ids: Mapping[str, str]
    """Ids of its runs by the names of their files."""
    why_not: str = ""
    """Why there is no diagnosis, a sentence; empty where there is one."""


class DiagnosisChoices(TypedDict, total=False):
    """The choices of a diagnosis of campaigns, as in `dragrig.gap_diagnose`."""

    nominal: str | Path | NominalModel
    without: Sequence[str]
    tolerance_mN: float | None
    specimen: str | None
    calibration: str | Path | None


@dataclass(frozen=True, slots=True)
class DiagnosisRequest:
    """The choices of a diagnosis, with the defaults of `DiagnosisChoices`, and its next runs."""

    nominal: str | Path | NominalModel = "capsule"
    without: Sequence[str] = ()
    tolerance_mN: float | None = None
    specimen: str | None = None
    calibration: str | Path | None = None
    next_runs: ExperimentBudget | None = field(default_factory=ExperimentBudget)
    """Limits of the next runs to recommend; None recommends none."""

    @classmethod
    def of(cls, **choices: Unpack[DiagnosisChoices]) -> Self:
        """Return the request of these choices; raises `TypeError` for any other."""
        refuse_unknown(choices, DiagnosisChoices.__annotations__)
        return cls(**choices)

    def options(self) -> "DiagnosisOptions":
        """Return the checked options; raises as `diagnosis_options`."""
        options = diagnosis_options(self.without, self.tolerance_mN, self.calibration)
        return replace(options, next_runs=self.next_runs)

    def model(self) -> NominalModel:
        """Return the expected model; raises `SettingsError`."""
        return find_model(str(self.nominal)) if isinstance(self.nominal, str | Path) else self.nominal

    def diagnose(
        self, campaign: str | Path | Campaign | Iterable[Run], progress: Progress = no_progress
    ) -> DiagnosedCampaign:
        """Diagnose one campaign; raises as `dragrig.gap_diagnose`."""
        from dragrig.analysis.gap.diagnose import diagnose as diagnose_selection

        # Before any run is read: a wrong option is told at once.
        model, options = self.model(), self.options()
        reading, diagnosing = parts_of(progress, READING_COST, DIAGNOSIS_COST)
        runs = Path(campaign) if isinstance(campaign, str | Path) else campaign
        selection = choose_runs(runs, self.specimen, reading)
        result = diagnose_selection(selection, model, options, diagnosing)
        folder = runs.folder if isinstance(runs, Campaign) else runs
        return DiagnosedCampaign(result, selection, str(folder) if isinstance(folder, Path) else "these runs")

    def diagnose_on_cluster(self, campaign: Path, scheduler: str) -> DiagnosedCampaign:
        """Diagnose one campaign on a Dask cluster; raises `SettingsError` and `WorkerError` too."""
        with open_executor(scheduler=scheduler) as executor:
            return parallel_map(executor, self.with_absolute_paths().diagnose, [campaign.absolute()])[0]

    def diagnose_folder(self, campaign: tuple[str, Path]) -> DiagnosedFolder:
        """Diagnose one of many campaigns, its name and its folder; an error becomes part of the result."""
        name, folder = campaign
        try:
            diagnosed = self.diagnose(folder)
        except DragrigError as error:
            return DiagnosedFolder(name, None, {}, str(error).replace(str(folder), name))
        return DiagnosedFolder(name, diagnosed.result, dict(diagnosed.run_ids))

    def diagnose_many(
        self,
        campaigns: Sequence[str | Path],
        workers: int | None = None,
        scheduler: str | None = None,
        progress: Progress = no_progress,
    ) -> tuple[DiagnosedFolder, ...]:
        """Diagnose campaigns in parallel; raises as `dragrig.gap_diagnose_many`."""
        self.options()
        tasks = [(str(campaign), Path(campaign).absolute()) for campaign in campaigns]
        return map_tasks(self.with_absolute_paths().diagnose_folder, tasks, workers, scheduler, progress)

    def evidence(self, campaign: "FolderToPool") -> "CampaignEvidence | str":
        """Return the evidence of a campaign, to be pooled; or why it cannot be diagnosed, a sentence."""
        from dragrig.analysis.gap import campaign_evidence

        model, options = self.model(), self.options()
        try:
            selection = without_runs(choose_runs(campaign.listing, self.specimen), campaign.counted_elsewhere)
            return campaign_evidence(campaign.name, selection, model, options)
        except DragrigError as error:
            return str(error).replace(str(campaign.listing.folder), campaign.name)

    def diagnose_together(
        self,
        campaigns: Sequence[str | Path],
        workers: int | None = None,
        scheduler: str | None = None,
        progress: Progress = no_progress,
    ) -> "PooledDiagnosis":
        """Diagnose campaigns of one rig together; raises as `dragrig.gap_diagnose_together`."""
        from dragrig.analysis.gap import MIN_CAMPAIGNS, CampaignEvidence, diagnose_together

        if len(campaigns) < MIN_CAMPAIGNS:
            raise AnalysisError("together: takes two campaigns or more; name another.")
        self.options()
        folders = [Path(campaign).absolute() for campaign in campaigns]
        looking, diagnosing, pooling = parts_of(progress, LOOKING_COST, DIAGNOSING_COST, POOLING_COST)
        with open_executor(workers, scheduler, tasks=len(folders)) as executor:
            listings = parallel_map_with_progress(executor, read_campaign, folders, looking)
            found = [FolderToPool(str(name), listing) for name, listing in zip(campaigns, listings, strict=True)]
            _require_one_rig(found)
            counted, remarks = _counted_once(found)
            if len(counted) < MIN_CAMPAIGNS:
                raise AnalysisError(f"fewer than two campaigns are left to pool: {'; '.join(remarks)}.")
            answers = parallel_map_with_progress(executor, self.with_absolute_paths().evidence, counted, diagnosing)
        evidence = [answer for answer in answers if isinstance(answer, CampaignEvidence)]
        remarks += [f"not diagnosed: {answer.rstrip('.')}" for answer in answers if isinstance(answer, str)]
        if len(evidence) < MIN_CAMPAIGNS:
            raise AnalysisError(f"fewer than two campaigns are left to pool: {'; '.join(remarks)}.")
        pooled = diagnose_together(evidence, remarks)
        pooling(1, 1)
        return pooled

    def with_absolute_paths(self) -> Self:
        """Return the same for processes with other working folders."""
        nominal = absolute_if_file(str(self.nominal)) if isinstance(self.nominal, str | Path) else self.nominal
        return replace(
            self, nominal=nominal, calibration=None if self.calibration is None else Path(self.calibration).absolute()
        )


def gap_diagnose(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    without: Sequence[str] = (),
    tolerance_mN: float | None = None,
    specimen: str | None = None,
    calibration: str | Path | None = None,
    progress: Progress = no_progress,
) -> Diagnosis:
    """Diagnose where a campaign differs from the nominal model, by which cause, and how far that closes the gap.

    Parameters
    ----------
    campaign
        A campaign's folder, or runs in memory. It need not be complete: `limitations` lists what these runs leave
        open.
    nominal
        The expected behaviour: `capsule` (the friction model), `drive` (the stage alone), a friction model as TOML, a
        Python file with a model of your own, or a model.
    without
        Effects of the catalogue to leave out.
    tolerance_mN
        Root mean square below which a gap does not matter (default: that of `DiagnosisOptions`).
    specimen
        Name or id, where the campaign holds several (default: the one with the most runs).
    calibration
        File written by `dragrig gap calibrate --save` (default: the shipped calibration).

    Raises
    ------
    AnalysisError
        When there is no usable run, or the model predicts nothing for these runs.
    RunFileError, SettingsError
        When folder or model cannot be read, or an option is not valid.

    Examples
    --------
    >>> import dragrig
    >>> diagnosis = dragrig.gap_diagnose("runs/first")  # doctest: +SKIP
    >>> diagnosis.verdict, diagnosis.effects, diagnosis.ranking[0].probability  # doctest: +SKIP
    >>> dragrig.simulate("drag", model=diagnosis.model)  # doctest: +SKIP
    """
    request = DiagnosisRequest(nominal, without, tolerance_mN, specimen, calibration)
    return request.diagnose(campaign, progress).result


def gap_diagnose_many(
    campaigns: Sequence[str | Path],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
    **choices: Unpack[DiagnosisChoices],
) -> tuple[DiagnosedFolder, ...]:
    """Diagnose campaigns in parallel, each as `dragrig.gap_diagnose` does; one that fails does not stop the others.

    Parameters
    ----------
    campaigns
        Their folders. The workers of a cluster must see the same folders.
    workers
        Number of processes (default: as many as there are cores).
    scheduler
        Address of a Dask cluster to use in their place.
    choices
        As of `gap_diagnose`, for all: nominal, without, tolerance_mN, specimen, calibration.

    Returns
    -------
    tuple of DiagnosedFolder
        In the order of the campaigns, the same for any number of workers.

    Raises
    ------
    SettingsError
        When an option is not valid, or the cluster cannot be used.
    WorkerError
        When processes end before the work is done.

    Examples
    --------
    >>> import dragrig
    >>> folders = dragrig.gap_diagnose_many(["runs/first", "runs/second"])  # doctest: +SKIP
    >>> [folder.result.verdict for folder in folders if folder.result]  # doctest: +SKIP
    """
    return DiagnosisRequest.of(**choices).diagnose_many(campaigns, workers, scheduler, progress)


@dataclass(frozen=True, slots=True)
class FolderToPool:
    """A campaign to be pooled with others."""

    name: str
    listing: Campaign
    """`name`, `listing`: as it was named, and as its runs state it."""
    counted_elsewhere: Mapping[str, str] = field(default_factory=dict)
    """Of runs that an earlier campaign has too: that campaign's name by their ids."""


def gap_diagnose_together(
    campaigns: Sequence[str | Path],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
    **choices: Unpack[DiagnosisChoices],
) -> "PooledDiagnosis":
    """Diagnose campaigns of one rig together: which effects are in all of them, in some, or in one.

    Effects of the rig have one set of parameters, those of specimens a population with a spread. A run that
    several folders hold counts once. A campaign that cannot be diagnosed is told among the remarks.

    Parameters
    ----------
    campaigns
        Their folders, each with specimens of its own.
    workers, scheduler, choices
        As of `gap_diagnose_many`.

    Raises
    ------
    AnalysisError
        When there are no two campaigns to pool, or they are not of one rig: of other force sensors or backends.
    RunFileError, SettingsError
        When a folder cannot be read, an option is not valid, or the cluster cannot be used.
    WorkerError
        When processes end before the work is done.

    Examples
    --------
    >>> import dragrig
    >>> pooled = dragrig.gap_diagnose_together(["runs/monday", "runs/tuesday"])  # doctest: +SKIP
    >>> [(effect.effect, effect.where, effect.probability) for effect in pooled.established]  # doctest: +SKIP
    """
    return DiagnosisRequest.of(**choices).diagnose_together(campaigns, workers, scheduler, progress)


def _require_one_rig(campaigns: Sequence[FolderToPool]) -> None:
    """Raise `AnalysisError` where campaigns are of different force sensors or backends."""
    stated: Mapping[str, Callable[[RunInfo], str]] = {
        "force sensors": lambda run: str(run.header.entry.get("sensor_serial", "")),
        "backends": lambda run: run.header.backend,
    }
    for what, state in stated.items():
        values = {each.name: {*map(state, each.listing.good)} - {"", UNSTATED} for each in campaigns}
        if len(frozenset().union(*values.values())) > 1:
            names = ", ".join(f"{name} ({' and '.join(sorted(value))})" for name, value in values.items() if value)
            raise AnalysisError(
                f"these campaigns are not of one rig: they name different {what}: {names}; pool those of one."
            )


def _counted_once(campaigns: Sequence[FolderToPool]) -> tuple[list[FolderToPool], list[str]]:
    """Return the campaigns, each run left to the earliest that has it, without those that have no other."""
    seen: dict[str, str] = {}
    counted, remarks = list[FolderToPool](), list[str]()
    for campaign in campaigns:
        runs = {run.header.run_id for run in campaign.listing.good}
        again = {run: seen[run] for run in runs if run in seen}
        seen |= dict.fromkeys(runs - again.keys(), campaign.name)
        where = ", ".join(dict.fromkeys(again.values()))
        if again and len(again) == len(runs):
            remarks.append(f"left out: all runs of {campaign.name} are in {where} too, and a run counts once")
            continue
        if again:
            remarks.append(f"{count_text(len(again), 'run')} of {campaign.name} also in {where} counted there alone")
        counted.append(replace(campaign, counted_elsewhere=again))
    return counted, remarks


def gap_evaluate(
    model: str | Path | ModelSettings, campaign: str | Path | Iterable[Run], *, specimen: str | None = None
) -> ModelEvaluation:
    """Evaluate on fresh runs of the same specimen whether an amended model keeps its promise.

    Parameters
    ----------
    model
        The model that `gap diagnose --save-model` wrote, or `Diagnosis.model`.
    campaign
        Runs that took no part in the diagnosis, best at other speeds.

    Raises
    ------
    AnalysisError
        When there is no usable run.
    RunFileError, SettingsError
        When folder or model cannot be read.
    """
    from dragrig.analysis.gap import evaluate

    runs = choose_runs(Path(campaign) if isinstance(campaign, str | Path) else campaign, specimen)
    settings = model if isinstance(model, ModelSettings) else parse_model_settings(*find_table("model", str(model)))
    return evaluate(runs, settings)


def diagnosis_options(
    without: Sequence[str], tolerance_mN: float | None, calibration: str | Path | None = None
) -> "DiagnosisOptions":
    """Return checked options; raises `SettingsError` for an unknown effect, a bad tolerance or calibration file."""
    from dragrig.analysis.gap import DiagnosisOptions
    from dragrig.sim_backend.effects import catalogue

    known = tuple(catalogue())
    for name in without:
        if name not in known:
            raise SettingsError(f"without {name}: is not in the catalogue of effects; {suggestion(name, known)}")
    tolerance = DiagnosisOptions().tolerance_mN if tolerance_mN is None else tolerance_mN
    if not (isfinite(tolerance) and tolerance >= 0):
        raise SettingsError(f"tolerance {tolerance:g}: a tolerance is a force in mN from 0 on.")
    learnt = None if calibration is None else _load_calibration(Path(calibration))
    return DiagnosisOptions(excluded=tuple(dict.fromkeys(without)), tolerance_mN=tolerance, calibration=learnt)


def _load_calibration(path: Path) -> "VerdictCalibration":
    from pydantic import ValidationError

    from dragrig.analysis.gap import VerdictCalibration

    try:
        return VerdictCalibration.model_validate_json(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"calibration {path}: cannot be read ({error.strerror}); name another file.") from error
    except (UnicodeDecodeError, ValidationError) as error:
        raise SettingsError(
            f"calibration {path}: is not what dragrig gap calibrate --save writes; name such a file."
        ) from error


def save_amended_model(diagnosis: Diagnosis, path: Path, *, overwrite: bool = False) -> Path | None:
    """Write the amended model, which `gap_evaluate` loads, and of a friction model the simulator; None without any.

    Raises
    ------
    OutputError
        When the file exists, or the folder cannot be written.
    """
    return None if diagnosis.model is None else write_text(to_toml(diagnosis.model), path, overwrite=overwrite)


DEFAULT_MINUTES, MAX_RUNS = 20.0, 30


@dataclass(frozen=True, slots=True, eq=False)
class RunsToIsolate:
    """The runs of a campaign, or those that a plan would make."""

    selection: RunSelection
    nominal: CapsuleModel
    """The model that is expected."""
    source: str
    planned: bool
    """Whether the runs are yet to be made."""
    duration_s: float | None
    """Rig time, of a plan."""


def gap_isolability(
    plan_or_campaign: PlanLike,
    *,
    without: Sequence[str] = (),
    progress: Progress = no_progress,
    **choices: Unpack[SetupChoices],
) -> Isolability:
    """Determine which effects a plan (before any run) or a campaign can tell apart, and its detection limits.

    Parameters
    ----------
    plan_or_campaign
        A campaign's folder; or a plan by name or file, a `Plan`, or a protocol, whose runs are then simulated without
        any effect.
    without
        Effects of the catalogue to leave out.
    choices
        As of `check`: rig, specimen, model, capsule, assignments; of a campaign, `specimen` names one of several and
        `model` is the friction model.

    Raises
    ------
    AnalysisError
        When there is no usable run.
    SettingsError, PlanError, RunFileError
        When plan, campaign or settings cannot be used.

    Examples
    --------
    >>> import dragrig
    >>> result = dragrig.gap_isolability("paper")  # doctest: +SKIP
    >>> result.pair("stribeck", "adhesion").sin2  # doctest: +SKIP
    """
    from dragrig.analysis.gap import isolate

    diagnosis_options(without, None)
    collecting, isolating = parts_of(progress, COLLECTING_COST, ISOLATION_COST)
    runs = runs_to_isolate(plan_or_campaign, collecting, **choices)
    return isolate(
        runs.selection,
        runs.nominal,
        without,
        source=runs.source,
        planned=runs.planned,
        duration_s=runs.duration_s,
        progress=isolating,
    )


def runs_to_isolate(
    plan_or_campaign: PlanLike, progress: Progress = no_progress, **choices: Unpack[SetupChoices]
) -> RunsToIsolate:
    """Return the runs of a campaign, or simulate those of a plan; raises as `gap_isolability`."""
    choices["backend"] = "simulated"
    if isinstance(plan_or_campaign, str | Path) and Path(plan_or_campaign).is_dir():
        specimen = choices.get("specimen")
        selection = choose_runs(Path(plan_or_campaign), None if specimen is None else str(specimen), progress)
        model = resolve("drag", model=choices.get("model"), backend="simulated").model
        return RunsToIsolate(selection, CapsuleModel(model), str(plan_or_campaign), planned=False, duration_s=None)
    setup = resolve(plan_or_campaign, **choices)
    selection = choose_runs(simulate(plan_or_campaign, progress=progress, **choices))
    duration_s = setup.programme().duration_s
    return RunsToIsolate(selection, CapsuleModel(setup.model), setup.plan.name, planned=True, duration_s=duration_s)


def gap_next(
    plan_or_campaign: PlanLike,
    *,
    between: tuple[str, str] | None = None,
    minutes: float = DEFAULT_MINUTES,
    hands_min: float = DEFAULT_HANDS_MIN,
    progress: Progress = no_progress,
    **choices: Unpack[SetupChoices],
) -> NextExperiment | None:
    """Search for the runs that would separate the leading hypotheses best per minute of rig time.

    Parameters
    ----------
    plan_or_campaign
        A campaign's folder, which is diagnosed first; or a plan, whose runs are taken as made and whose most similar
        effects are to be separated.
    between
        Two effects to separate, at their default sizes, in place of the leading hypotheses.
    minutes
        Rig time available, rests and return strokes included.
    hands_min
        Minutes of a person at a change of fixture or capsule: the more, the more a run must tell that needs one.
    choices
        As of `check`; the rig's limits are kept.

    Returns
    -------
    None where no run would help.

    Raises
    ------
    AnalysisError
        When there is no usable run, or the runs do not show an effect at all.
    SettingsError, PlanError, RunFileError
        When plan, campaign or settings cannot be used.

    Examples
    --------
    >>> import dragrig
    >>> experiment = dragrig.gap_next("runs/first")  # doctest: +SKIP
    >>> experiment.reason, experiment.runs[0].settings  # doctest: +SKIP
    """
    from dragrig.analysis.gap import DiagnosisOptions, recommend_for_pair, require_hands
    from dragrig.analysis.gap.diagnose import diagnose

    require_minutes(minutes)
    require_hands(hands_min)
    if between is not None:
        _require_two_effects(between)
    limits = stage_range(resolve("drag", rig=choices.get("rig"), backend="simulated"))
    budget = ExperimentBudget(minutes, MAX_RUNS, limits, hands_min=hands_min)
    runs = runs_to_isolate(plan_or_campaign, **choices)
    if between is None and not runs.planned:
        return diagnose(runs.selection, runs.nominal, DiagnosisOptions(next_runs=budget), progress).next_experiment
    return recommend_for_pair(runs.selection, runs.nominal, between, budget)


def require_minutes(minutes: float) -> None:
    """Raise `SettingsError` for a value that is no rig time."""
    if not (isfinite(minutes) and minutes > 0):
        raise SettingsError(f"minutes {minutes:g}: a rig time is a number of minutes above 0.")


def save_next_plan(experiment: NextExperiment, path: Path, *, overwrite: bool = False) -> Path:
    """Write the runs as a plan file; raises `OutputError` when the file exists or cannot be written."""
    from dragrig.analysis.gap import plan_of_next_runs

    return write_text(to_toml(plan_of_next_runs(experiment)), path, overwrite=overwrite)


def stage_range(setup: Setup) -> RigLimits:
    """Return the range of a rig's stage, from its start on, within which further runs are looked for."""
    stage = setup.limits
    return RigLimits(stage.highest_mm - setup.rig.stage.start_mm, stage.speed_mm_s, stage.acceleration_mm_s2)


def _require_two_effects(between: tuple[str, str]) -> None:
    from dragrig.sim_backend.effects import catalogue

    known = [effect.id for effect in catalogue().values() if effect.has_force_signature]
    for name in between:
        if name not in known:
            raise SettingsError(
                f"between {name}: is no effect on the force that runs can show; {suggestion(name, known)}"
            )
    if between[0] == between[1]:
        raise SettingsError(f"between {between[0]} {between[1]}: name two effects that differ.")
