"""Specimens of one rig together: the spread that they were drawn with is found, and none is where there is none."""

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2, multivariate_normal, norm

from diagnoses import BLANK
from dragrig.analysis import Exclusion, Identification, JointFit, ParameterEstimate, SpecimenFit, pool_specimens
from dragrig.analysis.identification.population import Likelihoods, Population, PopulationParameter
from dragrig.analysis.linear_gaussian import PriorScales
from dragrig.analysis.models.nominal_model import Parameter
from dragrig.cli import main
from dragrig.config import AnalysisError
from dragrig.present import population_document, population_figure
from dragrig.present.numbers import to_json_value
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


FEW_RUNS = ("008-coulomb.h5", "010-drag.h5")


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
    monkeypatch.setattr("dragrig.present.files.svg_text", lambda _: BLANK)
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
    assert "n = 2: no interval of the mean" in population.remarks[0]


def test_of_two_specimens_it_is_said_that_they_differ_and_no_mean_has_an_interval() -> None:
    (parameter,) = ALONE_POSITIVE
    fits = [single_fit("a", 0.4, 0.05, parameter), single_fit("b", -0.9, 0.05, parameter)]
    simulated = dataclasses.replace(fits[0].identification, backends=("simulated",))
    population = pool_specimens([dataclasses.replace(fits[0], identification=simulated), fits[1]], ALONE_POSITIVE)
    (stiffness,) = population.parameters
    assert stiffness.spreads
    assert not np.isfinite([stiffness.mean.standard_error, *stiffness.mean.interval]).any()
    assert [value.pooled for value in stiffness.specimens] == [value.own for value in stiffness.specimens]
    page = population_document(population)
    assert page.answer.startswith("The 2 specimens differ, and have no mean (n = 2): stiffness 2.12")
    assert "(p < 0.0001)" in page.answer
    assert page.badges == ("simulated",)
    told = json.loads(json.dumps(to_json_value(page.data), allow_nan=False))["parameters"]["stiffness"]
    assert told["mean"]["interval_95"] in (None, [None, None])
    assert [label.get_text() for label in population_figure(population).axes[0].get_yticklabels()] == ["a", "b"]
    alike = pool_specimens([single_fit(name, 0.4, 0.05, parameter) for name in "ab"], ALONE_POSITIVE)
    assert (
        population_document(alike).answer == "The 2 specimens agree within their errors in all of 1 parameter (n = 2)."
    )


def test_the_prior_counts_once_however_many_campaigns_say_little() -> None:
    random = np.random.default_rng(7)
    fits = [fit_of(f"s{place}", np.full(4, 2.0), information(random, 1.0), random) for place in range(40)]
    friction = named(pool_specimens(fits, PARAMETERS), "friction")
    assert friction.mean.value == pytest.approx(SCALES.values(np.full(4, 2.0))[1], rel=0.05)


# The likelihood and its integrals, against dense matrices and another implementation of one parameter


def test_deviations_integrated_out_are_those_of_one_dense_gaussian() -> None:
    random = np.random.default_rng(11)
    count, size = 3, 2
    roots = random.normal(size=(count, size, size))
    matrices, vectors = roots @ np.swapaxes(roots, 1, 2) + np.eye(size), random.normal(size=(count, size))
    prior_sd, spread = np.array([1.0, 2.5]), np.array([0.7, 1.4])
    found = Likelihoods(matrices, vectors, prior_sd)
    # The unknowns are the means and each specimen's deviations from them.
    precision = np.zeros((size * (count + 1), size * (count + 1)))
    seen = np.zeros(len(precision))
    precision[:size, :size] = np.diag(prior_sd**-2.0)
    for number in range(count):
        own = slice(size * (number + 1), size * (number + 2))
        for rows, columns in ((slice(size), slice(size)), (slice(size), own), (own, slice(size)), (own, own)):
            precision[rows, columns] += matrices[number]
        precision[own, own] += np.diag(spread**-2.0)
        seen[:size] += vectors[number]
        seen[own] += vectors[number]
    covariance = np.linalg.inv(precision)
    at = covariance @ seen
    mean, of_mean = found.mean(spread)
    np.testing.assert_allclose(mean, at[:size])
    np.testing.assert_allclose(of_mean, covariance[:size, :size])
    values, sds = found.specimens(spread)
    for number in range(count):
        own = slice(size * (number + 1), size * (number + 2))
        total = covariance[:size, :size] + covariance[own, own] + covariance[:size, own] + covariance[own, :size]
        np.testing.assert_allclose(values[number], at[:size] + at[own])
        np.testing.assert_allclose(sds[number], np.sqrt(np.diag(total)))
    log_determinant = np.linalg.slogdet(precision)[1] + 2 * count * np.log(spread).sum()
    assert found.log_likelihood(spread) == pytest.approx(0.5 * (seen @ at - log_determinant))
    np.testing.assert_allclose(found.informed, matrices.sum(axis=0).diagonal())


ALONE = (Parameter("angle", "deg", 0.0, 0.7, positive=False, meaning="of the capsule"),)
ALONE_POSITIVE = (Parameter("stiffness", "1", 2.0, 0.15),)
GRID = np.concatenate(([0.0], np.geomspace(0.01, 6.0, 50)))


def single_fit(name: str, z: float, sd: float, parameter: Parameter, learnt: float = 0.9) -> SpecimenFit:
    """Return a fit whose runs alone say `z` with this error, in prior units; the prior is joined to it."""
    scales = PriorScales.of((parameter,))
    variance = 1 / (1 / sd**2 + 1)
    mean = variance * z / sd**2
    value = float(scales.values(np.array([mean]))[0])
    error = float(scales.slopes(np.array([value]))[0] * np.sqrt(variance))
    estimate = ParameterEstimate(parameter.name, parameter.unit, value, error, (0.0, 0.0), learnt=learnt)
    joint = JointFit("test", (estimate,), (), np.eye(1), (), 1.0, 1, 0.5, converged=True, steps=1)
    return SpecimenFit(name, name, Identification(name, ("r.h5",), (), joint, None, None, None), "r")


def mixture_quantile(probability: float, weights: FloatArray, means: FloatArray, sds: FloatArray) -> float:
    return float(brentq(lambda value: weights @ norm.cdf((value - means) / sds) - probability, -60.0, 60.0))


@pytest.mark.parametrize("parameters", [ALONE, ALONE_POSITIVE], ids=["normal", "lognormal"])
@pytest.mark.parametrize(
    "seen", [(0.9, -0.4, 1.8, 0.2, -1.1), (0.5, 0.52, 0.49, 0.51), (3.0, 2.0, 4.5)], ids=["spread", "alike", "few"]
)
def test_one_parameter_is_pooled_as_another_implementation_does(
    seen: Sequence[float], parameters: tuple[Parameter, ...]
) -> None:
    (parameter,), scales = parameters, PriorScales.of(parameters)
    errors = np.linspace(0.2, 0.5, len(seen))
    fits = [single_fit(f"s{place}", z, sd, parameter) for place, (z, sd) in enumerate(zip(seen, errors, strict=True))]
    (found,) = pool_specimens(fits, parameters).parameters
    y = np.array(seen)

    def log_likelihood(spread: float) -> float:
        return float(multivariate_normal(np.zeros(y.size), np.diag(errors**2 + spread**2) + 1.0).logpdf(y))

    def mean_of(spread: float) -> tuple[float, float]:
        precision = 1.0 + np.sum(1 / (errors**2 + spread**2))
        return float(np.sum(y / (errors**2 + spread**2)) / precision), float(precision**-0.5)

    def value(z: float) -> float:
        return float(scales.values(np.array([z]))[0])

    likelihoods = np.array([log_likelihood(spread) for spread in GRID])
    weights = np.exp(likelihoods - likelihoods.max()) * np.gradient(GRID)
    weights /= weights.sum()
    means, sds = np.array([mean_of(spread) for spread in GRID]).T
    low, middle, high = (mixture_quantile(share, weights, means, sds) for share in (0.025, 0.5, 0.975))
    assert found.mean.value == pytest.approx(value(middle), rel=1e-6, abs=1e-6)
    assert found.mean.interval == pytest.approx((value(low), value(high)), rel=1e-6, abs=1e-6)
    slope = float(scales.slopes(np.array([found.mean.value]))[0])
    assert found.mean.standard_error == pytest.approx(slope * (high - low) / (2 * 1.959964), rel=1e-5)
    assert (found.name, found.unit, found.meaning) == (parameter.name, parameter.unit, parameter.meaning)
    assert (found.of_rig, found.determined) == (False, (high - low) / (2 * 1.959964) < 0.9)
    wide = np.hypot(sds, GRID)
    assert found.next_specimen == pytest.approx(
        (value(mixture_quantile(0.025, weights, means, wide)), value(mixture_quantile(0.975, weights, means, wide))),
        rel=1e-6, abs=1e-6,
    )  # fmt: skip
    best = float(minimize_scalar(lambda spread: -log_likelihood(spread), bounds=(0.0, 6.0), method="bounded").x)
    best = 0.0 if log_likelihood(0.0) >= log_likelihood(best) else best
    assert found.spread is not None
    assert found.spread.value == pytest.approx(slope * best, abs=2e-3 * slope)
    average = float(weights @ GRID)
    assert found.spread.standard_error == pytest.approx(slope * np.sqrt(weights @ (GRID - average) ** 2), rel=1e-5)
    order = np.argsort(weights / np.gradient(GRID))[::-1]
    inside = order[: int(np.argmax(np.cumsum(weights[order]) >= 0.95)) + 1]
    assert found.spread.interval == pytest.approx(
        (slope * min(GRID[inside].min(), best), slope * max(GRID[inside].max(), best)), rel=1e-5, abs=1e-6
    )
    gained = 2 * (likelihoods.max() - likelihoods[0])
    assert found.spread_p == pytest.approx(0.5 * chi2.sf(gained, 1) if gained > 1e-6 else 1.0)
    assert found.spreads is (found.spread_p < 0.05)
    at, own_sd = mean_of(best)
    for z, error, told in zip(seen, errors, found.specimens, strict=True):
        share = best**2 / (best**2 + error**2)
        pooled, sd = at + share * (z - at), np.hypot(np.sqrt(share) * error, (1 - share) * own_sd)
        assert told.pooled.value == pytest.approx(value(pooled), rel=2e-3, abs=2e-3)
        ends = (value(pooled - 1.959964 * sd), value(pooled + 1.959964 * sd))
        assert told.pooled.interval == pytest.approx(ends, rel=3e-3, abs=3e-3)
        assert told.own is not None


def test_what_runs_do_not_determine_is_not_shown_as_their_own() -> None:
    fits = [single_fit(name, 0.1, sd, ALONE[0], learnt) for name, sd, learnt in
            (("a", 9.0, 0.05), ("b", 9.0, 0.1), ("c", 9.0, 0.02))]  # fmt: skip
    (found,) = pool_specimens(fits, ALONE).parameters
    assert [value.own is not None for value in found.specimens] == [False, True, False]
    assert found.determined is False


def test_of_a_specimens_campaigns_the_one_that_knows_it_best_is_shown() -> None:
    fits = [single_fit(name, z, sd, ALONE[0]) for name, z, sd in
            (("a", 0.1, 0.5), ("b", 0.2, 0.4), ("c", 0.3, 0.4), ("a", 0.9, 0.1), ("b", 0.8, 0.9))]  # fmt: skip
    population = pool_specimens(fits, ALONE)
    (found,) = population.parameters
    owns = [value.own.value for value in found.specimens if value.own]
    best = [fits[3], fits[1], fits[2]]
    assert owns == [fit.identification.joint.parameters[0].value for fit in best if fit.identification.joint]
    assert population.campaigns == ("a", "b", "c", "a", "b")
    assert population.remarks == ("5 campaigns are of 3 specimens; what those of one specimen say is joined",)


def test_a_population_says_word_for_word_what_a_reader_has_to_know() -> None:
    few = [dataclasses.replace(single_fit(name, 0.1, 0.3, ALONE[0]), sensor=sensor) for name, sensor in
           (("a", "1"), ("b", "2"))]  # fmt: skip
    population = pool_specimens(few, ALONE, [Exclusion("d", "empty")])
    assert population.remarks == (
        "n = 2: no interval of the mean, for the spread between specimens is not known",
        "the force was measured with several sensors (1, 2), and force_gain is fitted as that of one",
    )
    assert population.left_out == (Exclusion("d", "empty"),)
    assert population.nominal == "test"
    (found,) = population.parameters
    assert (found.spread, found.spread_p, found.next_specimen) == (None, 1.0, None)
    assert found.spreads is False
    bad = dataclasses.replace(
        few[0].identification,
        joint=dataclasses.replace(few[0].identification.joint, p_value=1e-9),  # type: ignore[type-var]
    )
    stray = dataclasses.replace(few[0], source="c", specimen="c", identification=bad)
    assert pool_specimens([few[1], stray, dataclasses.replace(few[1], specimen="d")], ALONE).remarks[-1] == (
        "the model leaves more than noise in c: their parameters absorb some of an effect that it does not contain; "
        "dragrig gap diagnose says which"
    )
    apart = dataclasses.replace(
        few[0].identification,
        joint=dataclasses.replace(few[0].identification.joint, converged=False),  # type: ignore[type-var]
    )
    lost = dataclasses.replace(few[0], source="c", identification=apart)
    with pytest.raises(AnalysisError) as caught:
        pool_specimens([few[1], lost], ALONE)
    assert str(caught.value) == (
        "1 specimen of 2 campaigns can be used; a population needs at least two: runs of the same specimen id count as "
        "one specimen."
    )
    assert pool_specimens([*few, lost], ALONE).left_out == (Exclusion("c", "its joint fit did not converge"),)
    with pytest.raises(AnalysisError) as caught:
        pool_specimens([few[0], dataclasses.replace(few[1], rig="s"), dataclasses.replace(few[1], rig="")], ALONE)
    assert str(caught.value) == (
        "the campaigns are of several rigs (r: a; s: b); what is of a rig cannot be one set for all."
    )


def test_means_that_only_show_as_a_product_are_told() -> None:
    """Of two parameters of which the runs show the sum, in prior units, the means are nearly opposite."""
    pair = (ALONE_POSITIVE[0], Parameter("friction", "1", 0.12, 0.12))
    scales, fits = PriorScales.of(pair), []
    for place in range(4):
        covariance = np.linalg.inv(np.eye(2) + 400.0 * np.ones((2, 2)))
        sd = np.sqrt(np.diag(covariance))
        values = scales.values(np.array([0.3, -0.3]))
        estimates = tuple(
            ParameterEstimate(p.name, "1", float(v), float(s), (0.0, 0.0), learnt=0.3)
            for p, v, s in zip(pair, values, scales.slopes(values) * sd, strict=True)
        )
        joint = JointFit("test", estimates, (), covariance / np.outer(sd, sd), (), 1.0, 1, 0.5, converged=True, steps=1)
        name = f"s{place}"
        fits.append(SpecimenFit(name, name, Identification(name, (), (), joint, None, None, None)))
    assert pool_specimens(fits, pair).remarks == (
        "the means of stiffness and friction can hardly be separated by these runs: their product is known better than "
        "each of them",
    )


def with_coulomb(fit: SpecimenFit, mu: float | None, error: float | None) -> SpecimenFit:
    told = SimpleNamespace(
        mu=SimpleNamespace(value=mu, standard_error=error), mu_without_viscous=None if mu is None else
        SimpleNamespace(value=mu - 0.5, standard_error=error),
    )  # fmt: skip
    return dataclasses.replace(
        fit,
        identification=dataclasses.replace(fit.identification, coulomb=told),  # type: ignore[arg-type]
    )


def test_friction_of_coulomb_tests_is_pooled_on_a_scale_of_its_own() -> None:
    fits = [single_fit(name, 0.1, 0.3, ALONE[0]) for name in "abcd"]
    told = [with_coulomb(fit, mu, 0.01) for fit, mu in zip(fits, (0.08, 0.12, 0.1, 0.11), strict=True)]
    _, mu, without_viscous = pool_specimens(told, ALONE).parameters
    assert (mu.name, mu.unit, mu.meaning) == ("mu", "1", "μ of the Coulomb test, all of its force as friction")
    assert without_viscous.meaning == "μ of the Coulomb test without its viscous part"
    assert mu.mean.value == pytest.approx(0.103, abs=0.003)
    assert mu.mean.interval[0] > 0.06
    assert [value.own.value for value in mu.specimens if value.own] == [0.08, 0.12, 0.1, 0.11]
    assert mu.spread is not None
    assert without_viscous.spread is not None
    # The second scale is plain, for these values are negative; the scatter is that of the first.
    assert without_viscous.mean.value == pytest.approx(-0.3975, abs=0.004)
    assert without_viscous.spread.value == pytest.approx(0.0135, abs=0.004)
    assert mu.spread.value == pytest.approx(0.0135, abs=0.005)
    assert 0.005 < mu.mean.standard_error < 0.02
    for incomplete in ((None, None), (0.1, None), (0.1, 0.0)):
        some = [*told[:2], with_coulomb(fits[2], *incomplete), fits[3]]
        assert [parameter.name for parameter in pool_specimens(some, ALONE).parameters] == ["angle"]
    some = [*told[:3], fits[3]]
    assert [value.specimen for value in pool_specimens(some, ALONE).parameters[1].specimens] == ["a", "b", "c"]
