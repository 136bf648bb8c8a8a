"""What the report on the paper's programme is about."""

from collections.abc import Mapping
from dataclasses import dataclass

from dragrig.analysis.identification.identify import identified_settings
from dragrig.analysis.identification.results import CoulombRun, Identification
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.paper.elements import ElementRow
from dragrig.analysis.paper.finding import Finding
from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.runfile.model import Run


@dataclass(frozen=True, slots=True, eq=False)
class PaperResults:
    """The simulated programme, what was identified from it, and what was found in the paper.

    Attributes
    ----------
    model, capsule, wall_thickness_mm
        What was simulated: the model, the drag test's capsule, the wall.
    runs
        How many runs were made, ways back included.
    of_run
        The model that each run was simulated with, its own variation included, by the file's name.
    coulomb_trace
        The Coulomb test's run; None when there is none.
    """

    model: FrictionModelSettings
    capsule: Capsule
    wall_thickness_mm: float
    rig: RigSettings
    runs: int
    of_run: Mapping[str, FrictionModelSettings]
    identification: Identification
    elements: tuple[ElementRow, ...]
    findings: tuple[Finding, ...]
    coulomb_trace: Run | None

    @property
    def coulomb(self) -> CoulombRun | None:
        """What was identified from the Coulomb test."""
        found = self.identification.coulomb
        return found.runs[0] if found is not None and found.runs else None

    @property
    def identified_model(self) -> FrictionModelSettings | None:
        """The model with what the joint fit determined in place; None without one that converged."""
        joint = self.identification.joint
        if joint is None or not joint.converged:
            return None
        return identified_settings(CapsuleModel(self.model), joint)
