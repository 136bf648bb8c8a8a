"""dragrig: runs a linear-motor drag tester, real or simulated, and makes sense of what it records.

Examples
--------
>>> import dragrig
>>> dragrig.check("drag").findings
()
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.api import (
        Campaign,
        IdentifiedCampaign,
        Made,
        Run,
        calibrate_encoder,
        calibrate_force,
        campaign,
        check,
        compare,
        diagnose,
        diagnose_many,
        examine,
        export,
        filter,  # noqa: A004  # the word that people look for
        gap_blind,
        gap_calibrate,
        gap_cross_validate,
        gap_evaluate,
        home,
        identify,
        identify_many,
        import_run,
        isolability,
        jog,
        load,
        model,
        next_experiment,
        paper,
        report,
        resume,
        run,
        simulate,
        table,
        touch_off,
    )

__version__ = "0.1.0"

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
    # What `import dragrig` offers is loaded on first use: the command line must start without any of it.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from dragrig import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted(__all__)
