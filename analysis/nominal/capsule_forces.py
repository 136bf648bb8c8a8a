"""What the force channel shows of a capsule that sticks or touches nothing, by the friction model."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.nominal.capsule_parameters import VARIATIONS
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.protocol import Prediction, Predictor
from dragrig.config.model import FrictionModelSettings
from dragrig.config.specimen import Specimen
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import MotionProfile
from dragrig.sim_backend.friction import prepare
from dragrig.sim_backend.friction.prepared import BARE
from dragrig.sim_backend.friction.sliding import ELEMENTS

STEP = 1e-3
"""Relative step of a derivative by differences."""

RECORDED = MotionProfile.from_pieces(())
"""The profile of a run whose motion comes from the record: one for all, so that alike acquisitions are equal."""


def acquisition_of(experiment: Experiment) -> Acquisition:
    """Return what the friction model must know of a run; its motion comes from the record.

    Raises
    ------
    AnalysisError
        Where the run does not say enough of its capsule.
    """
    header = experiment.run.info.header
    specimen = Specimen(
        name=str(header.specimen.get("name") or "specimen"), wall_thickness_mm=experiment.wall_thickness_mm
    )
    return Acquisition(
        run_id=header.run_id,
        order=header.order,
        kind=experiment.kind,
        profile=RECORDED,
        capsule=experiment.capsule,
        specimen=specimen,
        fixture=experiment.fixture,
        contact=experiment.contact,
        insertion_dwell_s=experiment.insertion_dwell_s,
        shear_strain=experiment.shear_strain,
    )


def unnamed(acquisition: Acquisition) -> Acquisition:
    """Return what a run shares with those that are alike: all but which one it is."""
    return replace(acquisition, run_id="", order=0)


@dataclass(frozen=True, eq=False)
class NoForce(Predictor):
    """A blank run: nothing but the sensor's zero and noise."""

    parameters: int

    @property
    def events_s(self) -> FloatArray:
        """No time stands out."""
        return np.zeros(0)

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Return zeros."""
        del values
        return Prediction(np.zeros_like(time_s), np.zeros((len(VARIATIONS), len(time_s))))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return zeros."""
        del values
        return np.zeros((self.parameters, len(time_s)))


@dataclass(frozen=True, eq=False)
class StickingPredictor(Predictor):
    """A relaxation: a capsule that sticks to the wall and shears it."""

    acquisition: Acquisition
    experiment: Experiment
    settings: FrictionModelSettings
    names: tuple[str, ...]

    @property
    def events_s(self) -> FloatArray:
        """Where the motion bends."""
        return self.experiment.motion.breaks_s

    @property
    def likeness(self) -> Hashable:
        """All but which run it is."""
        bare = self.settings.model_copy(update=BARE)
        return unnamed(self.acquisition), self.experiment.followed, bare, self.names

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the shear force, all of which is stiffness."""
        total = self._force(dict(zip(self.names, values.tolist(), strict=True)), time_s)
        return Prediction(total, np.stack((total, np.zeros_like(total))))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return exact derivatives where the force is proportional, differences for the elements."""
        given = dict(zip(self.names, values.tolist(), strict=True))
        total = self._force(given, time_s)
        rows = {name: total / given[name] for name in ("force_gain", "stiffness_scale")}
        rows |= _by_elements(lambda changed: self._force(changed, time_s), given, rows["stiffness_scale"])
        return stacked(self.names, rows, len(time_s))

    def _force(self, values: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        return prepare(self.acquisition, self.settings.model_copy(update=values), self.experiment.followed).force(
            time_s
        )


def _by_elements(
    total: Callable[[Mapping[str, float]], FloatArray], given: Mapping[str, float], by_common: FloatArray
) -> dict[str, FloatArray]:
    """Return derivatives by the five scales; the last follows, as all five scaled alike are the common scale."""
    before = total(given)
    rows: dict[str, FloatArray] = {}
    left = by_common * given["stiffness_scale"]
    for name in ELEMENTS[:-1]:
        step = STEP * given[name]
        rows[name] = (total({**given, name: given[name] + step}) - before) / step
        left = left - rows[name] * given[name]
    rows[ELEMENTS[-1]] = left / given[ELEMENTS[-1]]
    return rows


def stacked(names: tuple[str, ...], rows: Mapping[str, FloatArray], samples: int) -> FloatArray:
    """Return derivatives in the order of the parameters, shape `(P, samples)`; zeros by what has none."""
    nothing = np.zeros(samples)
    return np.stack([rows.get(name, nothing) for name in names])
