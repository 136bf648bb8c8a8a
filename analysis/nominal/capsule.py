"""The paper's friction model as a nominal model: what a drag tester with a capsule and a gut shows without any gap."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from dragrig.analysis.nominal.capsule_forces import NoForce, StickingPredictor, acquisition_of
from dragrig.analysis.nominal.capsule_parameters import CHANNEL, COMBINATIONS, VARIATIONS, ZERO_SD_MN, parameters_of
from dragrig.analysis.nominal.capsule_sliding import SlidingPredictor
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.protocol import Combination, NominalModel, Parameter, Predictor, Variation
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.devices import Contact


@dataclass(frozen=True)
class CapsuleModel(NominalModel):
    """The friction model of `settings`, whose scales, friction coefficient and contact angle runs determine."""

    settings: FrictionModelSettings

    @property
    def name(self) -> str:
        """Name in settings and reports."""
        return "capsule"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Scales, friction coefficient, gain and contact angle, with what is known of any specimen."""
        return parameters_of(self.settings)

    @property
    def variations(self) -> tuple[Variation, ...]:
        """How runs on one specimen differ."""
        return VARIATIONS

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What the force channel shows of each scale, the gain in it, and the time constants."""
        return COMBINATIONS

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """The force sensor's zero [mN]."""
        return {CHANNEL: ZERO_SD_MN}

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the force of a run; raises `AnalysisError` where the run does not say its capsule or fixture."""
        if CHANNEL not in experiment.run.trace.channels:
            return {}
        if experiment.contact is Contact.NONE:
            return {CHANNEL: NoForce(len(self.parameters))}
        names = tuple(one.name for one in self.parameters)
        if experiment.contact is Contact.STICKING:
            return {CHANNEL: StickingPredictor(acquisition_of(experiment), experiment, self.settings, names)}
        acquisition, motion = acquisition_of(experiment), experiment.motion
        return {CHANNEL: SlidingPredictor(acquisition, motion, self.settings, names, experiment.obeyed)}

    def settings_of(self, values: Mapping[str, float]) -> FrictionModelSettings:
        """Return the model's settings with identified values in place."""
        return self.settings.model_copy(update=dict(values))

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return the settings as the simulated backend loads them."""
        return self.settings_of(values).model_dump(mode="json", exclude_defaults=False)


MODEL = CapsuleModel(FrictionModelSettings())
"""The model with the paper's values."""
