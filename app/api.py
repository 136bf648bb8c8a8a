"""What people type they can also call: the functions behind `import dragrig`."""

from dragrig.blind.holding import gap_blind
from dragrig.calibrating import calibrate_encoder, calibrate_force
from dragrig.campaigns import Made
from dragrig.comparing import compare
from dragrig.diagnosing import diagnose, gap_evaluate
from dragrig.diagnosing_many import diagnose_many
from dragrig.evaluating import campaign, export, filter, load, model, table  # noqa: A004  # the word people look for
from dragrig.examining import examine
from dragrig.gap_calibrating import gap_calibrate, gap_cross_validate
from dragrig.handling import home, jog, touch_off
from dragrig.identifying import IdentifiedCampaign, identify
from dragrig.identifying_many import identify_many
from dragrig.importing import import_run
from dragrig.isolating import isolability
from dragrig.measuring import check, resume, run, simulate
from dragrig.planning import next_experiment
from dragrig.reporting import report
from dragrig.reproducing import paper
from dragrig.rig.runfile import Campaign
from dragrig.rig.runfile.model import Run

__all__ = [
    "Campaign",
    "IdentifiedCampaign",
    "Made",
    "Run",
    "calibrate_encoder",
    "calibrate_force",
    "campaign",
    "check",
    "compare",
    "diagnose",
    "diagnose_many",
    "examine",
    "export",
    "filter",
    "gap_blind",
    "gap_calibrate",
    "gap_cross_validate",
    "gap_evaluate",
    "home",
    "identify",
    "identify_many",
    "import_run",
    "isolability",
    "jog",
    "load",
    "model",
    "next_experiment",
    "paper",
    "report",
    "resume",
    "run",
    "simulate",
    "table",
    "touch_off",
]
