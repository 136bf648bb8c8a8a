"""What the nominal model, refitted, leaves of both channels, in the form that says where a gap is."""

from collections.abc import Sequence

import numpy as np

from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.gaps import own_factors, own_zero
from dragrig.analysis.gap.lines import Line
from dragrig.analysis.gap.phases import commanded_phase
from dragrig.analysis.gap.position.errors import PositionErrors, origin_of
from dragrig.analysis.gap.solving import fit
from dragrig.analysis.gap.study import Study
from dragrig.analysis.gap.where import ResidualBlocks
from dragrig.rig.arrays import FloatArray

LEAST_BESIDE = 0.3
"""Noise beside a line is at least this part of all noise."""
USUAL_SCATTER = 6.0
"""A run that differs from the others by more standard deviations than this does so for a reason."""


def nominal_residuals(design: Design) -> list[FloatArray]:
    """Return what the nominal model leaves of each run when it is fitted to all of them, shape `(B,)` [mN]."""
    solution = fit(design, design.total(), Part.NOMINAL, Part.DETAIL)
    return [one.residual - one.columns[:, solution.columns] @ solution.found for one in design.parts]


def force_blocks(study: Study, design: Design, tolerance_mN: float, line: Line) -> list[ResidualBlocks]:
    """Return the force's residuals; noise that is a line counts as a gap."""
    found = []
    for number, (sight, left) in enumerate(zip(study.sights, nominal_residuals(design), strict=True)):
        part, noise = design.parts[number], study.problem.noises[number]
        blocks, at = sight.evidence.blocks, sight.coordinates
        white = np.sqrt(max(noise.white**2 - line.amplitude**2 / 2, (LEAST_BESIDE * noise.white) ** 2))
        # What swings at any other frequency is not of one frequency alone, and is nearly all of the slow noise.
        slow = noise.slow if line.mains or not line.amplitude else LEAST_BESIDE * noise.slow
        spread = white**2 / blocks.samples + slow**2 + part.motion_sd**2 + tolerance_mN**2
        zero_sd = study.problem.zero_sds[number]
        rest = left - own_factors(left, part.whitening, zero_sd, USUAL_SCATTER)
        residual = rest - own_zero(rest, part.whitening, zero_sd)
        found.append(
            ResidualBlocks(
                run_id=sight.experiment.run.info.header.run_id,
                channel=study.channel,
                kind=sight.experiment.kind,
                contact=sight.experiment.contact,
                speed_mm_s=float(at.top_speed_mm_s[0]),
                strain=sight.experiment.shear_strain,
                session_s=sight.session_start_s,
                residual=residual,
                noise_sd=np.sqrt(spread),
                width_s=at.width_s,
                time_s=at.time_s,
                phase=at.phase.astype(np.uint8),
                position_mm=at.position_mm,
                level_mN=part.predicted,
                origin_mm=origin_of(sight.experiment),
            )
        )
    return found


def position_blocks(runs: Sequence[PositionErrors]) -> list[ResidualBlocks]:
    """Return the position errors; an encoder's count is what does not matter."""
    found = []
    for one in runs:
        width = np.gradient(one.time_s)
        experiment = one.experiment
        found.append(
            ResidualBlocks(
                run_id=experiment.run.info.header.run_id,
                channel="position",
                kind=experiment.kind,
                contact=experiment.contact,
                speed_mm_s=one.top_speed_mm_s,
                strain=experiment.shear_strain,
                session_s=one.session_s,
                residual=one.error_mm,
                noise_sd=np.full_like(one.error_mm, np.linalg.norm([one.quantisation_mm, one.count_mm, one.noise_mm])),
                width_s=np.maximum(width, 1e-6),
                time_s=one.time_s,
                phase=commanded_phase(experiment, one.time_s).astype(np.uint8),
                position_mm=one.command_mm,
                origin_mm=origin_of(experiment),
            )
        )
    return found
