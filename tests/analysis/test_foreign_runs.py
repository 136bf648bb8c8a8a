"""Recordings from elsewhere: any of them gets a diagnosis, or one sentence why not, and nothing is made up."""

import re
import warnings
from collections.abc import Callable, Collection, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import dragrig
from dragrig.analysis import linear_gaussian, range_text
from dragrig.analysis.estimates import Exclusion
from dragrig.analysis.gap.diagnosis import Diagnosis, GapReduction, R2BeforeAfter, Verdict
from dragrig.analysis.models.experiment import Experiment, fit_kinematics, insert_reversals, session_starts
from dragrig.analysis.noise import NoiseModel
from dragrig.analysis.selection import RETURN_REASON
from dragrig.config.errors import DragrigError
from dragrig.present.diagnosis_sentences import shrink_sentences
from dragrig.present.numbers import listed_exclusions
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import catalogue
from property_tests import thorough

RATE_HZ = 500.0
PLAIN = '''
"""Dry and viscous friction."""

from dragrig.analysis.models import ChannelModel, Parameter


class Plain(ChannelModel):
    name = "plain"
    parameters = (
        Parameter("dry_mN", "mN", 80.0, 1.0),
        Parameter("viscous_mN_s_mm", "mN·s/mm", 1.0, 2.0),
    )

    def predict(self, values, at):
        return at.direction * values["dry_mN"] + values["viscous_mN_s_mm"] * at.velocity_mm_s


MODEL = Plain()
'''


def plain_model(folder: Path) -> Path:
    file = folder / "plain.py"
    file.write_text(PLAIN, "utf-8")
    return file


def stroke_mm(time_s: FloatArray, speed_mm_s: float = 10.0, travel_mm: float = 30.0, rest_s: float = 1.0) -> FloatArray:
    """Return a stroke with an acceleration of 200 mm/s², after a rest."""
    ramp_s = speed_mm_s / 200.0
    whole_s = travel_mm / speed_mm_s + ramp_s
    since = np.clip(time_s - rest_s, 0.0, whole_s)
    until = whole_s - since
    begun = np.where(since < ramp_s, 100.0 * since**2, speed_mm_s * (since - 0.5 * ramp_s))
    return np.where(until < ramp_s, travel_mm - 100.0 * until**2, begun)


def friction_mN(time_s: FloatArray, position_mm: FloatArray, seed: int = 0, noise_mN: float = 1.5) -> FloatArray:
    velocity = np.gradient(position_mm, time_s)
    noise = np.random.default_rng(seed).normal(0.0, noise_mN, time_s.size)
    return np.asarray(100.0 * np.tanh(velocity / 0.5) + 2.0 * velocity + noise)


def table(folder: Path, columns: Mapping[str, FloatArray], name: str = "recording.csv") -> Path:
    """Write a foreign recording, whose column names state quantity and unit."""
    path = folder / name
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
    return path


def recording(seed: int = 0, speed_mm_s: float = 10.0, seconds: float = 6.0) -> dict[str, FloatArray]:
    time = np.arange(0.0, seconds, 1 / RATE_HZ)
    position = stroke_mm(time, speed_mm_s)
    force = friction_mN(time, position, seed)
    return {"time_s": time, "force_mN": force, "position_mm": np.round(position, 3)}


def diagnosed(folder: Path, nominal: str | Path, *, trying: Collection[str] = tuple(catalogue())) -> Diagnosis:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return dragrig.gap_diagnose(
            folder, nominal=nominal, without=[name for name in catalogue() if name not in trying]
        )


SOME = ("force_drift", "stribeck", "direction_asymmetry")
"""Effects that are tried where none is expected to be named."""


def drifting_runs(folder: Path, **options: object) -> Path:
    """Import four runs, one after the other, whose friction grows from run to run."""
    runs = folder / "runs"
    runs.mkdir()
    for number in range(4):
        columns = recording(number)
        columns["force_mN"] = columns["force_mN"] * (1 + 0.05 * number)
        begun = {key: value + timedelta(minutes=number) for key, value in options.items() if key == "start_time"}
        dragrig.import_run(table(folder, columns, f"{number}.csv"), runs, specimen="steel", **begun)
    return runs


def test_runs_whose_clock_is_not_known_have_no_session_axis(tmp_path: Path) -> None:
    result = diagnosed(drifting_runs(tmp_path), plain_model(tmp_path), trying=SOME)
    assert not result.where.location("session").bins
    assert result.where.document()["session"] == {}
    assert "session" not in result.where.domain_scores
    assert result.where.domain != "session"
    assert any("not known when each run was made" in remark for remark in result.remarks)


def test_runs_whose_clock_is_stated_have_a_session_axis(tmp_path: Path) -> None:
    runs = drifting_runs(tmp_path, start_time=datetime(2026, 5, 4, 9, tzinfo=UTC))
    result = diagnosed(runs, plain_model(tmp_path), trying=SOME)
    assert result.where.location("session").bins
    assert result.where.domain == "session"


def test_a_stretch_begins_later_than_its_file(tmp_path: Path) -> None:
    source = table(tmp_path, {**recording(), "time_s": recording()["time_s"] + 20.0})
    start = datetime(2026, 5, 4, 9, tzinfo=UTC)
    imported = dragrig.import_run(source, tmp_path / "run.h5", start_time=start, from_s=22.0)
    header = dragrig.load(imported.path).info.header
    assert (header.start_time - start).total_seconds() == pytest.approx(2.0, abs=0.003)


def test_stretches_of_one_file_keep_their_sequence_without_a_date(tmp_path: Path) -> None:
    source = table(tmp_path, recording())
    stretches = [
        Experiment(dragrig.load(dragrig.import_run(source, tmp_path / f"{start}.h5", from_s=float(start)).path))
        for start in (0, 1, 3)
    ]
    starts = session_starts(stretches)
    assert starts == pytest.approx((0.0, 1.0, 3.0), abs=0.003)
    other = Experiment(dragrig.load(dragrig.import_run(table(tmp_path, recording(1)), tmp_path / "o.h5").path))
    assert session_starts([*stretches, other]) is None


def test_a_foreign_run_with_rests_is_not_taken_for_one_with_nothing_attached(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    dragrig.import_run(table(tmp_path, recording()), runs, specimen="steel")
    assert diagnosed(runs, plain_model(tmp_path), trying=SOME).runs == 1


def test_a_run_there_and_back_is_not_said_to_go_one_way(tmp_path: Path) -> None:
    time = np.arange(0.0, 6.0, 1 / RATE_HZ)
    position = 5.0 * np.sin(np.pi * time)
    columns = {"time_s": time, "force_mN": friction_mN(time, position), "position_mm": np.round(position, 3)}
    runs = tmp_path / "runs"
    runs.mkdir()
    dragrig.import_run(table(tmp_path, columns), runs, specimen="steel")
    result = diagnosed(runs, plain_model(tmp_path), trying=SOME)
    assert not any("one way" in limitation for limitation in result.limitations)
    told = "" if result.unknown is None else result.unknown.dependence
    assert "every run" not in told
    assert "session" not in told


def test_a_motion_lost_in_noise_divides_by_nothing(tmp_path: Path) -> None:
    columns = recording()
    columns["position_mm"] = columns["position_mm"] + np.random.default_rng(3).normal(0.0, 0.5, columns["time_s"].size)
    runs = tmp_path / "runs"
    runs.mkdir()
    dragrig.import_run(table(tmp_path, columns), runs, specimen="steel")
    assert diagnosed(runs, plain_model(tmp_path), trying=SOME).runs == 1


def test_a_joint_where_the_motion_reverses_has_a_time_of_its_own() -> None:
    joints = np.array([0.0, 1.0, 1.0 + 1e-9, 2.0])
    times, velocity = insert_reversals(joints, np.array([0.0, 1e-12, -5.0, 0.0]))
    assert np.all(np.diff(times) > 0)
    assert velocity.size == times.size


RELAXING = '''
"""A strip that is stretched and relaxes with one mode."""

import numpy as np

from dragrig.analysis.models import ChannelModel, Parameter


class Strip(ChannelModel):
    name = "strip"
    parameters = (
        Parameter("spring_mN_mm", "mN/mm", 50.0, 1.0),
        Parameter("mode_mN_mm", "mN/mm", 30.0, 1.0),
        Parameter("time_s", "s", 0.6, 0.5),
    )

    def predict(self, values, at):
        time = at.experiment.time_s
        moved = at.experiment.position(time)
        decay = np.exp(-np.diff(time) / values["time_s"])
        branch = [0.0]
        for factor, step in zip(decay.tolist(), np.diff(moved).tolist()):
            branch.append(factor * branch[-1] + step)
        elastic = values["spring_mN_mm"] * moved + values["mode_mN_mm"] * np.array(branch)
        return np.interp(at.time_s, time, elastic)
{parts}

MODEL = Strip()
'''
DECLARED = """
    def parts(self, values, at):
        return {"relaxation": self.predict(values, at)}
"""


STEP_S = 0.02


def relaxing_strips(folder: Path, rest_s: float, strains_mm: tuple[float, ...]) -> Path:
    """Import stretches of a strip that relaxes with two modes, one of them slow."""
    runs = folder / "runs"
    runs.mkdir()
    for number, strain in enumerate(strains_mm):
        time = np.arange(0.0, 8.0, STEP_S)
        moved = stroke_mm(time, 20.0, strain, rest_s) if rest_s else np.full_like(time, strain)
        branches = np.zeros((2, time.size))
        branches[:, 0] = 0.0 if rest_s else strain
        for index in range(1, time.size):
            step = np.diff(moved[index - 1 : index + 1])[0]
            branches[:, index] = np.exp(-STEP_S / np.array([0.5, 4.0])) * branches[:, index - 1] + step
        noise = np.random.default_rng(number).normal(0.0, 1.0, time.size)
        force = 50.0 * moved + np.array([30.0, 25.0]) @ branches + noise
        columns = {"time_s": time, "force_mN": force, "position_mm": np.round(moved, 3)}
        dragrig.import_run(table(folder, columns, f"{number}.csv"), runs, specimen="strip")
    return runs


def strip_model(folder: Path, parts: str = "") -> Path:
    file = folder / "strip.py"
    file.write_text(RELAXING.replace("{parts}", parts), "utf-8")
    return file


@pytest.fixture
def known_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the noise be known, whatever a force that relaxes throughout shows of it."""
    noise = NoiseModel(white=1.0, slow=0.3, correlation_s=0.2, degrees=500)
    monkeypatch.setattr(linear_gaussian, "estimate_noise", lambda *_, **__: noise)


@pytest.mark.parametrize(
    ("rest_s", "strains"), [(0.0, (4.0,)), thorough(1.0, (4.0,)), thorough(1.0, (2.0, 3.0, 4.0, 5.0, 6.0))]
)
def test_a_relaxation_one_mode_too_short_is_no_drift_of_the_sensor(
    rest_s: float, strains: tuple[float, ...], tmp_path: Path, known_noise: None
) -> None:
    result = diagnosed(relaxing_strips(tmp_path, rest_s, strains), strip_model(tmp_path), trying=SOME)
    assert result.verdict is Verdict.UNKNOWN, result.ranking[:3]
    named = {hypothesis.hypothesis: hypothesis.probability for hypothesis in result.ranking}
    assert named.get("force_drift", 0.0) < 0.2


def test_a_model_that_declares_its_relaxation_is_tried_with_a_further_one(tmp_path: Path, known_noise: None) -> None:
    runs = relaxing_strips(tmp_path, 1.0, (2.0, 6.0))
    result = diagnosed(runs, strip_model(tmp_path, DECLARED), trying=("extra_relaxation", *SOME))
    assert result.effects == ("extra_relaxation",), result.ranking[:3]
    assert not any("specimen" in limitation for limitation in result.limitations)


def test_a_zero_that_is_taken_as_less_certain_than_stated_is_told(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    for number in range(3):
        columns = recording(number)
        columns["force_mN"] = columns["force_mN"] + 150.0
        dragrig.import_run(table(tmp_path, columns, f"{number}.csv"), runs, specimen="steel")
    limitations = " ".join(diagnosed(runs, plain_model(tmp_path), trying=SOME).limitations)
    assert re.search(r"zero known to 5 mN \(zero_sd_mN\) allows: the zero was taken as known to 30\d mN", limitations)


def polynomial(time_s: FloatArray, travel_mm: float, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Return a motion without a jump of the acceleration or its derivative, after 0.5 s, and its acceleration."""
    share = np.clip((time_s - 0.5) / seconds, 0.0, 1.0)
    position = travel_mm * (35 * share**4 - 84 * share**5 + 70 * share**6 - 20 * share**7)
    acceleration = travel_mm / seconds**2 * (420 * share**2 - 1680 * share**3 + 2100 * share**4 - 840 * share**5)
    return position, acceleration


@pytest.mark.parametrize(
    ("seconds", "noise_mm", "highest"), [thorough(0.5, 0.0, 15.0), (0.5, 0.003, 25.0), thorough(2.0, 0.001, 2.0)]
)
def test_a_smooth_motion_has_a_smooth_acceleration(
    seconds: float, noise_mm: float, highest: float, tmp_path: Path
) -> None:
    time = np.arange(0.0, seconds + 1.0, 1e-3)
    position, acceleration = polynomial(time, 100.0, seconds)
    recorded = np.round(position + np.random.default_rng(1).normal(0.0, 1.0, time.size) * noise_mm, 3)
    columns = {"time_s": time, "force_mN": np.random.default_rng(2).normal(size=time.size), "position_mm": recorded}
    experiment = Experiment(dragrig.load(dragrig.import_run(table(tmp_path, columns), tmp_path / "run.h5").path))
    motion = fit_kinematics(experiment)
    inside = (time > 0.05) & (time < time[-1] - 0.05)
    error = (motion.acceleration(time) - acceleration)[inside]
    assert float(np.sqrt(np.mean(error**2))) < highest
    assert np.all(np.diff(motion.joints_s) > 0)
    assert motion.velocity(np.array([0.1]))[0] == 0.0


def test_ramps_keep_their_edges(tmp_path: Path) -> None:
    imported = dragrig.import_run(table(tmp_path, recording()), tmp_path / "run.h5")
    motion = fit_kinematics(Experiment(dragrig.load(imported.path)))
    assert motion.smooth is None
    np.testing.assert_allclose(np.unique(np.round(motion.acceleration(np.array([0.5, 1.025, 2.0])))), [0, 200], atol=5)


def heavy_strokes(folder: Path, asymmetry: float) -> Path:
    """Import strokes there and back of a stage of 95 kg, whose friction differs with direction, on smooth motions."""
    runs = folder / "runs"
    runs.mkdir()
    for number, (travel, seconds) in enumerate([(100, 0.6), (-100, 0.6), (60, 0.8), (-60, 0.8)]):
        time = np.arange(0.0, seconds + 1.0, 1 / RATE_HZ)
        position, acceleration = polynomial(time, travel, seconds)
        velocity = np.gradient(position, time)
        friction = 8000.0 * np.tanh(velocity / 0.05) + 20.0 * velocity
        force = 95.0 * acceleration + friction + asymmetry * np.abs(friction)
        force += np.random.default_rng(number).normal(0.0, 200.0, time.size)
        columns = {"time_s": time, "motor_force_mN": force, "position_mm": np.round(position, 3)}
        dragrig.import_run(table(folder, columns, f"{number}.csv"), runs, specimen="axis")
    return runs


@pytest.mark.thorough
def test_a_heavy_stage_on_a_smooth_motion_shows_friction_that_differs_with_direction(tmp_path: Path) -> None:
    result = diagnosed(heavy_strokes(tmp_path, 0.1), "drive", trying=("stribeck", "direction_asymmetry"))
    assert result.effects == ("direction_asymmetry",), result.ranking[:3]
    (size,) = result.ranking[0].parameters
    assert size.value == pytest.approx(0.1, abs=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("trying", [SOME, tuple(catalogue())], ids=["some", "all"])
def test_a_heavy_stage_on_a_smooth_motion_shows_nothing_else(trying: tuple[str, ...], tmp_path: Path) -> None:
    result = diagnosed(heavy_strokes(tmp_path, 0.0), "drive", trying=trying)
    assert not result.effects, result.ranking[:3]


def test_all_ways_back_are_one_line_and_runs_marked_bad_are_named() -> None:
    left_out = [Exclusion(f"00{number}-return.h5", RETURN_REASON) for number in range(3)]
    left_out.insert(1, Exclusion("007-drag.h5", "it is marked bad: slipped"))
    listed = listed_exclusions(left_out)
    assert [exclusion.item for exclusion in listed] == ["007-drag.h5", "000-return.h5 and 2 more"]
    assert listed[0].reason == "it is marked bad: slipped"
    clipped = [Exclusion(f"01{number}-drag.h5", "it is clipped") for number in range(2)]
    assert listed_exclusions(clipped) == (Exclusion("010-drag.h5 and 1 more", "each is clipped"),)


def test_an_interval_without_width_is_not_written() -> None:
    assert range_text((44.77, 44.77), 0.0) == ""
    assert range_text((44.0, 45.0), 0.25) == "44.00 to 45.00"


def test_a_share_that_closes_in_the_position_is_told_with_sizes_of_the_position() -> None:
    nothing = R2BeforeAfter(None, None, None, None)
    shrink = GapReduction(5502.0, 5502.0, 90.0, 0.947, (0.93, 0.96), None, nothing, nothing, (), (93.0, 21.4))
    text = " ".join(shrink_sentences(shrink))
    assert "Position error (rms): 93 µm without the effect, 21.4 µm with it." in text
    assert "5502" not in text


Columns = dict[str, FloatArray]


def uneven(columns: Columns) -> Columns:
    late = np.random.default_rng(1).uniform(-1e-3, 1e-3, columns["time_s"].size)
    return {**columns, "time_s": np.sort(columns["time_s"] + late)}


def stepping(columns: Columns) -> Columns:
    return {**columns, "position_mm": np.where(columns["time_s"] < 2.0, 0.0, 10.0)}


def in_rows(rows: slice) -> Callable[[Columns], Columns]:
    return lambda columns: {key: values[rows] for key, values in columns.items()}


ODD: dict[str, tuple[Callable[[Columns], Columns], dict[str, float]]] = {
    "uneven": (uneven, {"resample_hz": 500.0}),
    "repeated": (
        lambda columns: {**columns, "time_s": np.repeat(columns["time_s"][::2], 2)},
        {"sample_rate_hz": 500.0},
    ),
    "step": (stepping, {}),
    "short": (in_rows(slice(600, 604)), {}),
    "ten rows": (in_rows(slice(600, 610)), {}),
    "slow": (in_rows(slice(None, None, 100)), {}),
    "no rests": (in_rows(slice(600, 1800)), {}),
    "constant": (lambda columns: {**columns, "force_mN": np.full_like(columns["time_s"], 5.0)}, {}),
    "holes": (lambda columns: {key: np.delete(values, np.arange(1000, 1400)) for key, values in columns.items()}, {}),
    "no position": (in_rows(slice(None)), {}),
    "metres": (lambda columns: {**columns, "position_mm": 1000.0 * columns["position_mm"]}, {}),
}
"""What is odd of a recording, and the options of its import."""


@pytest.mark.parametrize("trying", [SOME, thorough(tuple(catalogue()))], ids=["some", "all"])
@pytest.mark.parametrize(
    "name", [name if name in {"short", "slow", "constant", "no position"} else thorough(name) for name in ODD]
)
def test_any_recording_gets_a_diagnosis_or_one_sentence(name: str, trying: tuple[str, ...], tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    change, options = ODD[name]
    columns = change(recording())
    if name == "no position":
        del columns["position_mm"]
    dragrig.import_run(table(tmp_path, columns), runs, **options)
    for nominal in (plain_model(tmp_path), "drive", "capsule"):
        told = ""
        try:
            assert diagnosed(runs, nominal, trying=trying).runs == 1
        except DragrigError as error:
            told = str(error)
        assert "\n" not in told


@pytest.mark.parametrize(
    ("unit", "length_mm"),
    [
        thorough(0.02, 0.25),
        thorough(1.0, 0.25),
        thorough(50.0, 0.25),
        (0.3, 1.0),
        thorough(50.0, 1.0),
        thorough(1.0, 4.0),
    ],
)
def test_presliding_is_found_whatever_unit_the_travel_is_counted_in(
    unit: float, length_mm: float, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    for number, (speed, travel) in enumerate([(5, 10), (10, 20), (20, 20), (40, 20)]):
        time = np.arange(0.0, travel / speed + 1.5, 1 / RATE_HZ)
        position = stroke_mm(time, speed, travel, rest_s=0.5)
        bristle = 1.0 - np.exp(-position / length_mm)
        velocity = np.gradient(position, time)
        force = 500.0 * bristle + 3.0 * velocity + np.random.default_rng(number).normal(0.0, 2.0, time.size)
        columns = {"time_s": time, "motor_force_mN": force, "position_mm": unit * position}
        dragrig.import_run(table(tmp_path, columns, f"{number}.csv"), runs, specimen="joint")
    result = diagnosed(runs, "drive", trying=("presliding", "stribeck", "direction_asymmetry"))
    assert "presliding" in result.effects, [(found.hypothesis, found.probability) for found in result.ranking[:4]]
    values = {parameter.name.split(".")[-1]: parameter.value for parameter in result.ranking[0].parameters}
    # The shortest is five counts of the encoder long.
    assert values["deflection_mm"] == pytest.approx(length_mm * unit, rel=0.1 if unit >= 0.3 else 0.5)
