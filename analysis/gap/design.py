"""The campaign as a linear problem around a point: everything that may explain a residual, whitened, run by run.

What follows (fits, scores on runs that took no part, forward selection) is algebra with the Gram matrices alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from dragrig.analysis.gap.candidate import Candidate, added, chain_of, slopes
from dragrig.analysis.gap.signatures import Shape, signatures
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.joint.evidence import Whitening
from dragrig.analysis.nominal.capsule_parameters import ANGLE
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.effects.applied import Chain
from dragrig.sim_backend.effects.base import Place

IndexArray = npt.NDArray[np.intp]
SECANT = 0.6
"""Half its width, in prior standard deviations of the contact angle."""
OF_WALL = (Place.WALL, Place.SPECIMEN)
"""What acts there is stiffness where a capsule sticks, and differs from run to run as the wall's stiffness does."""
FOREIGN_SD = 0.2
"""Prior of each modulation: how much a real effect differs from the catalogue's form, relative."""


class Part(StrEnum):
    """What a column of a design is."""

    NOMINAL = "nominal"
    DETAIL = "detail"
    EFFECT = "effect"
    FOREIGN = "foreign"
    SHAPE = "shape"


@dataclass(frozen=True, slots=True, eq=False)
class RunPart:
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
    parts: tuple[RunPart, ...]
    kinds: tuple[Part, ...]
    prior_mean: FloatArray
    prior_precision: FloatArray
    grams: tuple[FloatArray, ...]
    blocks: tuple[int, ...]
    shapes: tuple[Shape, ...]

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of all runs' covariances, which depend on what is predicted."""
        whitenings = [one.whitening for one in self.parts]
        noise = sum(2 * float(np.log(np.diag(one.noise_root)).sum()) for one in whitenings)
        return noise - sum(2 * float(np.log1p(-one.shrinkage).sum()) for one in whitenings)

    def of(self, *wanted: Part) -> IndexArray:
        """Return which columns are of these kinds."""
        return np.array([index for index, kind in enumerate(self.kinds) if kind in wanted], dtype=np.intp)

    def columns(self, part: Part) -> list[FloatArray]:
        """Return the columns of a kind for each run, shape `(B, c)`."""
        wanted = self.of(part)
        return [one.columns[:, wanted] for one in self.parts]

    @property
    def whitenings(self) -> tuple[Whitening, ...]:
        """What makes each run's blocks independent."""
        return tuple(one.whitening for one in self.parts)

    def kept(self, *wanted: Part) -> "Design":
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
            shapes=self.shapes if Part.SHAPE in wanted else (),
        )

    def total(self, runs: Sequence[int] | None = None) -> FloatArray:
        """Sum the Gram matrices of some runs, of all unless said."""
        chosen = range(len(self.grams)) if runs is None else runs
        whole = np.zeros_like(self.grams[0])
        for one in chosen:
            whole += self.grams[one]
        return whole


def lay_out(
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
    by_nominal = _derivatives(study, z) if near is None else near.columns(Part.NOMINAL)
    kept_details = None if near is None else near.columns(Part.DETAIL)
    parts, grams, known = [], [], dict[int, FloatArray]()
    wall = _of_wall(chain_of(candidates, study.chain))
    for number, (sight, (scene, gain)) in enumerate(zip(study.sights, study.scenes(z), strict=True)):
        alone = [added(chain_of([one], study.chain), scene, gain) for one in candidates]
        before = added(study.chain, scene, gain)
        together = added(chain_of(candidates, study.chain), scene, gain) if len(alone) > 1 else sum(alone, before * 0)
        more = sight.of_blocks(together if alone else before)
        beside = sight.of_blocks(together - before) if alone else 0.0 * more
        if kept_details is None:
            details = gain * sight.of_blocks(study.details(number, scene))
        else:
            details = kept_details[number].T
        rows = [details]
        rows.append(sight.of_blocks(slopes(candidates, study.chain, scene, gain)))
        if foreign:
            rows += [study.modulations[number] * sight.of_blocks(one - before) for one in alone]
        if dictionary:
            like = problem.alike[number]
            shown = signatures(study.shapes, scene, gain, known.get(like))
            known.setdefault(like, shown)
            rows.append(sight.of_blocks(shown))
        whitening = whitenings[number]
        if wall.gut and sight.acquisition.contact is Contact.STICKING:
            stiff = sight.of_blocks(added(wall, scene, gain))
            whitening = problem.stiffened(number, predictions[number], stiff, whitening)
        residual = sight.evidence.blocks.mean - predictions[number].total - more
        columns = np.column_stack((by_nominal[number], *(one.T for one in rows)))
        varying = problem.sds[:, None] * predictions[number].varying
        spread = np.sqrt(np.sum(varying**2, axis=0)), uncertainties[number]
        parts.append(RunPart(residual, columns, beside, predictions[number].total, *spread, whitening))
        white = whitening.whole(np.column_stack((residual, columns)))
        grams.append(white.T @ white)
    priors = _priors(z, len(details), candidates, len(study.modulations[0]) if foreign else 0)
    shapes = study.shapes if dictionary else ()
    kinds, mean, precision = zip(*priors, *[(Part.SHAPE, 0.0, 0.0)] * len(shapes), strict=True)
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


def _of_wall(chain: Chain) -> Chain:
    """Return what of a chain acts on the wall itself."""
    return Chain((), tuple(one for one in chain.gut if one[0].place in OF_WALL), (), ())


def _derivatives(study: Study, z: FloatArray) -> list[FloatArray]:
    """Return the derivatives of block means by `z`; by a secant where they jump.

    With the contact angle the moment changes at which friction jumps, when a bend of the motion comes to the equator. A
    tangent leaves these jumps out, and a fit that follows it stops beside the minimum.
    """
    found = study.problem.derivatives(z, without=(ANGLE,))
    if ANGLE not in study.names:
        return found
    column = study.names.index(ANGLE)
    sides = []
    for side in (1.0, -1.0):
        turned = z.copy()
        turned[column] += side * SECANT
        sides.append(study.problem.predictions(turned))
    for one, more, less in zip(found, *sides, strict=True):
        one[:, column] = (more.total - less.total) / (2 * SECANT)
    return found


def _priors(
    z: FloatArray, details: int, candidates: Sequence[Candidate], modulations: int
) -> list[tuple[Part, float, float]]:
    priors = [(Part.NOMINAL, -value, 1.0) for value in z.tolist()]
    priors += [(Part.DETAIL, 0.0, 1.0)] * details
    for one in candidates:
        priors += [(Part.EFFECT, 0.0, sd**-2) for sd in one.prior_sds().tolist()]
    priors += [(Part.FOREIGN, 0.0, FOREIGN_SD**-2)] * (modulations * len(candidates))
    return priors
