"""What people type they can also call: the functions behind `import dragrig`."""

from dragrig.calibrating import calibrate_encoder, calibrate_force
from dragrig.campaigns import Made
from dragrig.comparing import compare
from dragrig.diagnosing import diagnose, gap_evaluate
from dragrig.evaluating import campaign, export, filter, load, model, table  # noqa: A004  # the word people look for
from dragrig.examining import examine
from dragrig.handling import home, jog, touch_off
from dragrig.identifying import IdentifiedCampaign, identify
from dragrig.importing import import_run
from dragrig.measuring import check, resume, run, simulate
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
    "examine",
    "export",
    "filter",
    "gap_evaluate",
    "home",
    "identify",
    "import_run",
    "jog",
    "load",
    "model",
    "paper",
    "resume",
    "run",
    "simulate",
    "table",
    "touch_off",
]
