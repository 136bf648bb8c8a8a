"""Noise of the force sensor: white noise plus exponentially correlated noise, from where the force stands still.

The stretches are the rest before the ramp and the last part of the hold of every relaxation, from which a cubic is
taken. Runs of other kinds are not asked: a capsule that slides turns every tremor of the stage into friction. The
stretches' cosine spectra have the likelihood of Whittle (Ark. Mat. 2, 1953), which is maximised over both levels and
the correlation time together with what is known of such sensors: the slow noise is about a third of the white and has
a correlation time of about 0.2 s. Where the records are short, that is what remains.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.joint.noise import SLOW_SHARE, USUAL_CORRELATION_S, Noise
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.phases import in_phase
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase

USUAL_WHITE_MN = 2.0
"""White noise where no record shows any, at the upper end of what such sensors have."""
SHARE_SPREAD, CORRELATION_SPREAD = 0.7, 1.0
"""Standard deviations of the logarithms of slow over white noise, and of the correlation time, beforehand."""
FEWEST_SAMPLES = 64
LONGEST_END_S = 60.0
"""So much of a hold's end is looked at, and at most its second half."""
LEAST_WHITE_MN = 0.02
BINS = 48


USUAL = Noise(USUAL_WHITE_MN, SLOW_SHARE * USUAL_WHITE_MN, USUAL_CORRELATION_S, 0)


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Mean power of cosine coefficients in bins, how many are in each, and the cosine of their frequency."""

    step_s: float
    count: FloatArray
    power: FloatArray
    cosine: FloatArray


def estimate_noise(experiments: Iterable[Experiment]) -> Noise:
    """Estimate the noise that relaxation runs share; the usual one where none of them stands still."""
    from scipy.optimize import minimize

    spectra = [one for experiment in experiments for one in _spectra(experiment)]
    if not spectra:
        return USUAL
    highest = sum(float(one.power[-8:] @ one.count[-8:]) for one in spectra)
    white = 0.5 * np.log(max(highest / sum(float(one.count[-8:].sum()) for one in spectra), LEAST_WHITE_MN**2))
    start = np.array([white, np.log(SLOW_SHARE), np.log(USUAL_CORRELATION_S)])

    def lacking(logs: FloatArray) -> float:
        share = (logs[1] - start[1]) / SHARE_SPREAD
        correlation = (logs[2] - start[2]) / CORRELATION_SPREAD
        return 0.5 * float(sum(_misfit(one, np.exp(logs)) for one in spectra) + share**2 + correlation**2)

    simplex = start + np.vstack((np.zeros(3), 0.3 * np.eye(3)))
    found = minimize(
        lacking, start, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-3}
    )
    level, share, correlation = np.exp(found.x)
    level = max(float(level), LEAST_WHITE_MN)
    return Noise(level, level * float(share), float(correlation), int(sum(one.count.sum() for one in spectra)))


def _misfit(spectrum: _Spectrum, values: FloatArray) -> float:
    """Return −2 log of the likelihood of one stretch."""
    white, share, correlation = values
    decay = np.exp(-spectrum.step_s / correlation)
    lorentz = (1 - decay**2) / (1 - 2 * decay * spectrum.cosine + decay**2)
    density = (white**2 + LEAST_WHITE_MN**2) * (1 + share**2 * lorentz)
    return float(spectrum.count @ (np.log(density) + spectrum.power / density))


def _spectra(experiment: Experiment) -> Iterator[_Spectrum]:
    trace = experiment.run.trace
    rest = np.flatnonzero(in_phase(trace, Phase.REST))
    hold = np.flatnonzero(in_phase(trace, Phase.HOLD))
    last = min(hold.size // 2, int(LONGEST_END_S * trace.sample_rate_hz))
    for stretch, order in ((rest, 0), (hold[hold.size - last :], 3)):
        if stretch.size >= FEWEST_SAMPLES and experiment.valid[stretch].all():
            yield _spectrum(np.asarray(trace.force[stretch], dtype=np.float64), 1 / trace.sample_rate_hz, order)


def _spectrum(force: FloatArray, step_s: float, order: int) -> _Spectrum:
    from scipy.fft import dct

    samples = force.size
    if order:
        place = np.linspace(-1.0, 1.0, samples)
        force = force - np.polynomial.Polynomial.fit(place, force, order)(place)
    skipped = 2 * order or 1
    power = np.asarray(dct(force, norm="ortho"), dtype=np.float64)[skipped:] ** 2
    edges = np.unique(np.geomspace(1, power.size + 1, BINS).astype(np.intp)) - 1
    count = np.diff(edges).astype(float)
    mean_index = skipped + 0.5 * (edges[1:] + edges[:-1] - 1)
    return _Spectrum(step_s, count, np.add.reduceat(power, edges[:-1]) / count, np.cos(np.pi * mean_index / samples))
