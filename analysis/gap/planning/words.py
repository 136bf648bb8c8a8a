"""What is recommended, in words."""

from dragrig.analysis.gap.planning.results import Contest, NextRun
from dragrig.analysis.gap.sentences import capital, name_of, percent
from dragrig.config.plan import Step

MOSTLY = 0.9
"""A rival that leaves more than this share resembles the truth so little that the share is not told."""


def run_in_words(step: Step) -> str:
    """Say what a run is: a drag at 1 mm/s over 20 mm."""
    settings = step.parameters
    match step.kind:
        case "relaxation":
            strain, hold = settings["shear_strain"], settings["hold_s"]
            assert isinstance(strain, float)  # noqa: S101  # the grid's own
            said = f"a relaxation at {100 * strain:g} % strain, held for {hold:g} s"
        case "motion":
            strokes = settings["strokes"]
            assert isinstance(strokes, list | tuple)  # noqa: S101
            first = strokes[0]
            said = f"a drag of {first['travel_mm']:g} mm and back at {first['speed_mm_s']:g} mm/s in one record"
        case kind:
            what = {"coulomb": "a Coulomb run", "blank": "a blank run"}.get(kind, f"a {kind}")
            said = f"{what} at {settings['speed_mm_s']:g} mm/s over {settings['travel_mm']:g} mm"
            if settings.get("accel_mm_s2", 400.0) != 400.0:
                said += f", accelerated with {settings['accel_mm_s2']:g} mm/s²"
    if step.kind == "drag" and step.wait_s != 60.0:
        said += f" after {step.wait_s:g} s of rest"
    if step.repeats == 1:
        return said
    return f"{said}, twice" if step.repeats == 2 else f"{said}, {step.repeats} times"


def why(run: NextRun, tried: int) -> str:
    """Say why a run is recommended, with numbers, and that it need not be where that is so."""
    said = f"{subject(run.step)} {what_it_does(run.before, run.after)}"
    return (
        f"{'What is likely is told apart well enough already. ' if run.surer else ''}{said} "
        f"in {run.minutes:.1f} min of rig time, more per minute than any other of {tried} runs that were compared."
    )


def subject(step: Step) -> str:
    """Let a sentence begin with a run."""
    return capital(run_in_words(step)) + ("," if step.repeats > 1 else "")


def what_it_does(before: Contest, after: Contest) -> str:
    """Say what a run decides, as the rest of a sentence."""
    grows = f"d′ grows from {before.d_prime:.1f} to {after.d_prime:.1f}"
    if not after.rival:
        return f"would show a smaller {name_of(after.truth)}: its {grows}"
    truth, rival = name_of(after.truth), name_of(after.rival)
    said = f"separates {truth} from {rival}: {grows}"
    if before.left > MOSTLY:
        return said
    return f"{said}, and what {rival} leaves of {truth} from {percent(before.left)} to {percent(after.left)}"
