"""Pictures of run files and of the friction model; matplotlib is loaded when a function is first asked for."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.figures.campaign import campaign_figure
    from dragrig.figures.comparison import comparison_figure
    from dragrig.figures.coulomb import coulomb_figure
    from dragrig.figures.gap_before_after import gap_before_after_figure
    from dragrig.figures.gap_ranking import gap_ranking_figure
    from dragrig.figures.joint_fit import joint_figure
    from dragrig.figures.model import forces_figure, skew_figure
    from dragrig.figures.overview import comparison_overview
    from dragrig.figures.relaxation_fit import relaxation_fit_figure
    from dragrig.figures.run import run_figure
    from dragrig.figures.saving import save, save_in
    from dragrig.figures.steady import drag_figure
    from dragrig.figures.wall import wall_figure

__all__ = [
    "campaign_figure",
    "comparison_figure",
    "comparison_overview",
    "coulomb_figure",
    "drag_figure",
    "forces_figure",
    "gap_before_after_figure",
    "gap_ranking_figure",
    "joint_figure",
    "relaxation_fit_figure",
    "run_figure",
    "save",
    "save_in",
    "skew_figure",
    "wall_figure",
]

_HOME = {
    "campaign_figure": "campaign",
    "comparison_figure": "comparison",
    "comparison_overview": "overview",
    "coulomb_figure": "coulomb",
    "drag_figure": "steady",
    "forces_figure": "model",
    "gap_before_after_figure": "gap_before_after",
    "gap_ranking_figure": "gap_ranking",
    "relaxation_fit_figure": "relaxation_fit",
    "joint_figure": "joint_fit",
    "run_figure": "run",
    "save": "saving",
    "save_in": "saving",
    "skew_figure": "model",
    "wall_figure": "wall",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
