"""Campaigns of one rig together: in which an effect is, and that nothing is named where nothing is."""

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dragrig
from clusters import dask_cluster, tasks_finished, wait_for_workers
from diagnoses import BLANK
from dragrig.analysis import find_model
from dragrig.analysis.gap import DiagnosisOptions
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.pattern_odds import SharedInformation
from dragrig.analysis.gap.pooled_evidence import POOLED_SCALES_MN, ForceEvidence, SharedColumns
from dragrig.analysis.gap.presence import CauseKind
from dragrig.analysis.gap.run_data import choose_runs, without_runs
from dragrig.analysis.gap.together import CampaignEvidence, PooledDiagnosis, Where, campaign_evidence, diagnose_together
from dragrig.cli import main
from dragrig.config import AnalysisError, Plan
from dragrig.present import pooled_document
from dragrig.present.numbers import to_json_value
from dragrig.rig import mark_bad
from dragrig.sim_backend.effects import catalogue
from finishing import finished_here
from hidden import hidden
from places import CAMPAIGN, copied_runs
from property_tests import examples, thorough

BLOCKS = 60
EFFECTS = ("stribeck", "adhesion", "payload_inertia", "mesentery_tether", "force_nonlinearity")
"""The second is nearly the first; the third belongs to the rig and has nothing in common with the first."""


def signatures(random: np.random.Generator) -> Mapping[str, np.ndarray]:
    """Return two columns of each effect with an rms of 1 over 60 blocks; a specimen changes them by a tenth."""
    fixed = np.random.default_rng(5)
    columns = {name: fixed.standard_normal((BLOCKS, 2)) for name in EFFECTS}
    columns["adhesion"] = columns["stribeck"] + 0.3 * columns["adhesion"]
    basis = np.linalg.qr(columns["stribeck"])[0]
    columns["payload_inertia"] -= basis @ (basis.T @ columns["payload_inertia"])
    changed = {name: values + 0.1 * random.standard_normal(values.shape) for name, values in columns.items()}
    return {name: values / np.sqrt(np.mean(values**2, axis=0)) for name, values in changed.items()}


def campaign(seed: int, *, alone: Mapping[str, float] | None = None, **sizes_mN: float) -> CampaignEvidence:
    """Return the evidence of a campaign with effects of these sizes in noise of 1 mN."""
    random = np.random.default_rng(seed)
    columns = signatures(random)
    residual = random.standard_normal(BLOCKS)
    for name, size in sizes_mN.items():
        residual = residual + size * columns[name][:, 0]
    values = np.column_stack((residual, *columns.values()))
    shared = {
        name: SharedColumns(
            name=name,
            kind=CauseKind.EFFECT,
            numbers=np.arange(2),
            rows=1 + 2 * at + np.arange(2),
            form_rows=np.zeros(0, dtype=np.intp),
            sizes_mN=np.ones(2),
            one_signed=name not in {"mesentery_tether", "force_nonlinearity"},
            scales=POOLED_SCALES_MN,
            forms=(0.0,) * len(POOLED_SCALES_MN),
            chi2=float(residual @ residual),
        )
        for at, name in enumerate(columns)
    }
    presence = {**dict.fromkeys(EFFECTS, 0.01), **(alone or {})}
    named = tuple(name for name, value in presence.items() if value > 0.5)
    return CampaignEvidence(
        source=f"campaign-{seed}",
        specimen=f"specimen-{seed}",
        runs=8,
        verdict=Verdict.EFFECT if named else Verdict.NO_GAP,
        effects=named,
        probability=max(presence.values()),
        presence=presence,
        force=ForceEvidence((values.T @ values,), shared, dict.fromkeys(shared, 0)),
        line_sizes={},
    )


def named(pooled: PooledDiagnosis) -> list[str]:
    return [effect.effect for effect in pooled.established]


@given(
    seed=st.integers(0, 10_000),
    spread=st.sampled_from([0.0, 0.1, 0.6, 1.0]),
    members=st.sets(st.integers(0, 3), min_size=1),
)
@settings(max_examples=examples(40), deadline=None)
def test_evidence_of_some_campaigns_is_that_of_their_joint_gaussian(
    seed: int, spread: float, members: set[int]
) -> None:
    random = np.random.default_rng(seed)
    columns, data = random.standard_normal((4, 7, 2)), random.standard_normal((4, 7))
    variance = float(random.uniform(0.1, 5.0))
    pooled = SharedInformation.of(
        np.einsum("cnk,cnl->ckl", columns, columns),
        np.einsum("cnk,cn->ck", columns, data),
        np.zeros(4),
        variance,
        spread,
        None,
    )
    chosen = sorted(members)
    stacked = np.concatenate([columns[at] for at in chosen])
    covariance = (1 - spread) * variance * stacked @ stacked.T
    for place, at in enumerate(chosen):
        rows = slice(7 * place, 7 * place + 7)
        covariance[rows, rows] += spread * variance * columns[at] @ columns[at].T
    values = np.concatenate([data[at] for at in chosen])
    total = covariance + np.eye(values.size)
    expected = 0.5 * (values @ values - values @ np.linalg.solve(total, values) - np.linalg.slogdet(total)[1])
    assert pooled.of_members(np.isin(np.arange(4), chosen)) == pytest.approx(expected, abs=1e-8)


def test_an_effect_that_no_campaign_shows_alone_is_named_where_all_share_it() -> None:
    five = [campaign(seed, stribeck=0.45) for seed in range(5)]
    [effect] = diagnose_together(five).established
    assert effect.effect == "stribeck"
    assert effect.where is Where.ALL
    assert max(effect.alone) < 0.05
    assert not effect.of_rig
    weak = diagnose_together([five[0], *(campaign(seed) for seed in range(10, 14))])
    assert not named(weak)


def test_an_effect_of_the_rig_is_told_as_the_rigs() -> None:
    five = [campaign(seed, payload_inertia=0.8) for seed in range(5)]
    pooled = diagnose_together(five)
    [effect] = pooled.established
    assert (effect.effect, effect.where, effect.of_rig) == ("payload_inertia", Where.ALL, True)
    assert "the rig's, in all 5 campaigns" in pooled_document(pooled).answer
    assert effect.size is not None
    low, high = effect.size.interval_95
    assert low < 0.8 * 20.0 < high


def test_campaigns_of_one_specimen_are_not_told_as_so_many_specimens() -> None:
    apart = [campaign(seed, stribeck=2.0) for seed in range(3)]
    assert "Stribeck friction: in all 3 specimens" in pooled_document(diagnose_together(apart)).answer
    again = [replace(evidence, specimen="P7") for evidence in apart[:2]]
    assert "Stribeck friction: in all 3 campaigns" in pooled_document(diagnose_together([*again, apart[2]])).answer


def test_an_effect_in_one_specimen_is_told_as_that_specimens() -> None:
    five = [campaign(seed) for seed in range(4)]
    five.insert(2, campaign(9, alone={"stribeck": 0.97}, stribeck=6.0))
    pooled = diagnose_together(five)
    [effect] = pooled.established
    assert (effect.effect, effect.where, effect.members) == ("stribeck", Where.ONE, (2,))
    assert effect.probability == pytest.approx(0.97)
    assert np.argmax(effect.presence) == 2
    assert pooled_document(pooled).answer == "Stribeck friction: only in campaign-9 (probability 0.97)."


def test_an_effect_in_some_specimens_is_told_with_their_names() -> None:
    have = {0, 3, 4}
    five = [campaign(seed, **({"stribeck": 3.0} if seed in have else {})) for seed in range(6)]
    [effect] = diagnose_together(five).established
    assert effect.where is Where.SOME
    assert set(effect.members) == have


@pytest.mark.parametrize("seed", [100, *map(thorough, (200, 300))])
def test_campaigns_without_an_effect_name_nothing(seed: int) -> None:
    pooled = diagnose_together([campaign(seed + number) for number in range(8)])
    assert not named(pooled)
    # Eight campaigns without it say no less than one.
    assert max(effect.probability for effect in pooled.effects) < 0.2


def test_what_only_resembles_a_shared_effect_is_not_named_beside_it() -> None:
    pooled = diagnose_together([campaign(seed, stribeck=2.0) for seed in range(5)])
    assert named(pooled) == ["stribeck"]
    # The lookalike alone would be found in each of these campaigns.
    other = diagnose_together([campaign(seed, adhesion=2.0) for seed in range(5)])
    assert named(other) == ["adhesion"]


def test_what_one_campaign_takes_for_another_effect_is_explained_by_what_all_share() -> None:
    five = [campaign(seed, stribeck=1.0) for seed in range(4)]
    five.append(campaign(4, alone={"adhesion": 0.9}, stribeck=1.0))
    assert named(diagnose_together(five)) == ["stribeck"]


def test_what_is_positive_is_not_named_where_it_comes_out_negative() -> None:
    against = diagnose_together([campaign(seed, payload_inertia=-0.8) for seed in range(5)])
    assert "payload_inertia" not in named(against)
    [effect] = [effect for effect in against.effects if effect.effect == "payload_inertia"]
    assert effect.size is not None
    assert effect.size.interval_95[1] < 0


@pytest.mark.parametrize("effect", ["force_nonlinearity", thorough("mesentery_tether")])
def test_what_has_either_sign_is_no_effect_that_campaigns_share(effect: str) -> None:
    signs = (1.0, -1.0, 1.0, -1.0, 1.0)
    either = diagnose_together([campaign(seed, **{effect: 2.0 * sign}) for seed, sign in enumerate(signs)])
    assert effect not in named(either)
    same = diagnose_together([campaign(seed, **{effect: 2.0}) for seed in range(5)])
    assert named(same) == [effect]


def test_what_most_campaigns_name_by_themselves_is_in_all() -> None:
    alone = {"mesentery_tether": 0.8}
    five = [campaign(seed, alone=alone) for seed in range(5)]
    [effect] = diagnose_together(five).established
    assert (effect.effect, effect.where) == ("mesentery_tether", Where.ALL)
    assert effect.probability > 0.95


def test_small_effects_are_not_told_from_other_forms_of_a_large_one() -> None:
    pooled = diagnose_together([campaign(seed, stribeck=2.4, payload_inertia=0.35) for seed in range(5)])
    assert named(pooled) == ["stribeck"]
    assert set(named(diagnose_together([campaign(seed, stribeck=1.0, payload_inertia=0.35) for seed in range(5)]))) == {
        "stribeck",
        "payload_inertia",
    }
    alone = {"payload_inertia": 0.9, "stribeck": 0.99}
    shown = [campaign(seed, alone=alone, stribeck=2.4, payload_inertia=0.35) for seed in range(5)]
    where = {effect.effect: effect.where for effect in diagnose_together(shown).established}
    assert where == {"stribeck": Where.ALL, "payload_inertia": Where.ALL}


def test_where_the_stage_strays_pooling_names_what_a_campaign_shows_alone_and_says_so() -> None:
    straying = [campaign(seed, alone={"servo_lag": 0.98}, stribeck=1.0) for seed in range(5)]
    pooled = diagnose_together(straying)
    assert named(pooled) == ["servo_lag"]
    assert "the stage strays from its command (servo lag)" in pooled.remarks[-1]
    shown = campaign(9, alone={"servo_lag": 0.98, "stribeck": 0.8}, stribeck=1.0)
    assert set(named(diagnose_together([*straying, shown]))) == {"servo_lag", "stribeck"}
    assert named(diagnose_together([campaign(seed, stribeck=1.0) for seed in range(5)])) == ["stribeck"]


def test_a_stage_strays_too_where_only_all_campaigns_together_say_how() -> None:
    unsure = [campaign(seed, alone={"servo_lag": 0.44}, stribeck=1.0) for seed in range(5)]
    assert not any(found.effects for found in unsure)
    assert named(diagnose_together(unsure)) == ["servo_lag"]


def test_what_one_campaign_alone_says_of_its_stage_is_not_lowered_by_the_others() -> None:
    lagging = diagnose_together(
        [campaign(seed, alone={"servo_lag": 0.93 if seed == 2 else 0.003}) for seed in range(3)]
    )
    [effect] = lagging.established
    assert (effect.effect, effect.where, effect.members) == ("servo_lag", Where.ONE, (2,))
    assert effect.probability == pytest.approx(0.93)


def test_hum_that_no_campaign_counts_as_a_gap_is_the_rigs(tmp_path: Path) -> None:
    # A tenth of the catalogue's: 0.4 mN, whose rms is below the tolerance.
    model = find_model("capsule")
    selections = {seed: hidden(tmp_path / str(seed), seed, "mains_hum", size=0.1, every=6) for seed in (21, 22)}
    few = DiagnosisOptions(excluded=tuple(name for name in catalogue() if name not in {"mains_hum", "stribeck"}))
    humming = [campaign_evidence(str(seed), selection, model, few) for seed, selection in selections.items()]
    assert [found.verdict for found in humming] == [Verdict.NO_GAP] * 2
    pooled = diagnose_together(humming)
    assert [(effect.effect, effect.where) for effect in pooled.established] == [("mains_hum", Where.ALL)]
    assert pooled.remarks == ("mains hum is no gap of any campaign alone: below the tolerance there, or not sure",)
    size = pooled.established[0].size
    assert size is not None
    assert size.mean == pytest.approx(0.4, rel=0.25)
    quiet = [replace(found, hum_log_odds=-6.0) for found in humming]
    assert (named(diagnose_together(quiet)), diagnose_together(quiet).remarks) == ([], ())
    without = DiagnosisOptions(excluded=(*few.excluded, "mains_hum"))
    unasked = campaign_evidence(
        "21", replace(selections[21], experiments=selections[21].experiments[:6]), model, without
    )
    assert (unasked.hum_log_odds, dict(unasked.line_sizes)) == (-np.inf, {})


def test_the_same_run_in_two_folders_counts_once(tmp_path: Path) -> None:
    shutil.copytree(CAMPAIGN, tmp_path / "first")
    shutil.copytree(CAMPAIGN, tmp_path / "copy")
    folders: Sequence[Path] = [tmp_path / "first", tmp_path / "copy"]
    with pytest.raises(AnalysisError, match=r"left out: all runs of .*copy are in .*first too, and a run counts once"):
        dragrig.gap_diagnose_together(folders, workers=1)
    selection = choose_runs(tmp_path / "copy")
    [first, *others] = selection.experiments
    kept = without_runs(selection, {first.run.info.header.run_id: "first"})
    assert kept.experiments == tuple(others)
    assert kept.left_out[-1].reason == "it is in first too, and counts there"


def test_a_single_campaign_and_a_file_for_one_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gap", "diagnose", str(CAMPAIGN), "--together"]) == 2
    assert "together: takes two campaigns or more" in capsys.readouterr().err
    assert main(["gap", "diagnose", str(CAMPAIGN), str(CAMPAIGN), "--together", "--save-model", "one.toml"]) == 2
    assert "takes a single campaign, not 2" in capsys.readouterr().err


def test_the_result_is_laid_out_for_programs_too() -> None:
    pooled = diagnose_together([campaign(seed, stribeck=2.0) for seed in range(3)], ["a remark"])
    data = json.loads(json.dumps(to_json_value(pooled_document(pooled).data)))
    assert data["format"] == "dragrig-gap-together"
    [effect] = [entry for entry in data["effects"] if entry["established"]]
    assert (effect["effect"], effect["where"]) == ("stribeck", "all")
    assert effect["campaigns"] == ["campaign-0", "campaign-1", "campaign-2"]
    assert len(effect["size"]["campaigns"]) == 3
    assert data["remarks"] == ["a remark"]


CONSIDERED = {"stribeck", "adhesion", "payload_inertia"}
"""What is in the lab's gut, what resembles it, and an effect of the rig: all would take four times as long."""
RATIO = 0.8
FOLDERS = ("first", "second", "copied", "spoilt")
TOGETHER = (
    *("gap", "diagnose", *FOLDERS, "--together"),
    *(word for name in catalogue() if name not in CONSIDERED for word in ("--without", name)),
)


@dataclass(frozen=True)
class Lab:
    """A folder of campaigns, what processes said of them together, and the page and the picture that they made."""

    folder: Path
    told: str
    page: str
    picture: bytes


def make_campaign(folder: Path, seed: int, *speeds_mm_s: float) -> None:
    """Simulate four runs on a specimen drawn by the seed, whose friction falls with speed."""
    steps = [
        {"kind": "relaxation", "shear_strain": 1.0, "hold_s": 10.0, "wait_s": 5.0},
        {"kind": "drag", "speed_mm_s": list(speeds_mm_s), "travel_mm": 20.0, "wait_s": 10.0},
    ]
    dragrig.simulate(
        Plan.model_validate({"name": "few", "steps": steps}),
        out=folder,
        effects=[f"stribeck:ratio={RATIO}"],
        assignments=[*(f"specimen.id=P{seed}", f"rig.simulated.seed={seed}"), "rig.simulated.variation.specimen=true"],
    )


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """Two campaigns on a specimen, a copy, and one without a good run.

    Somebody copied a run of the first campaign into the second.
    """
    folder = tmp_path_factory.mktemp("lab")
    with chdir(folder), finished_here(), redirect_stdout(StringIO()) as told, pytest.MonkeyPatch.context() as patch:
        patch.setattr("dragrig.present.files.svg_text", lambda _: BLANK)
        make_campaign(folder / "first", 2, 20.0, 5.0, 60.0)
        make_campaign(folder / "second", 2, 30.0, 4.0, 50.0)
        shutil.copy(next((folder / "first").glob("*relaxation*")), folder / "second" / "again.h5")
        shutil.copytree("first", "copied")
        mark_bad(copied_runs(folder / "spoilt", "010-drag.h5") / "010-drag.h5", "slipped")
        files = ("--report", "page.html", "--figures", "figures")
        assert main([*TOGETHER, "--json", "--quiet", "--workers", "1", *files]) == 0
    page, [picture] = folder / "page.html", (folder / "figures").iterdir()
    return Lab(folder, told.getvalue(), page.read_text("utf-8"), picture.read_bytes())


def test_a_strong_effect_of_several_campaigns_is_named_from_their_run_files(lab: Lab) -> None:
    told = json.loads(lab.told)
    [effect] = [effect for effect in told["effects"] if effect["established"]]
    assert (effect["effect"], effect["where"], effect["belongs_to"]) == ("stribeck", "all", "gut")
    assert effect["campaigns"] == ["first", "second"]
    assert effect["probability"] > 0.99 > max(effect["presence_alone"])
    low, high = effect["size"]["interval_95"]
    assert low < RATIO < high
    assert min(value["value"] for value in effect["size"]["campaigns"]) > 0.5 * RATIO


def test_page_and_picture_say_what_is_in_all_campaigns(lab: Lab) -> None:
    assert "Stribeck friction: in all 2 campaigns" in lab.page
    assert "all runs of copied are in first too" in lab.page
    assert "Filled points have the effect." in lab.page
    assert lab.picture.startswith(b"\x89PNG")


def test_runs_and_campaigns_that_do_not_count_are_told_beside_those_that_do(lab: Lab) -> None:
    told = json.loads(lab.told)
    assert [(campaign["source"], campaign["specimen"], campaign["runs"]) for campaign in told["campaigns"]] == [
        *(("first", "P2", 4), ("second", "P2", 4))
    ]
    assert {"what": "again.h5", "reason": "it is in first too, and counts there"} in told["campaigns"][1]["left_out"]
    again, copied, spoilt = told["remarks"]
    assert again == "1 run of second also in first counted there alone"
    assert copied == "left out: all runs of copied are in first too, and a run counts once"
    assert spoilt.startswith("not diagnosed: spoilt: no run can be used")
    assert "slipped" in spoilt


@pytest.mark.thorough
def test_a_cluster_says_the_same_of_campaigns_together(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    with dask_cluster() as address, chdir(lab.folder):
        wait_for_workers(address, 2)
        with tasks_finished(address) as keys:
            assert main([*TOGETHER, "--json", "--quiet", "--scheduler", address]) == 0
    # Each folder is looked into, and each but the copy diagnosed.
    assert len(set(keys)) == 2 * len(FOLDERS) - 1
    assert capsys.readouterr().out == lab.told


def test_campaigns_of_different_force_sensors_are_refused(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, serial in (("monday", "S-17"), ("tuesday", "unknown"), ("friday", "S-18")):
        Path(name).mkdir()
        path = shutil.copy(next((lab.folder / "first").glob("*relaxation*")), name)
        with h5py.File(path, "r+") as file:
            file["entry/run"].attrs["sensor_serial"] = serial
    assert main(["gap", "diagnose", "monday", "tuesday", "friday", "--together", "--workers", "1"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "they name different force sensors: monday (S-17), friday (S-18); pool those of one" in said.err
    # What states no serial number is not of another sensor.
    assert main(["gap", "diagnose", "monday", "tuesday", "--together", "--quiet", "--workers", "1"]) == 2
    assert "fewer than two campaigns are left to pool: left out: all runs of tuesday" in capsys.readouterr().err
