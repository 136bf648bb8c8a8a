"""Hidden campaigns judged anew from stored evidence, and one of them from its plant to its verdict.

Where the judging was changed and is as right or better, `python bench/replay.py judge` prints the numbers below and
writes the verdicts, to be looked at as a change of `judged.csv`. Where what is handed to the judging was changed, the
evidence is to be made anew with the command in its first line.
"""

import csv
import json
from pathlib import Path

import pytest

from dragrig.analysis.gap.features import VerdictCalibration, shipped_calibration
from dragrig.exam.examinee import BlindTask, diagnose_blind
from dragrig.exam.hidden_cases import CONDITIONS_OF, DRAWN_PLANT, WRITTEN_PLANT
from dragrig.present.numbers import to_json_value
from dragrig.scoring import ScoredDiagnosis
from dragrig.sim_backend.blind import CATALOGUE, write_campaign
from property_tests import thorough
from stored_evidence import (
    JUDGED,
    OUTCOME,
    StoredCampaign,
    counts,
    header_of,
    outcome,
    stored_campaigns,
    stored_lines,
    surprise,
)

COUNTS = {
    "all, right": (147, 160),
    "full size, right name": (46, 46),
    "full size, right name alone": (42, 46),
    "a third, right name": (14, 17),
    "a tenth, right name or no gap": (9, 11),
    "none, no gap": (10, 10),
    "outside, unknown": (12, 14),
    "outside, a name above 0.5": (2, 14),
    "pair, both named": (10, 14),
    "pair, one named": (11, 14),
    "rough, right name": (6, 6),
    "rough, none, no gap": (4, 4),
    "all, wrong above 0.8": (4, 160),
    "above 0.8, right": (124, 129),
    "incomplete, right name": (3, 4),
    "incomplete, none, no gap": (3, 3),
    "programme, right name": (3, 4),
    "programme, none, no gap": (2, 2),
    "exchanged, right name": (2, 2),
    "exchanged, none, no gap": (3, 3),
    "model off, right name": (5, 5),
    "model off, none, no gap": (4, 4),
    "noise, right name": (4, 4),
    "noise, none, no gap": (7, 7),
    "presence 0 to 0.1, there": (10, 4170),
    "presence 0.1 to 0.3, there": (2, 13),
    "presence 0.3 to 0.5, there": (2, 11),
    "presence 0.5 to 0.8, there": (7, 16),
    "presence 0.8 to 0.95, there": (24, 27),
    "presence 0.95 to 1, there": (83, 83),
}
"""Held and counted, of all campaigns."""
SURPRISE = 198.250
"""Minus the log of all probabilities that are stated of what is hidden."""
KINDS = {"full", "third", "tenth", "none", "outside", "pair", "rough"}
DIAGNOSED = ("drawn-0021", "drawn-0005", "drawn-0020", "written-0003", "drawn-0002", "drawn-0008", "written-0010")
"""Campaigns that are made and diagnosed anew: one of a single run, one of few, one whose likely causes are alike, …"""


@pytest.fixture(scope="module")
def campaigns() -> tuple[StoredCampaign, ...]:
    return stored_campaigns(stored_lines())


def test_as_many_verdicts_are_right_as_were(campaigns: tuple[StoredCampaign, ...]) -> None:
    assert counts([campaign.judged() for campaign in campaigns]) == COUNTS


def test_what_is_hidden_is_as_likely_as_it_was(campaigns: tuple[StoredCampaign, ...]) -> None:
    """It shows changes of any probability that do not change a verdict."""
    assert surprise([campaign.judged() for campaign in campaigns]) == pytest.approx(SURPRISE, abs=2e-3)


def test_each_campaign_has_the_verdict_that_it_had(campaigns: tuple[StoredCampaign, ...]) -> None:
    with JUDGED.open(encoding="utf-8", newline="") as file:
        columns, *expected = map(tuple, csv.reader(file))
    assert columns == OUTCOME
    assert [outcome(campaign.judged()) for campaign in campaigns] == expected


@pytest.mark.parametrize(
    ("part", "name", "factor"),
    [("gate", "least_gain", 1.25), ("weights", "further", 1.25), ("presence", "competition", 0.8)],
)
def test_what_was_learnt_otherwise_is_noticed(
    part: str, name: str, factor: float, campaigns: tuple[StoredCampaign, ...]
) -> None:
    """The numbers above are not those of any judging."""
    document = shipped_calibration().model_dump()
    changed = {**document, part: {**document[part], name: factor * document[part][name]}}
    judged = [campaign.judged(VerdictCalibration.model_validate(changed)) for campaign in campaigns]
    assert counts(judged) != COUNTS
    assert abs(surprise(judged) - SURPRISE) > 0.1


def test_the_stored_campaigns_are_those_of_their_seed_and_mixed(campaigns: tuple[StoredCampaign, ...]) -> None:
    header = header_of(stored_lines())
    assert header.seed not in shipped_calibration().seeds
    drawn = list(header.cases.items())[: len(campaigns)]
    assert [campaign.name for campaign in campaigns] == [name for name, _ in drawn]
    for campaign, (_, case) in zip(campaigns, drawn, strict=True):
        known = tuple(effect for effect in case.effects if effect in CATALOGUE)
        assert (campaign.answer.case, campaign.answer.effects) == (case.kind, known)
    for plant in (WRITTEN_PLANT, DRAWN_PLANT):
        assert {case.kind for _, case in drawn if case.plant == plant} >= KINDS
    assert len({case.effects[0] for _, case in drawn if case.single}) >= 20
    assert {case.kind.removesuffix(" none") for _, case in drawn if case.conditions} == set(CONDITIONS_OF) - {"motion"}


@pytest.mark.parametrize("name", [DIAGNOSED[0], *map(thorough, DIAGNOSED[1:])])
def test_a_campaign_from_its_plant_to_its_verdict(
    name: str, campaigns: tuple[StoredCampaign, ...], tmp_path: Path
) -> None:
    """The evidence is what is stored, and the verdict is what the stored evidence gives."""
    case = header_of(stored_lines()).cases[name]
    (stored,) = [campaign for campaign in campaigns if campaign.name == name]
    write_campaign(case.secret, tmp_path)
    said = json.loads(json.dumps(to_json_value(diagnose_blind(BlindTask(tmp_path)).json_or_failure())))
    judged = stored.judged()
    scored = ScoredDiagnosis.model_validate(said)
    assert (scored.verdict, scored.effects) == (judged.diagnosis.verdict, judged.diagnosis.effects)
    assert said["evidence"]["competition"] == pytest.approx(dict(stored.inputs.competition), abs=1e-3)
    assert dict(scored.presence) == pytest.approx(dict(judged.diagnosis.presence), abs=1e-3)
    assert len(said["evidence"]["tried"]) == len(stored.inputs.hypotheses)
    for made, kept in zip(said["evidence"]["tried"], stored.inputs.hypotheses, strict=True):
        assert tuple(made["effects"]) == kept.effects
        assert made["plain"] == pytest.approx(kept.chi2, rel=1e-3)
        assert made["gain"] == pytest.approx(kept.llr, rel=1e-2, abs=0.1)
