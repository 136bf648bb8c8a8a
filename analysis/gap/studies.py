"""Which study a nominal model needs."""

from collections.abc import Sequence

from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.own_study import OwnStudy
from dragrig.analysis.gap.stage_study import StageStudy
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.nominal.drive import DriveModel
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.sim_backend.effects.base import Effect


def study_of(selection: Selection, nominal: NominalModel, effects: Sequence[Effect]) -> Study:
    """Prepare a campaign; raises `AnalysisError` where the model predicts nothing of any run.

    Parameters
    ----------
    effects
        Candidates of the force channel, of which those are kept that can act.
    """
    match nominal:
        case CapsuleModel():
            return CapsuleStudy.of(selection, nominal, effects)
        case DriveModel():
            return StageStudy.of(selection, nominal, effects)
        case _:
            return OwnStudy.of(selection, nominal, effects)
