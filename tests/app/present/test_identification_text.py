"""What an identification says, as text for a terminal and as JSON."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.analysis import rounded_to_error
from dragrig.analysis.estimates import Estimate, EstimatedQuantity, Exclusion, missing
from dragrig.analysis.identification.identification import (
    CoulombResult,
    CoulombRun,
    DragResult,
    Identification,
    JointFit,
    LogLaw,
    ParameterEstimate,
    RelaxationFit,
    RelaxationResult,
    RunResidual,
    SpeedBandR2,
    SpeedBoundary,
    SpeedPoint,
    StrainLaw,
    ThirdBranchTest,
)
from dragrig.present.identification import identification_document, identification_json
from dragrig.present.numbers import to_json_value
from dragrig.present.terminal import document_text


def quantity(name: str, value: float, error: float, unit: str = "1") -> EstimatedQuantity:
    return EstimatedQuantity(name, unit, value, error, (value - 2 * error, value + 2 * error))


def identified(name: str, value: float, error: float, learnt: float, unit: str = "1") -> ParameterEstimate:
    return ParameterEstimate(
        name, unit, value, error, (value - 2 * error, value + 2 * error), (0.7, 1.3), learnt, "a scale"
    )


def residual(file: str, chi2: float = 1.02) -> RunResidual:
    factors = {"stiffness": Estimate(1.0213, 0.002)}
    return RunResidual(file, "drag", "force", 200, chi2, 1.23, Estimate(2.345, 0.21), factors)


JOINT = JointFit(
    nominal="capsule",
    parameters=(
        identified("stiffness_scale", 1.0511, 0.034, 0.78),
        identified("dwell_scale", 1.0, 0.25, 0.0),
        identified("angle_deg", 0.21, 0.16, 0.77, "deg"),
    ),
    combinations=(identified("e1_shown", 1.0148, 0.0099, 0.9),),
    correlation=np.eye(3),
    runs=(residual("010-drag.h5"), residual("014-drag.h5", 2.0)),
    chi2=410.0,
    degrees=400,
    p_value=0.36,
    converged=True,
    steps=7,
    remarks=("stiffness_scale and dwell_scale can hardly be told apart by these runs",),
)
ELEMENTS = (
    quantity("E1", 3.2659, 0.0123, "kPa"),
    quantity("E2", 1.8184, 0.0043, "kPa"),
    quantity("E3", 1.5218, 0.0011, "kPa"),
    quantity("eta1", 0.064256, 0.00027, "kPa·s"),
    quantity("eta2", 0.62513, 0.00135, "kPa·s"),
)
ALIKE = np.eye(5)
ALIKE[3, 0] = ALIKE[0, 3] = -0.97
RELAXATION = RelaxationResult(
    fits=(
        RelaxationFit(
            "000-relaxation.h5",
            0.5,
            ELEMENTS,
            (quantity("tau1", 0.019675, 0.00012, "s"), quantity("tau2", 0.34378, 0.0011, "s")),
            ALIKE,
            Estimate(1.4, 0.3),
            172.7,
            161,
            ThirdBranchTest(True, 0.39, None, None, "Five elements suffice."),
            converged=True,
        ),
        RelaxationFit("001-relaxation.h5", 1.0, remark="its ramp is clipped"),
    ),
    laws=(StrainLaw("eta1", "kPa·s", (0.5, 1.0, 2.0), (-0.25, 0.5, 2.0), np.diag([1e-4, 1e-4, 4e-4]), None),),
    remarks=("three strains leave no degree of freedom",),
)
COULOMB = CoulombResult(
    runs=(
        CoulombRun(
            "006-coulomb.h5", 0.5, 491.313, Estimate(40.07, 0.33), Estimate(0.08156, 0.00067),
            Estimate(0.08008, 0.00067), 0.7288, 0.0182,
        ),
    ),
    mu=Estimate(0.08156, 0.00067),
    mu_without_viscous=missing("no run shows it"),
)  # fmt: skip
DRAG = DragResult(
    points=(
        SpeedPoint(0.5, 2, Estimate(87.09, 0.62), 33.74, 0.73, 47.94),
        SpeedPoint(60.0, 1, missing("it is clipped"), 84.4, 9.1, 55.1),
    ),
    log_law=LogLaw(quantity("intercept", 88.66, 0.34, "mN"), quantity("slope", 14.05, 0.18, "mN"), -0.6, 0.912, 2e-7),
    boundary=SpeedBoundary(20.0, (15.0, 31.0), 0.01, "The two part ways at 20 mm/s."),
    determination=(SpeedBandR2("up to 20 mm/s", 2, None, None),),
)
WHOLE = Identification(
    specimen="jejunum",
    used=("000-relaxation.h5", "010-drag.h5"),
    left_out=(Exclusion("003-drag.h5", "it is marked bad: slipped"),),
    joint=JOINT,
    relaxation=RELAXATION,
    coulomb=COULOMB,
    drag=DRAG,
    remarks=("clocks differ",),
)


def identification_text(identification: Identification) -> str:
    return document_text(identification_document(identification))


def line(text: str, beginning: str) -> str:
    return next(entry for entry in text.splitlines() if entry.strip().startswith(beginning))


def test_every_number_stands_with_its_interval_to_the_digits_that_its_error_supports() -> None:
    text = identification_text(WHOLE)
    assert line(text, "wall stiffness ×").split()[3:7] == ["1.051", "0.983", "to", "1.119"]
    assert line(text, "E1 · gain ×").split()[4:] == ["1.0148", "0.9950", "to", "1.0346", "2", "%", "e1_shown"]
    assert "The wall at 50 % strain: E1 = 3.266 ± 0.012 kPa, " in text
    first = line(text, "000-relaxation.h5").split()
    assert first == ["000-relaxation.h5", "50", "%", "E1", "3.266", "3.241", "to", "3.290", "0.75", "%", "kPa"]
    assert "0.08156 ± 0.00067 (95 %: 0.08025 to 0.08287)" in line(text, "μ  ")
    assert line(text, "0.5").split() == [
        "0.5",
        "2",
        "87.09",
        "±",
        "0.62",
        "33.7",
        "0.7",
        "47.9",
        "82.4",
        "+4.7",
        "+7.5",
    ]


def test_what_cannot_be_known_is_said_in_words() -> None:
    text = identification_text(WHOLE)
    assert "these runs do not determine dwell_scale" in text
    assert "outside of the 95 % interval of the prior: angle_deg" in text
    assert "wall stiffness × and dwell_scale can hardly be told apart" in text
    assert "hard to distinguish: η1 and E1 (correlation −0.97)" in text
    assert "001-relaxation.h5: no elements: its ramp is clipped." in text
    assert "the model leaves more than noise in 014-drag.h5" in text
    assert "– (no run shows it)" in line(text, "μ without viscous")
    assert "– (it is clipped)" in line(text, "60")
    assert "deviate from it by more than their errors (p < 0.0001)" in text
    assert "003-drag.h5" in text.split("Left out")[1]
    assert "it is marked bad: slipped" in text
    assert "2 of 3 runs used" in text
    assert text.rstrip().endswith("! clocks differ")


def test_a_fit_that_did_not_converge_or_does_not_explain_the_runs_says_so_first() -> None:
    lost = identification_text(replace(WHOLE, joint=replace(JOINT, converged=False)))
    assert "did NOT converge in 7 steps; the intervals below are not valid" in lost.split("parameter")[0]
    assert line(lost, "wall stiffness ×").split() == [
        "wall",
        "stiffness",
        "×",
        "1.051",
        "0.700",
        "to",
        "1.300",
        "a",
        "scale",
        "stiffness_scale",
    ]
    poor = identification_text(replace(WHOLE, joint=replace(JOINT, p_value=1e-9)))
    assert "residuals exceed noise" in poor.split("parameter")[0]
    assert "residuals exceed noise" not in identification_text(WHOLE)


def test_what_runs_do_not_determine_stands_without_a_number() -> None:
    text = identification_text(WHOLE)
    assert line(text, "dwell_scale").split()[:5] == ["dwell_scale", "–", "0.70", "to", "1.30"]
    nothing = tuple(replace(parameter, learnt=0.02) for parameter in JOINT.parameters)
    assert "determine NONE" in identification_text(replace(WHOLE, joint=replace(JOINT, parameters=nothing)))
    joint = identification_json(WHOLE)["joint"]
    assert isinstance(joint, dict)
    dwell = joint["parameters"]["dwell_scale"]
    assert (dwell["determined"], dwell["value"], dwell["interval_95"]) == (False, None, None)
    assert dwell["prior_95"] == (0.7, 1.3)
    assert joint["combinations"]["e1_shown"]["determined"] is True


def test_what_is_added_to_a_run_is_no_factor_and_a_channel_without_zero_shows_none() -> None:
    own = replace(JOINT.runs[0], zero=missing("none"), factors={}, offsets={"load_zero_mN": Estimate(-11.5, 3.0)})
    text = identification_text(Identification("stage", ("a.h5",), (), replace(JOINT, runs=(own,)), None, None, None))
    assert "load_zero_mN ×" not in text
    assert line(text, "010-drag.h5").split() == ["010-drag.h5", "drag", "force", "1.02", "1.23", "–", "−11.5"]
    assert "Relaxation" not in text


def test_parts_that_are_not_there_are_named_and_nothing_is_made_up() -> None:
    bare = Identification("jejunum", ("010-drag.h5",), (), None, None, None, None)
    text = identification_text(bare)
    for words in (
        "Joint fit\nNone.",
        *(f"{part}\nNot identified." for part in ("Relaxation", "Coulomb friction", "Drag")),
    ):
        assert words in text
    assert "Left out" not in text
    assert "1 of 1 runs used" in text
    table = identification_json(bare)
    assert [table[key] for key in ("joint", "relaxation", "coulomb", "drag")] == [None] * 4
    no_mu = CoulombResult((), missing("none"), missing("none"))
    empty = Identification("s", (), (), None, RelaxationResult((), ()), no_mu, DragResult((), None, None))
    assert "from 0 of 0 runs" in identification_text(empty)
    json.dumps(to_json_value(identification_json(empty)), allow_nan=False)


def test_a_law_reads_as_a_polynomial_with_errors() -> None:
    text = identification_text(WHOLE)
    assert "−(0.250 ± 0.010) ε² + (0.500 ± 0.010) ε + (2.000 ± 0.020)" in line(text.split("against strain ε")[1], "η1")


def test_json_names_units_in_its_keys_and_holds_everything() -> None:
    table = json.loads(json.dumps(to_json_value(identification_json(WHOLE)), allow_nan=False))
    joint = table["joint"]
    assert set(joint["parameters"]) == {"stiffness_scale", "dwell_scale", "angle_deg"}
    assert joint["parameters"]["stiffness_scale"]["interval_95"] == pytest.approx([0.9831, 1.1191])
    assert joint["correlation"]["names"] == ["stiffness_scale", "dwell_scale", "angle_deg"]
    assert joint["runs"][0]["zero_mN"]["value"] == 2.345
    run = table["relaxation"]["runs"][0]
    assert set(run["elements"]) == {"E1_kPa", "E2_kPa", "E3_kPa", "eta1_kPa_s", "eta2_kPa_s"}
    assert set(run["times"]) == {"tau1_s", "tau2_s"}
    assert run["five_elements"]["suffice"] is True
    assert table["relaxation"]["runs"][1]["elements"] == {}
    assert table["coulomb"]["runs"][0]["force_mN"]["standard_error"] == 0.33
    assert table["coulomb"]["mu_without_viscous"] == {
        "value": None, "standard_error": None, "interval_95": None, "reason": "no run shows it",
    }  # fmt: skip
    assert table["drag"]["speeds"][0]["model_mN"] == pytest.approx(82.41)
    assert table["drag"]["boundary"]["interval_95_mm_s"] == [15.0, 31.0]
    assert set(table["drag"]["log_law"]) >= {"intercept_mN", "slope_mN"}
    assert table["left_out"] == [{"what": "003-drag.h5", "reason": "it is marked bad: slipped"}]


anything = st.floats(allow_nan=True, allow_infinity=True)


@given(anything, anything, anything)
def test_no_number_breaks_text_or_json(value: float, error: float, p_value: float) -> None:
    odd = ParameterEstimate("x", "mN·s/mm", value, error, (value, error), (error, value), abs(p_value), "odd")
    matrix = np.full((1, 1), value)
    joint = replace(JOINT, parameters=(odd,), combinations=(odd,), chi2=value, p_value=p_value, correlation=matrix)
    point = SpeedPoint(abs(value), 1, Estimate(value, error), error, p_value, value)
    drag = DragResult(
        (point,), LogLaw(odd, odd, value, value, p_value), SpeedBoundary(value, (value, error), p_value, "so")
    )
    whole = replace(WHOLE, joint=joint, drag=drag)
    assert "x" in identification_text(whole)
    table = json.loads(json.dumps(to_json_value(identification_json(whole)), allow_nan=False))
    result = table["joint"]["parameters"]["x_mN_s_mm"]["value"]
    assert result == (value if math.isfinite(value) and odd.determined else None)


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e3))
def test_rounding_loses_less_than_a_tenth_of_the_error(value: float, error: float) -> None:
    lost = abs(float(rounded_to_error(value, error).replace("−", "-")) - value)
    assert lost <= 0.1 * max(error, 1e-6 * abs(value)) + 1e-9 or error >= 10
