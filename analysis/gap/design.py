"""A campaign prepared for a diagnosis, and its linearisation: all columns that may explain a residual, whitened by run.

All fits, held-out scores and forward selection that follow work on the Gram matrices of this design alone.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Self

import numpy as np

from dragrig.analysis.gap.candidates import (
    Candidate,
    EffectVariant,
    added_force,
    chain_with,
    parameter_derivatives,
    signatures,
    variants_of,
)
from dragrig.analysis.gap.run_data import RunData, smooth_modulations
from dragrig.analysis.inference.linear_gaussian import JointProblem, Whitening
from dragrig.analysis.models.capsule_model import ANGLE_PARAMETER
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.arrays import BoolArray, FloatArray, IndexArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.effects.base import Effect, EffectChain, Location
from dragrig.sim_backend.effects.run_state import RunState


@dataclass(frozen=True, eq=False)
class Study(ABC):
    """The force of a campaign's runs, ready to be explained; what a nominal model is to it, a subclass says.

    Attributes
    ----------
    problem
        Evidence, noise and priors.
    sights
        The runs.
    effects
        Candidates of the force channel.
    """

    problem: JointProblem
    sights: tuple[RunData, ...]
    effects: tuple[Effect, ...]

    @abstractmethod
    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run, and the gain of the channel that shows it."""

    def scenes(self, z: FloatArray) -> Iterator[tuple[RunState, float]]:
        """Give `scene` of each run in turn; that of a repeat shares all but its place in the session with the first."""
        first: dict[int, tuple[RunState, float]] = {}
        for number, (sight, like) in enumerate(zip(self.sights, self.problem.representatives, strict=True)):
            if like == number:
                first[number] = self.scene(number, z)
                yield first[number]
                continue
            scene, gain = first[like]
            order = sight.experiment.run.info.header.order
            yield replace(scene, session_start_s=sight.session_start_s, order=order), gain

    @abstractmethod
    def open_questions(self) -> Iterator[str]:
        """Say what these runs and this model leave open, a sentence each."""

    @property
    def chain(self) -> EffectChain:
        """Effects that the nominal model has already; none unless said."""
        return EffectChain()

    @property
    def start(self) -> FloatArray:
        """Nominal parameters in units of their priors that a diagnosis starts from: what is known before any run."""
        return np.zeros(len(self.names))

    def details(self, number: int, scene: RunState) -> FloatArray:
        """Return what each detail of the model that may be off changes, shape `(D, n)`; none unless said."""
        del number
        return np.zeros((0, scene.time_s.size))

    def doubts(self, z: FloatArray) -> list[FloatArray]:
        """Return what is not known of each run's block means beside its noise, one standard deviation, shape `(B,)`."""
        return self.problem.uncertainties(z)

    def counted(self, number: int, motion_sd: FloatArray) -> BoolArray | None:
        """Return the blocks of a run that say how large a gap is, shape `(B,)`; None, all of them, unless said.

        Parameters
        ----------
        motion_sd
            What the motion leaves uncertain of each block [mN], shape `(B,)`.
        """
        del number, motion_sd
        return None

    def simulator(self, z: FloatArray) -> FrictionModelSettings | None:
        """Return the friction model that effects may be added to for the simulator; None unless there is one."""
        del z
        return None

    def untold(self, design: "Design") -> int:
        """Return how many effects that cannot be tried may look like a design's candidates; 0 unless said."""
        del design
        return 0

    @property
    def channel(self) -> str:
        """The force that is explained."""
        return self.problem.channels[0].channel

    def of_runs(self, kept: Sequence[int]) -> Self:
        """Return the study of some of the runs, in their order; noise and priors stay as all runs give them."""
        return replace(
            self, problem=problem_of_runs(self.problem, kept), sights=tuple(self.sights[one] for one in kept)
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the nominal parameters."""
        return tuple(one.name for one in self.problem.nominal.parameters)

    @cached_property
    def shapes(self) -> tuple[EffectVariant, ...]:
        """Every shape of every candidate."""
        return variants_of(self.effects)

    @cached_property
    def modulations(self) -> tuple[FloatArray, ...]:
        """Smooth functions that a foreign form may differ by, for each run, shape `(K, B)`."""
        return smooth_modulations(self.sights)

    def values(self, z: FloatArray) -> Mapping[str, float]:
        """Return nominal parameters in units of their priors as values by name."""
        return dict(zip(self.names, self.problem.scales.values(z).tolist(), strict=True))


def problem_of_runs(problem: JointProblem, kept: Sequence[int]) -> JointProblem:
    """Return a problem with some of its evidence, in that order."""
    return replace(
        problem,
        channels=tuple(problem.channels[one] for one in kept),
        noises=tuple(problem.noises[one] for one in kept),
        zero_sds=tuple(problem.zero_sds[one] for one in kept),
    )


ANGLE_SECANT_SD = 0.6
"""Half its width, in prior standard deviations of the contact angle."""
WALL_PLACES = (Location.WALL, Location.SPECIMEN)
"""What acts there is stiffness where a capsule sticks, and differs from run to run as the wall's stiffness does."""
MODULATION_PRIOR_SD = 0.2
"""Prior of each modulation: how much a real effect differs from the catalogue's form, relative."""


class ColumnKind(StrEnum):
    """What a column of a design is."""

    NOMINAL = "nominal"
    DETAIL = "detail"
    EFFECT = "effect"
    FOREIGN = "foreign"
    SHAPE = "shape"


@dataclass(frozen=True, slots=True, eq=False)
class RunDesign:
    """One run of a design.

    Attributes
    ----------
    residual
        Measured less predicted block means [mN], shape `(B,)`.
    columns
        What changes it, not whitened, shape `(B, C)`.
    added
        What the candidates add beside effects of the nominal model, shape `(B,)`.
    predicted
        Nominal prediction, shape `(B,)`.
    repeat_sd, motion_sd
        What repeats differ by, and what the motion and a programme's steps leave uncertain, one standard deviation,
        shape `(B,)`.
    whitening
        What makes its blocks independent.
    """

    residual: FloatArray
    columns: FloatArray
    added: FloatArray
    predicted: FloatArray
    repeat_sd: FloatArray
    motion_sd: FloatArray
    whitening: Whitening


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """A campaign around a point.

    Attributes
    ----------
    z, candidates
        The point: nominal parameters in units of their priors, and effects.
    parts
        The runs.
    kinds
        What each of `C` columns is.
    prior_mean, prior_precision
        Of the columns' coefficients, shape `(C,)`; shapes have none, for they are tried one by one.
    grams
        Gram matrix of residual and columns, whitened, for each run, shape `(1 + C, 1 + C)`; the residual comes first.
    blocks
        Number of blocks of each run.
    shapes
        The dictionary, in the order of the columns of `Part.SHAPE`.
    """

    z: FloatArray
    candidates: tuple[Candidate, ...]
    parts: tuple[RunDesign, ...]
    kinds: tuple[ColumnKind, ...]
    prior_mean: FloatArray
    prior_precision: FloatArray
    grams: tuple[FloatArray, ...]
    blocks: tuple[int, ...]
    shapes: tuple[EffectVariant, ...]

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of all runs' covariances, which depend on what is predicted."""
        whitenings = [one.whitening for one in self.parts]
        noise = sum(2 * float(np.log(np.diag(one.noise_root)).sum()) for one in whitenings)
        return noise - sum(2 * float(np.log1p(-one.shrinkage).sum()) for one in whitenings)

    def of(self, *wanted: ColumnKind) -> IndexArray:
        """Return which columns are of these kinds."""
        return np.array([index for index, kind in enumerate(self.kinds) if kind in wanted], dtype=np.intp)

    def columns(self, part: ColumnKind) -> list[FloatArray]:
        """Return the columns of a kind for each run, shape `(B, c)`."""
        wanted = self.of(part)
        return [one.columns[:, wanted] for one in self.parts]

    @property
    def whitenings(self) -> tuple[Whitening, ...]:
        """What makes each run's blocks independent."""
        return tuple(one.whitening for one in self.parts)

    def kept(self, *wanted: ColumnKind) -> "Design":
        """Return the design with the columns of these kinds alone, so that little of it stays in memory."""
        columns = self.of(*wanted)
        rows = np.concatenate(([0], 1 + columns))
        return replace(
            self,
            parts=tuple(replace(one, columns=one.columns[:, columns]) for one in self.parts),
            kinds=tuple(self.kinds[one] for one in columns.tolist()),
            prior_mean=self.prior_mean[columns],
            prior_precision=self.prior_precision[columns],
            grams=tuple(one[np.ix_(rows, rows)] for one in self.grams),
            shapes=self.shapes if ColumnKind.SHAPE in wanted else (),
        )

    def total(self, runs: Sequence[int] | None = None) -> FloatArray:
        """Sum the Gram matrices of some runs, of all unless said."""
        chosen = range(len(self.grams)) if runs is None else runs
        whole = np.zeros_like(self.grams[0])
        for one in chosen:
            whole += self.grams[one]
        return whole


def linearise(
    study: Study,
    z: FloatArray,
    candidates: Sequence[Candidate] = (),
    *,
    near: Design | None = None,
    foreign: bool = False,
    dictionary: bool = False,
) -> Design:
    """Linearise a campaign around a point.

    Parameters
    ----------
    near
        The campaign around a point nearby, whose derivatives by nuisances and whose doubts are taken over; computed
        anew unless given.
    foreign
        Whether the candidates' contributions may be modulated.
    dictionary
        Whether every shape of every effect is a column too.
    """
    problem = study.problem
    predictions = problem.predictions(z)
    uncertainties = study.doubts(z) if near is None else [one.motion_sd for one in near.parts]
    whitenings = problem.whitenings(predictions, uncertainties, None if near is None else near.whitenings)
    by_nominal = _nominal_derivatives(study, z) if near is None else near.columns(ColumnKind.NOMINAL)
    kept_details = None if near is None else near.columns(ColumnKind.DETAIL)
    parts, grams, known = [], [], dict[int, FloatArray]()
    wall = _wall_effects(chain_with(candidates, study.chain))
    for number, (sight, (scene, gain)) in enumerate(zip(study.sights, study.scenes(z), strict=True)):
        alone = [added_force(chain_with([one], study.chain), scene, gain) for one in candidates]
        before = added_force(study.chain, scene, gain)
        together = (
            added_force(chain_with(candidates, study.chain), scene, gain) if len(alone) > 1 else sum(alone, before * 0)
        )
        more = sight.of_blocks(together if alone else before)
        beside = sight.of_blocks(together - before) if alone else 0.0 * more
        if kept_details is None:
            details = gain * sight.of_blocks(study.details(number, scene))
        else:
            details = kept_details[number].T
        rows = [details]
        rows.append(sight.of_blocks(parameter_derivatives(candidates, study.chain, scene, gain)))
        if foreign:
            rows += [study.modulations[number] * sight.of_blocks(one - before) for one in alone]
        if dictionary:
            like = problem.representatives[number]
            shown = signatures(study.shapes, scene, gain, known.get(like))
            known.setdefault(like, shown)
            rows.append(sight.of_blocks(shown))
        whitening = whitenings[number]
        if wall.effects and sight.acquisition.contact is Contact.STICKING:
            stiff = sight.of_blocks(added_force(wall, scene, gain))
            whitening = problem.with_stiffness(number, predictions[number], stiff, whitening)
        residual = sight.evidence.blocks.mean - predictions[number].total - more
        columns = np.column_stack((by_nominal[number], *(one.T for one in rows)))
        varying = problem.variation_sds[:, None] * predictions[number].varying
        spread = np.sqrt(np.sum(varying**2, axis=0)), uncertainties[number]
        parts.append(RunDesign(residual, columns, beside, predictions[number].total, *spread, whitening))
        white = whitening.whiten(np.column_stack((residual, columns)))
        grams.append(white.T @ white)
    priors = _column_priors(z, len(details), candidates, len(study.modulations[0]) if foreign else 0)
    shapes = study.shapes if dictionary else ()
    kinds, mean, precision = zip(*priors, *[(ColumnKind.SHAPE, 0.0, 0.0)] * len(shapes), strict=True)
    return Design(
        z=z,
        candidates=tuple(candidates),
        parts=tuple(parts),
        kinds=kinds,
        prior_mean=np.array(mean),
        prior_precision=np.array(precision),
        grams=tuple(grams),
        blocks=tuple(len(one.residual) for one in parts),
        shapes=shapes,
    )


def _wall_effects(chain: EffectChain) -> EffectChain:
    """Return what of a chain acts on the wall itself."""
    return chain.only(lambda effect: effect.location in WALL_PLACES)


def _nominal_derivatives(study: Study, z: FloatArray) -> list[FloatArray]:
    """Return the derivatives of block means by `z`; by a secant where they jump.

    With the contact angle the moment changes at which friction jumps, when a bend of the motion comes to the equator. A
    tangent leaves these jumps out, and a fit that follows it stops beside the minimum.
    """
    found = study.problem.derivatives(z, without=(ANGLE_PARAMETER,))
    if ANGLE_PARAMETER not in study.names:
        return found
    column = study.names.index(ANGLE_PARAMETER)
    sides = []
    for side in (1.0, -1.0):
        turned = z.copy()
        turned[column] += side * ANGLE_SECANT_SD
        sides.append(study.problem.predictions(turned))
    for one, more, less in zip(found, *sides, strict=True):
        one[:, column] = (more.total - less.total) / (2 * ANGLE_SECANT_SD)
    return found


def _column_priors(
    z: FloatArray, details: int, candidates: Sequence[Candidate], modulations: int
) -> list[tuple[ColumnKind, float, float]]:
    priors = [(ColumnKind.NOMINAL, -value, 1.0) for value in z.tolist()]
    priors += [(ColumnKind.DETAIL, 0.0, 1.0)] * details
    for one in candidates:
        priors += [(ColumnKind.EFFECT, 0.0, sd**-2) for sd in one.prior_sds().tolist()]
    priors += [(ColumnKind.FOREIGN, 0.0, MODULATION_PRIOR_SD**-2)] * (modulations * len(candidates))
    return priors
