"""`dragrig gap diagnose --nominal drive`, the stage alone, and what a model of one's own can be told."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dragrig
from dragrig.analysis import ImportSettings, import_runs, parse_map
from dragrig.analysis.gap.diagnosis import Diagnosis, Verdict
from dragrig.analysis.gap.position_channel import position_errors, score_model_classes
from dragrig.analysis.models.catalogue import CheckedModel, find_model
from dragrig.analysis.models.experiment import Experiment
from dragrig.api.gap import gap_evaluate, save_amended_model
from dragrig.cli import main
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.present.diagnosis import diagnosis_document
from dragrig.present.terminal import document_text
from dragrig.rig import read_run
from dragrig.rig.profile import FloatArray
from dragrig.rig.runfile.model import Run
from dragrig.rig.runfile.schema import SIGNALS
from dragrig.sim_backend.effects import catalogue
from drives import cogging, held_by_a_loop
from finishing import finished_here
from property_tests import thorough

COULOMB_MN, VISCOUS_MN_S_MM = 300.0, 4.0
RATE = "rig.sampling.rate_hz=500"


def all_but(*effects: str) -> tuple[str, ...]:
    """Return what a test leaves out of a diagnosis that is about something else than telling effects apart."""
    return tuple(name for name in catalogue() if name not in effects)


UNLIKELY = all_but("direction_asymmetry", "stribeck", "force_drift", "backlash", "velocity_ripple")
NOT_OF_A_STAGE = {"adhesion", "folds", "peristalsis", "wall_lift_off", "tissue_ageing", "preconditioning"}
OWN = """
from dragrig.analysis.models import ChannelModel, Parameter

class Sledge(ChannelModel):
    name = "sledge"
    channel = "motor_force"
    zero_sd_mN = 30.0
    parameters = (
        Parameter("mass_g", "g", 1000.0, 1.0),
        Parameter("coulomb_mN", "mN", 200.0, 1.0),
        Parameter("viscous_mN_s_mm", "mN·s/mm", 3.0, 1.0),
    )

    def predict(self, values, at):
        moving = 1e-3 * values["mass_g"] * at.acceleration_mm_s2 + values["viscous_mN_s_mm"] * at.velocity_mm_s
        return moving + values["coulomb_mN"] * at.direction

MODEL = Sledge()
"""


def there_and_back(
    folder: Path, *, out: Path | None = None, speeds_mm_s: tuple[int, ...] = (5, 15, 30, 60), seed: int = 11
) -> list[Run]:
    plan = folder / "stage.toml"
    speeds = list(speeds_mm_s)
    steps = [f'[[steps]]\nkind = "blank"\nspeed_mm_s = {speeds}\ntravel_mm = {travel}\n' for travel in (25, -25)]
    plan.write_text('name = "stage"\n' + "".join(steps))
    return dragrig.simulate(str(plan), out=out, assignments=[f"rig.simulated.seed={seed}", RATE])


def with_force(runs: list[Run], more: Callable[[FloatArray, FloatArray], FloatArray]) -> list[Run]:
    """Add to the recorded motor force what depends on velocity and time."""
    changed = []
    for run in runs:
        experiment = Experiment(run)
        force = np.asarray(run.trace.channels["motor_force"]) + more(
            experiment.velocity(experiment.time_s), experiment.time_s
        )
        channels = {**run.trace.channels, "motor_force": force.astype(np.float32)}
        changed.append(replace(run, trace=replace(run.trace, channels=channels)))
    return changed


def asymmetric(runs: list[Run], asymmetry: float) -> list[Run]:
    def more(velocity: FloatArray, time_s: FloatArray) -> FloatArray:
        del time_s
        return asymmetry * np.abs(COULOMB_MN * np.tanh(velocity / 0.05) + VISCOUS_MN_S_MM * velocity)

    return with_force(runs, more)


def drifting(runs: list[Run]) -> list[Run]:
    return with_force(runs, lambda velocity, time_s: 0.0 * velocity + 3.0 * time_s)


def hypotheses(diagnosis: Diagnosis) -> set[str]:
    return {hypothesis.hypothesis for hypothesis in diagnosis.ranking}


@pytest.fixture(scope="module")
def blanks(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Return the runs of a stage as the model has it."""
    return there_and_back(tmp_path_factory.mktemp("stage"))


@pytest.fixture(scope="module")
def fresh_blanks(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Return another session of the same stage, at other speeds."""
    return there_and_back(tmp_path_factory.mktemp("fresh"), speeds_mm_s=(8, 45), seed=12)


@pytest.fixture
def own(tmp_path: Path) -> Path:
    file = tmp_path / "sledge.py"
    file.write_text(OWN, "utf-8")
    return file


def test_a_stage_as_the_model_has_it_has_no_gap(blanks: list[Run]) -> None:
    without = set(UNLIKELY) - {"channel_latency"} - NOT_OF_A_STAGE
    diagnosis = dragrig.gap_diagnose(blanks, nominal="drive", without=without)
    assert diagnosis.verdict is Verdict.NO_GAP
    assert {"direction_asymmetry", "stribeck", "channel_latency"} <= hypotheses(diagnosis)
    assert not hypotheses(diagnosis) & NOT_OF_A_STAGE
    assert diagnosis.detection_limit_mN < 10.0
    text = " ".join(diagnosis.limitations)
    assert "one way" not in text
    assert "gut" not in text


@pytest.mark.parametrize(
    ("asymmetry", "without"), [thorough(-0.1, ()), (0.05, UNLIKELY), thorough(0.05, ()), thorough(0.2, ())]
)
def test_friction_that_differs_with_direction_is_named_with_its_size(
    asymmetry: float, without: tuple[str, ...], blanks: list[Run]
) -> None:
    diagnosis = dragrig.gap_diagnose(asymmetric(blanks, asymmetry), nominal="drive", without=without)
    assert diagnosis.verdict is Verdict.EFFECT
    assert diagnosis.effects == ("direction_asymmetry",)
    assert diagnosis.confusable_with == ()
    (size,) = diagnosis.ranking[0].parameters
    assert size.interval is not None
    assert size.interval[0] < asymmetry < size.interval[1]
    assert size.standard_error < 0.002
    assert diagnosis.where.location("channel").shares["motor_force"] > 0.95
    assert diagnosis.model is not None
    assert [effect.id for effect in diagnosis.model.effects] == ["direction_asymmetry"]
    assert diagnosis.shrink is not None
    assert diagnosis.shrink.closed is not None
    assert diagnosis.shrink.closed > 0.95
    assert {traces.channel for traces in diagnosis.traces} == {"motor_force"}


def test_runs_of_one_direction_say_that_they_cannot_tell(blanks: list[Run]) -> None:
    forwards = [run for run in asymmetric(blanks, 0.1) if run.trace.position[-1] > run.trace.position[0]]
    diagnosis = dragrig.gap_diagnose(forwards, nominal="drive", without=UNLIKELY)
    assert "direction_asymmetry" not in diagnosis.effects
    assert any("one way" in name for name in diagnosis.limitations)


@pytest.mark.parametrize(
    ("asymmetry", "effects"), [(0.0, ()), thorough(0.08, ("direction_asymmetry",))], ids=["symmetric", "asymmetric"]
)
def test_turning_round_within_a_run_is_no_effect(asymmetry: float, effects: tuple[str, ...], tmp_path: Path) -> None:
    plan = tmp_path / "turns.toml"
    strokes = (
        f"{{travel_mm = {way * 15}, speed_mm_s = {speed}}}"
        for speed in (5, 40)
        for way in (1, -1)
    )  # fmt: skip
    step = f'[[steps]]\nkind = "motion"\nfixture = "none"\nrepeats = 2\nstrokes = [{", ".join(strokes)}]\n'
    plan.write_text(f'name = "turns"\n{step}')
    runs = dragrig.simulate(str(plan), assignments=["rig.simulated.seed=3", RATE])
    diagnosis = dragrig.gap_diagnose(asymmetric(runs, asymmetry), nominal="drive", without=UNLIKELY)
    assert diagnosis.effects == effects
    assert (diagnosis.verdict is Verdict.NO_GAP) is (not effects)


def test_strokes_of_a_noisy_record_are_repeats(tmp_path: Path) -> None:
    rng, time = np.random.default_rng(3), np.arange(0.0, 15.0, 0.002)
    corners = np.cumsum([0.5, *[20 / 6.3, 0.5] * 4])
    position = np.interp(time, corners, [0, 20, 20, 0, 0, 20, 20, 0, 0])
    force = np.sign(np.gradient(position).round(6)) + rng.normal(0, 0.01, len(time))
    # The encoder's noise, and jolts of the table that differ from stroke to stroke.
    position += rng.normal(0, 0.02, len(time))
    position += np.interp(time % 3.68, [1.9, 1.92, 1.94], [0, 1, 0]) * (0.1 + 0.02 * time)
    record = tmp_path / "a.csv"
    np.savetxt(record, np.c_[time, force, position], "%.4f", ",", header="t [s],F [N],x [mm]", comments="")
    settings = ImportSettings(columns=parse_map(["time=t", "motor_force=F", "position=x"]), split_at="reversals")
    runs = [read_run(run.path) for run in import_runs(record, tmp_path, settings)]
    diagnosis = dragrig.gap_diagnose(runs, nominal="drive", without=all_but("force_drift"))
    assert len(diagnosis.held_out) == 4
    assert not any("repeated" in limitation for limitation in diagnosis.limitations)
    assert "at 6.3 mm/s: 100 %" in document_text(diagnosis_document(diagnosis))


@pytest.mark.parametrize("reported", [False, thorough(True)], ids=["no page", "page"])
def test_the_command_tells_of_files_and_writes_no_model(
    reported: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with finished_here():
        there_and_back(tmp_path, out=tmp_path / "runs", speeds_mm_s=(15, 60))
    capsys.readouterr()
    model, page = tmp_path / "model.toml", tmp_path / "page.html"
    arguments = [
        "gap",
        "diagnose",
        str(tmp_path / "runs"),
        "--nominal",
        "drive",
        "--save-model",
        str(model),
        *(("--report", str(page)) if reported else ()),
        *(word for name in UNLIKELY for word in ("--without", name)),
    ]
    assert main([*arguments, "--json"]) == 0
    output = capsys.readouterr()
    document = json.loads(output.out)
    assert document["verdict"] == "no_gap"
    assert document["model"] is None
    assert sum(hypothesis["probability"] for hypothesis in document["ranking"]) == pytest.approx(1.0)
    assert "is not written" in output.err
    assert not model.exists()
    assert page.is_file() is reported


def test_runs_without_motor_force_are_told_in_one_sentence(blanks: list[Run]) -> None:
    bare = []
    for run in blanks:
        channels = {name: values for name, values in run.trace.channels.items() if name != SIGNALS[1]}
        bare.append(replace(run, trace=replace(run.trace, channels=channels)))
    with pytest.raises(AnalysisError, match=r"drive predicts nothing of these runs \(blank\), which recorded force"):
        dragrig.gap_diagnose(bare, nominal="drive")


def test_a_model_of_ones_own_is_tried_with_effects_of_the_sensor(own: Path, blanks: list[Run]) -> None:
    foreign = dragrig.gap_diagnose(asymmetric(blanks, 0.1), nominal=own, without=UNLIKELY)
    assert foreign.verdict is Verdict.UNKNOWN
    assert foreign.unknown is not None
    assert "motor force of blank runs" in foreign.unknown.location
    assert foreign.model is None
    assert not hypotheses(foreign) & {"direction_asymmetry", "stribeck"}
    assert any("only effects of sensor and acquisition" in name for name in foreign.limitations)


FRICTION = """
    def parts(self, values, at):
        return {"dry_friction": values["coulomb_mN"] * at.direction,
                "viscous_friction": values["viscous_mN_s_mm"] * at.velocity_mm_s}

MODEL"""


@pytest.mark.parametrize("friction", [thorough("\nMODEL"), FRICTION], ids=["not declared", "declared"])
def test_a_stage_as_a_model_of_ones_own_has_it_has_no_gap(friction: str, own: Path, blanks: list[Run]) -> None:
    own.write_text(OWN.replace("\nMODEL", friction), "utf-8")
    assert dragrig.gap_diagnose(blanks, nominal=own, without=UNLIKELY).verdict is Verdict.NO_GAP


def test_a_model_that_declares_its_friction_is_tried_with_effects_of_friction(own: Path, blanks: list[Run]) -> None:
    own.write_text(OWN.replace("\nMODEL", FRICTION), "utf-8")
    without = [name for name in UNLIKELY if name not in {"adhesion", "extra_relaxation"}]
    diagnosis = dragrig.gap_diagnose(asymmetric(blanks, 0.1), nominal=own, without=without)
    assert diagnosis.effects == ("direction_asymmetry",)
    assert "stribeck" in hypotheses(diagnosis)
    untried = [text for text in diagnosis.limitations if text.startswith("Not tried, as")]
    assert untried == [
        "Not tried, as nothing in these runs would show it: adhesion.",
        "Not tried, as the model declares no relaxation: extra relaxation.",
    ]


def test_a_part_of_a_force_that_does_not_exist_is_told_in_one_sentence(own: Path, blanks: list[Run]) -> None:
    own.write_text(OWN.replace("\nMODEL", FRICTION.replace("dry_friction", "dry")), "utf-8")
    with pytest.raises(AnalysisError, match="declares a part 'dry' of its force; known are dry_friction"):
        dragrig.gap_diagnose(blanks, nominal=own)


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ('"motor_force"', '"position"', "sledge predicts position and no force in mN"),
        ('1e-3 * values["mass_g"]', 'heavy(values["mass_g"])', "NaN or infinity for motor_force"),
    ],
)
def test_a_model_that_is_no_use_is_told_in_one_sentence(
    before: str, after: str, text: str, own: Path, blanks: list[Run]
) -> None:
    heavy = "heavy = lambda mass_g: float('nan') if mass_g > 1100 else 1e-3 * mass_g\n"
    own.write_text(heavy + OWN.replace(before, after), "utf-8")
    with pytest.raises(AnalysisError, match=text):
        dragrig.gap_diagnose(blanks, nominal=own)


def test_a_capsules_campaign_may_be_of_blank_runs_alone(blanks: list[Run]) -> None:
    diagnosis = dragrig.gap_diagnose(blanks, without=all_but("force_drift", "payload_inertia", "peristalsis"))
    assert diagnosis.verdict is Verdict.NO_GAP
    assert "peristalsis" not in hypotheses(diagnosis)


def judged(model: Path, runs: list[Run]) -> tuple[str, float]:
    """Return the verdict on the promise, and the size of the one effect relative to the promised one."""
    evaluation = gap_evaluate(model, runs)
    (size,) = evaluation.sizes
    return evaluation.verdict.value, size.size


@pytest.mark.parametrize("of_ones_own", [thorough(False), thorough(True)], ids=["drive", "own model"])
def test_an_amended_model_of_any_nominal_model_keeps_its_promise_or_not(
    of_ones_own: bool, own: Path, tmp_path: Path, blanks: list[Run], fresh_blanks: list[Run]
) -> None:
    own.write_text(OWN.replace("\nMODEL", FRICTION), "utf-8")
    diagnosis = dragrig.gap_diagnose(asymmetric(blanks, 0.1), nominal=own if of_ones_own else "drive", without=UNLIKELY)
    file = save_amended_model(diagnosis, tmp_path / "amended.toml")
    assert file is not None
    verdict, size = judged(file, asymmetric(fresh_blanks, 0.1))
    assert verdict == "KEPT"
    assert size == pytest.approx(1.0, abs=0.05)
    assert judged(file, fresh_blanks) == ("NOT_KEPT", pytest.approx(0.0, abs=0.05))
    assert judged(file, asymmetric(fresh_blanks, 0.2)) == ("NOT_KEPT", pytest.approx(2.0, abs=0.1))
    forwards = [run for run in fresh_blanks if run.trace.position[-1] > run.trace.position[0]]
    assert judged(file, forwards)[0] == "NO_POWER"
    # As a nominal model it expects what was found.
    again = dragrig.gap_diagnose(asymmetric(fresh_blanks, 0.1), nominal=file, without=UNLIKELY)
    assert again.verdict is Verdict.NO_GAP


def test_an_amended_own_model_says_what_it_serves_and_finds_its_file_beside_it(
    own: Path, tmp_path: Path, blanks: list[Run], fresh_blanks: list[Run], capsys: pytest.CaptureFixture[str]
) -> None:
    diagnosis = dragrig.gap_diagnose(drifting(blanks), nominal=own, without=all_but("force_drift"))
    assert diagnosis.effects == ("force_drift",)
    (tmp_path / "moved").mkdir()
    file = save_amended_model(diagnosis, tmp_path / "moved" / "amended.toml")
    assert file is not None
    assert main(["run", "drag", "--model", str(file)]) == 2
    assert "sledge.py, which the simulated rig does not have" in capsys.readouterr().err
    moved = own.rename(file.parent / own.name)
    assert judged(file, drifting(fresh_blanks))[0] == "KEPT"
    moved.write_text(OWN.replace("coulomb_mN", "dry_mN"), "utf-8")
    with pytest.raises(SettingsError, match=r"dry_mN, .*, and were mass_g, coulomb_mN"):
        gap_evaluate(file, fresh_blanks)
    moved.unlink()
    with pytest.raises(SettingsError, match="there is no such file"):
        gap_evaluate(file, fresh_blanks)


def test_a_model_that_cannot_be_found_again_is_not_written(own: Path, blanks: list[Run]) -> None:
    model = find_model(str(own))
    assert isinstance(model, CheckedModel)
    diagnosis = dragrig.gap_diagnose(drifting(blanks), nominal=model.own, without=all_but("force_drift"))
    assert diagnosis.effects == ("force_drift",)
    assert diagnosis.model is None
    assert any("No amended model is written" in text for text in diagnosis.limitations)


def test_nothing_is_read_from_the_force_with_which_a_loop_holds_the_stage(blanks: list[Run]) -> None:
    without = all_but("cogging", "direction_asymmetry", "backlash", "servo_lag")
    diagnosis = dragrig.gap_diagnose(held_by_a_loop(blanks, 100.0, 12.0), nominal="drive", without=without)
    assert diagnosis.effects == ()
    assert any("a position loop holds the stage" in text for text in diagnosis.limitations)
    assert any("gives way to the motor force" in text and "(20 µm/N)" in text for text in diagnosis.remarks)


@pytest.mark.parametrize(
    ("amplitude_mN", "pitch_mm", "without"),
    [
        (5.0, 12.0, all_but("cogging", "velocity_ripple", "stribeck")),
        thorough(5.0, 12.0, ()),
        thorough(20.0, 27.0, ()),
        thorough(60.0, 1.3, ()),
    ],
)
def test_cogging_is_named_with_its_pitch_and_found_again(
    amplitude_mN: float,
    pitch_mm: float,
    without: tuple[str, ...],
    tmp_path: Path,
    blanks: list[Run],
    fresh_blanks: list[Run],
) -> None:
    diagnosis = dragrig.gap_diagnose(cogging(blanks, amplitude_mN, pitch_mm), nominal="drive", without=without)
    assert diagnosis.effects == ("cogging",)
    amplitude, pitch, _ = diagnosis.ranking[0].parameters
    assert amplitude.value == pytest.approx(amplitude_mN, rel=0.05)
    assert pitch.value == pytest.approx(pitch_mm, rel=0.005)
    file = save_amended_model(diagnosis, tmp_path / "amended.toml")
    assert file is not None
    assert judged(file, cogging(fresh_blanks, amplitude_mN, pitch_mm))[0] == "KEPT"
    assert judged(file, fresh_blanks) == ("NOT_KEPT", pytest.approx(0.0, abs=0.1))
    assert judged(file, held_by_a_loop(fresh_blanks, 20 * amplitude_mN, pitch_mm))[0] == "NOT_KEPT"


@pytest.mark.thorough
def test_cogging_and_friction_that_differs_with_direction_are_both_named(blanks: list[Run]) -> None:
    diagnosis = dragrig.gap_diagnose(asymmetric(cogging(blanks, 30.0, 12.0), 0.1), nominal="drive")
    assert set(diagnosis.effects) == {"cogging", "direction_asymmetry"}


def strokes_there_and_back(folder: Path, effects: list[str], speeds_mm_s: tuple[int, ...], seed: int) -> list[Run]:
    plan = folder / "strokes.toml"
    steps = ""
    for speed in speeds_mm_s:
        strokes = ", ".join(f"{{travel_mm = {way * 15}, speed_mm_s = {speed}}}" for way in (1, -1, 1, -1))
        steps += f'[[steps]]\nkind = "motion"\nfixture = "none"\nrepeats = 2\nstrokes = [{strokes}]\n'
    plan.write_text(f'name = "strokes"\n{steps}')
    return dragrig.simulate(str(plan), effects=effects, assignments=[f"rig.simulated.seed={seed}", RATE])


@pytest.mark.thorough
@pytest.mark.parametrize(("play_mm", "taken_up"), [(0.02, 0.0), (0.2, 0.3)])
def test_backlash_is_named_with_its_play_and_found_again(play_mm: float, taken_up: float, tmp_path: Path) -> None:
    backlash = [f"backlash:play_mm={play_mm},taken_up={taken_up}"]
    runs = strokes_there_and_back(tmp_path, backlash, (5, 40), seed=3)
    diagnosis = dragrig.gap_diagnose(runs, nominal="drive", without=UNLIKELY)
    assert diagnosis.effects == ("backlash",)
    play, share = diagnosis.ranking[0].parameters
    assert play.value == pytest.approx(play_mm, abs=0.001)
    assert share.value == pytest.approx(taken_up, abs=0.02)
    file = save_amended_model(diagnosis, tmp_path / "amended.toml")
    assert file is not None
    assert judged(file, strokes_there_and_back(tmp_path, backlash, (8, 25), seed=9)) == (
        "KEPT",
        pytest.approx(1.0, 0.02),
    )
    assert judged(file, strokes_there_and_back(tmp_path, [], (8, 25), seed=9)) == (
        "NOT_KEPT",
        pytest.approx(0.0, abs=0.02),
    )


@pytest.mark.thorough
@pytest.mark.parametrize("other", ["servo_lag:lag_s=0.01", "velocity_ripple:amplitude_mm=0.03", "encoder_scale"])
def test_what_is_no_backlash_is_not_called_so(other: str, tmp_path: Path) -> None:
    diagnosis = dragrig.gap_diagnose(strokes_there_and_back(tmp_path, [other], (5, 40), seed=3), nominal="drive")
    assert diagnosis.effects == (other.partition(":")[0],)
    assert next(entry.probability for entry in diagnosis.ranking if entry.hypothesis == "backlash") < 0.01


def test_a_play_shows_only_where_runs_go_both_ways(tmp_path: Path, blanks: list[Run]) -> None:
    runs = [Experiment(run) for run in strokes_there_and_back(tmp_path, ["backlash"], (5, 15), seed=3)]
    assert score_model_classes(position_errors(runs))[0].effect == "backlash"
    one_way = [run for run in blanks if run.trace.position[-1] > run.trace.position[0]]
    classes = score_model_classes(position_errors([Experiment(run) for run in one_way]))
    assert "backlash" not in {model_class.effect for model_class in classes}
