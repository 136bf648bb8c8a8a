"""The paper's own question: is it a wall that cannot follow or a hyperelastic one, and is 20 mm/s a boundary.

`python bench/paper_question.py` prints how far apart the two are under the paper's programme and under parts of it, and
what a diagnosis says of simulated campaigns of that programme with either of them.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from dataclasses import replace

import dragrig
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.setup import resolve

PAIR = ("wall_lift_off", "hyperelastic_wall")
POSITION = ("encoder_scale", "servo_lag", "velocity_ripple")
HIDDEN = (
    (),
    ("wall_lift_off:share=0.6,speed_mm_s=25,power=3",),
    ("wall_lift_off:share=0.2,speed_mm_s=25,power=3",),
    ("wall_lift_off:share=0.6,speed_mm_s=10,power=3",),
    ("wall_lift_off:share=0.6,speed_mm_s=40,power=3",),
    ("hyperelastic_wall:stiffening=0.3",),
    ("hyperelastic_wall:stiffening=0.1",),
)


def parts() -> dict[str, Plan]:
    """Return the paper's programme, and parts of it."""
    whole = resolve("paper", backend="simulated").plan
    drags = tuple(step for step in whole.steps if step.kind == "drag")
    speeds = drags[0].parameters["speed_mm_s"]
    slow = [speed for speed in speeds if speed <= 20] if isinstance(speeds, list) else []
    slowly = drags[0].model_copy(update={"parameters": {**drags[0].parameters, "speed_mm_s": slow}})
    return {
        "paper": whole,
        "drags alone": replace_steps(whole, drags),
        "drags up to 20 mm/s alone": replace_steps(whole, (slowly,)),
        "relaxations alone": replace_steps(whole, tuple(step for step in whole.steps if step.kind == "relaxation")),
        "diagnose": resolve("diagnose", backend="simulated").plan,
    }


def replace_steps(plan: Plan, steps: tuple[object, ...]) -> Plan:
    """Return a plan with other steps."""
    return plan.model_copy(update={"steps": steps})


def angles() -> None:
    """Print how far the two are apart, and from their nearest rivals."""
    for name, plan in parts().items():
        isolability = dragrig.gap_isolability(plan, without=POSITION)
        seen = {effect.effect: effect for effect in isolability.effects}
        for effect in PAIR:
            entry = seen[effect]
            minimum = (
                "not seen" if entry.smallest is None else f"from {entry.smallest:.3f} on ({entry.smallest_mN:.1f} mN)"
            )
            near = [pair for pair in isolability.pairs if effect in pair.effects][:2]
            text = [f"{pair.effects} sin² {pair.sin2:.2f} d′ {pair.separation:.0f}" for pair in near]
            print(f"{name}: {effect} d′ {entry.d_prime:.0f}, {minimum}; nearest {'; '.join(text)}", flush=True)
        pair = isolability.pair(*PAIR)
        if pair is not None:
            print(f"{name}: sin² {pair.sin2:.3f}, d′ {pair.d_prime[0]:.0f} and {pair.d_prime[1]:.0f}", flush=True)


def campaigns() -> None:
    """Print what a diagnosis says of the paper's programme with either effect."""
    model = CapsuleModel(FrictionModelSettings(name="paper"))
    for effects in HIDDEN:
        chosen = choose_runs(dragrig.simulate("paper", effects=list(effects)))
        drags = replace(chosen, experiments=chosen.of_kind("drag"))
        for name, selection in (("paper", chosen), ("its drags alone", drags)):
            diagnosis = diagnose(selection, model)
            top = diagnosis.ranking[0]
            values = ", ".join(
                f"{parameter.name} {parameter.value:.3g} ± {parameter.standard_error:.2g}"
                for parameter in top.parameters
            )
            rivals = [f"{hypothesis.hypothesis} {hypothesis.probability:.2f}" for hypothesis in diagnosis.ranking[1:3]]
            print(
                f"{effects or 'nothing'} by {name}: {diagnosis.verdict.value} {diagnosis.effects} {top.probability:.2f}"
            )
            print(f"    {values}; next {rivals}; confusable {diagnosis.confusable_with}")
            if diagnosis.shrink is not None:
                ratio, squared = diagnosis.shrink.r2_eq15, diagnosis.shrink.r2_corr
                answer = [ratio.before_below, ratio.before_above, squared.before_below, squared.before_above]
                spelled = ["none" if entry is None else f"{entry:.3f}" for entry in answer]
                print(
                    f"    R², ratio of Eq. 15 and squared correlation, below and above 20 mm/s: {spelled}", flush=True
                )


if __name__ == "__main__":
    angles()
    campaigns()
