"""Specimens of one rig together: the spread that they were drawn with is found, and none is where there is none."""

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np
import numpy.typing as npt
import pytest

from dragrig.analysis import Identification, JointFit, ParameterEstimate, SpecimenFit, pool_specimens
from dragrig.analysis.identification.population import Population, PopulationParameter
from dragrig.analysis.linear_gaussian import PriorScales
from dragrig.analysis.models.nominal_model import Parameter
from dragrig.cli import main
from dragrig.config import AnalysisError
from places import CAMPAIGN

FloatArray = npt.NDArray[np.float64]

PARAMETERS = (
    Parameter("stiffness", "1", 2.0, 0.15),
    Parameter("friction", "1", 0.12, 0.12),
    Parameter("angle", "deg", 0.0, 0.7, positive=False),
    Parameter("gain", "1", 1.0, 0.01, of_rig=True),
)
SCALES = PriorScales.of(PARAMETERS)


def fit_of(
    name: str, z: FloatArray, information: FloatArray, random: np.random.Generator, rig: str = "r"
) -> SpecimenFit:
    """Return the fit of runs that hold this information on a specimen's parameters, drawn with their error."""
    seen = information @ z + np.linalg.cholesky(information) @ random.standard_normal(z.size)
    covariance = np.linalg.inv(information + np.eye(z.size))
    mean, sd = covariance @ seen, np.sqrt(np.diag(covariance))
    values = SCALES.values(mean)
    errors = SCALES.slopes(values) * sd
    estimates = tuple(
        ParameterEstimate(
            parameter.name, parameter.unit, float(value), float(error), (0.0, 0.0), learnt=1 - float(sd[place])
        )
        for place, (parameter, value, error) in enumerate(zip(PARAMETERS, values, errors, strict=True))
    )
    joint = JointFit("test", estimates, (), covariance / np.outer(sd, sd), (), 1.0, 1, 0.5, converged=True, steps=1)
    return SpecimenFit(name, name, Identification(name, ("r.h5",), (), joint, None, None, None), rig)


def information(random: np.random.Generator, size: float = 60.0) -> FloatArray:
    """Return what runs tell: stiffness and gain nearly only as their product, as the force shows them."""
    together = np.array([1.0, 0.3, 0.0, 0.07])
    rest = np.diag([0.3, 1.0, 0.5, 0.02])
    return size * random.uniform(0.5, 2.0) * (np.outer(together, together) + rest)


def drawn(
    random: np.random.Generator, spread: FloatArray, count: int, mean: Sequence[float] = (0.5, -1.0, 0.3, 0.8)
) -> tuple[Population, FloatArray, FloatArray]:
    """Return a population of specimens with this spread in prior units, its means, and a further specimen."""
    means = np.array(mean)
    specimens = means + spread * random.standard_normal((count + 1, means.size))
    fits = [fit_of(f"s{place}", z, information(random), random) for place, z in enumerate(specimens[:-1])]
    return pool_specimens(fits, PARAMETERS), SCALES.values(means), SCALES.values(specimens[-1])


FEW_RUNS = ("001-relaxation.h5", "008-coulomb.h5", "010-drag.h5", "018-drag.h5")


def specimen_like(folder: Path, name: str, sensor: str) -> Path:
    """Return a campaign with the runs of the one for tests, of a specimen with this id, by a sensor with this one."""
    campaign = folder / name
    campaign.mkdir()
    for run in FEW_RUNS:
        path = Path(shutil.copy(CAMPAIGN / run, campaign))
        with h5py.File(path, "r+") as file:
            file["entry/specimen"].attrs["id"] = name
            attributes = file["entry/run"] if "entry/run" in file else file["entry"]
            attributes.attrs["run_id"] = str(uuid4())
            attributes.attrs["sensor_serial"] = sensor
    return campaign


def test_the_command_tells_a_population_and_counts_a_copied_campaign_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, sensor in (("p1", "S-17"), ("p2", "unknown"), ("p3", "S-18")):
        specimen_like(tmp_path, name, sensor)
    shutil.copytree("p1", "copied")
    words = ["identify", "p1", "p2", "p3", "copied", "--together", "--workers", "1"]
    assert main([*words, "--json", "--quiet", "--report", "r.html"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["specimens"] == ["p1", "p2", "p3"]
    assert "counts once" in json.dumps(told["left_out"])
    assert "several sensors (S-17, S-18)" in json.dumps(told["remarks"])
    friction = told["parameters"]["friction_coefficient"]
    assert not friction["spreads"]
    assert friction["spread"]["interval_95"][0] == 0
    low, high = friction["next_specimen_95"]
    own = friction["specimens"][0]["own"]
    assert low < own["value"] < high
    # The runs of all three are the same, and so are their Coulomb tests.
    coulomb = told["parameters"]["mu"]
    assert coulomb["mean"]["value"] == pytest.approx(coulomb["specimens"][2]["own"]["value"])
    gain = told["parameters"]["force_gain"]
    assert (gain["of_rig"], gain["spread"]) == (True, None)
    page = Path("r.html").read_text("utf-8")
    assert "no spread beyond error" in page
    assert "next specimen" in page
    assert main([*words, "--save-model", "m.toml"]) == 2
    assert "has no model of its own" in capsys.readouterr().err
    assert main(["identify", "p1", "copied", "--together", "--workers", "1", "--quiet"]) == 2
    assert "1 specimen of 1 campaign can be used" in capsys.readouterr().err


def named(population: Population, name: str) -> PopulationParameter:
    return next(parameter for parameter in population.parameters if parameter.name == name)


def test_intervals_hold_what_specimens_were_drawn_with() -> None:
    random = np.random.default_rng(20260504)
    spread = np.array([1.0, 0.6, 0.8, 0.0])
    held = {"mean": 0, "spread": 0, "next": 0}
    errors: list[float] = []
    populations = 14
    for _ in range(populations):
        population, means, following = drawn(random, spread, 8)
        slopes = SCALES.slopes(means)
        for place, parameter in enumerate(population.parameters[:3]):
            assert parameter.spread is not None
            assert parameter.next_specimen is not None
            low, high = parameter.mean.interval
            held["mean"] += low < means[place] < high
            low, high = parameter.spread.interval
            held["spread"] += low < spread[place] * slopes[place] < high
            held["next"] += parameter.next_specimen[0] < following[place] < parameter.next_specimen[1]
            errors.append(parameter.spread.value / (spread[place] * slopes[place]) - 1)
    for what, count in held.items():
        # Of 42 intervals with 95 % each, fewer than 36 hold with a probability of 0.5 %.
        assert count >= 36, (what, count)
    assert abs(float(np.mean(errors))) < 0.2


def test_the_rigs_gain_is_one_for_all_and_better_known_than_by_any_campaign() -> None:
    random = np.random.default_rng(1)
    population, means, _ = drawn(random, np.array([0.5, 0.5, 0.5, 0.0]), 12)
    gain = named(population, "gain")
    assert (gain.spread, gain.next_specimen) == (None, None)
    assert gain.mean.interval[0] < means[3] < gain.mean.interval[1]
    assert gain.mean.standard_error < 0.6 * min(value.own.standard_error for value in gain.specimens if value.own)
    assert {value.pooled.value for value in gain.specimens} == {gain.specimens[0].pooled.value}
    assert not [remark for remark in population.remarks if "gain" in remark]


def test_a_gain_that_differs_between_campaigns_is_told() -> None:
    population, *_ = drawn(np.random.default_rng(2), np.array([0.1, 0.1, 0.1, 5.0]), 12)
    assert any("gain is the rig's, yet differs" in remark for remark in population.remarks)


def test_without_a_spread_none_is_told_in_most_cases() -> None:
    random = np.random.default_rng(3)
    told = [
        parameter.spreads
        for _ in range(8)
        for parameter in drawn(random, np.zeros(4), 6)[0].parameters
        if not parameter.of_rig
    ]
    assert np.sum(told) <= 3


def test_specimens_are_drawn_towards_the_mean_the_more_the_less_is_known_of_them() -> None:
    random = np.random.default_rng(4)
    spread = np.array([0.4, 0.4, 0.4, 0.0])
    true = spread * random.standard_normal((10, 4))
    sizes = [200.0] * 5 + [3.0] * 5
    fits = [
        fit_of(f"s{place}", z, information(random, size), random)
        for place, (z, size) in enumerate(zip(true, sizes, strict=True))
    ]
    friction = named(pool_specimens(fits, PARAMETERS), "friction")
    moved = [
        abs(value.own.value - value.pooled.value) / value.own.standard_error if value.own else 1.0
        for value in friction.specimens
    ]
    assert np.mean(moved[:5]) < np.mean(moved[5:])
    errors = [value.pooled.value - SCALES.values(z)[1] for value, z in zip(friction.specimens, true, strict=True)]
    sds = [value.pooled.standard_error for value in friction.specimens]
    assert float(np.max(np.abs(np.array(errors) / np.array(sds)))) < 3.5


def test_two_campaigns_of_one_specimen_are_one_specimen() -> None:
    random = np.random.default_rng(5)
    fits = [fit_of(name, random.standard_normal(4), information(random), random) for name in "abcd"]
    again = dataclasses.replace(fits[0], source="again")
    population = pool_specimens([*fits, again], PARAMETERS)
    assert population.specimens == ("a", "b", "c", "d")
    assert "5 campaigns are of 4 specimens" in population.remarks[0]


def test_what_cannot_be_pooled_is_refused_or_left_out() -> None:
    random = np.random.default_rng(6)
    fits = [fit_of(name, np.zeros(4), information(random), random) for name in "ab"]
    with pytest.raises(AnalysisError, match="1 specimen of 1 campaign"):
        pool_specimens(fits[:1], PARAMETERS)
    with pytest.raises(AnalysisError, match=r"several rigs \(r: a; s: c\)"):
        pool_specimens([fits[0], fit_of("c", np.zeros(4), information(random), random, "s")], PARAMETERS)
    failed = dataclasses.replace(
        fits[0], source="c", identification=Identification("c", (), (), None, None, None, None)
    )
    population = pool_specimens([*fits, failed], PARAMETERS)
    assert [(exclusion.item, exclusion.reason) for exclusion in population.left_out] == [("c", "there is no joint fit")]
    assert named(population, "friction").spread is None
    assert "2 specimens do not bound" in population.remarks[0]


def test_the_prior_counts_once_however_many_campaigns_say_little() -> None:
    random = np.random.default_rng(7)
    fits = [fit_of(f"s{place}", np.full(4, 2.0), information(random, 1.0), random) for place in range(40)]
    friction = named(pool_specimens(fits, PARAMETERS), "friction")
    assert friction.mean.value == pytest.approx(SCALES.values(np.full(4, 2.0))[1], rel=0.05)
