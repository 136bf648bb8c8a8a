"""dragrig: runs a linear-motor drag tester, real or simulated, and evaluates what it records.

Examples
--------
>>> import dragrig
>>> dragrig.check("drag").findings
()
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.api.compare import compare
    from dragrig.api.diagnose import diagnose, diagnose_many, gap_evaluate
    from dragrig.api.evaluate import (
        campaign,
        export,
        filter,  # noqa: A004  # the word that people look for
        import_run,
        load,
        model,
        table,
    )
    from dragrig.api.identify import IdentifiedCampaign, identify, identify_many
    from dragrig.api.measure import check, examine, resume, run, simulate
    from dragrig.api.plan_next import isolability, next_experiment
    from dragrig.api.report import paper, report
    from dragrig.api.stage import calibrate_encoder, calibrate_force, home, jog, touch_off
    from dragrig.campaign_session import Made
    from dragrig.exam.blind_exam import gap_blind
    from dragrig.exam.learning import gap_calibrate, gap_cross_validate
    from dragrig.rig.runfile import Campaign
    from dragrig.rig.runfile.model import Run

__version__ = "0.1.0"

_MODULES = {
    "Campaign": "dragrig.rig.runfile",
    "IdentifiedCampaign": "dragrig.api.identify",
    "Made": "dragrig.campaign_session",
    "Run": "dragrig.rig.runfile.model",
    "calibrate_encoder": "dragrig.api.stage",
    "calibrate_force": "dragrig.api.stage",
    "campaign": "dragrig.api.evaluate",
    "check": "dragrig.api.measure",
    "compare": "dragrig.api.compare",
    "diagnose": "dragrig.api.diagnose",
    "diagnose_many": "dragrig.api.diagnose",
    "examine": "dragrig.api.measure",
    "export": "dragrig.api.evaluate",
    "filter": "dragrig.api.evaluate",
    "gap_blind": "dragrig.exam.blind_exam",
    "gap_calibrate": "dragrig.exam.learning",
    "gap_cross_validate": "dragrig.exam.learning",
    "gap_evaluate": "dragrig.api.diagnose",
    "home": "dragrig.api.stage",
    "identify": "dragrig.api.identify",
    "identify_many": "dragrig.api.identify",
    "import_run": "dragrig.api.evaluate",
    "isolability": "dragrig.api.plan_next",
    "jog": "dragrig.api.stage",
    "load": "dragrig.api.evaluate",
    "model": "dragrig.api.evaluate",
    "next_experiment": "dragrig.api.plan_next",
    "paper": "dragrig.api.report",
    "report": "dragrig.api.report",
    "resume": "dragrig.api.measure",
    "run": "dragrig.api.measure",
    "simulate": "dragrig.api.measure",
    "table": "dragrig.api.evaluate",
    "touch_off": "dragrig.api.stage",
}
"""Where each public name is; loaded on first use, because the command line must start without any of it."""

__all__ = [
    "Campaign",
    "IdentifiedCampaign",
    "Made",
    "Run",
    "__version__",
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


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
