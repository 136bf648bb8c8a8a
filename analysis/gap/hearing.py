"""Hum that was found, counted as noise of its own kind, so that it hides no effect beside it."""

from collections.abc import Sequence
from dataclasses import replace

from dragrig.analysis.gap.judging import hears_hum
from dragrig.analysis.gap.lines import Lines
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.noise import estimate_noise
from dragrig.analysis.nominal.experiment import Experiment


def with_heard_hum(study: Study, experiments: Sequence[Experiment], lines: Lines) -> Study:
    """Return a study whose noise has the hum of the mains where it was found: a line of a known frequency.

    Hum that is taken for white noise makes short blocks noisier than noise, and long ones less noisy.
    """
    if not hears_hum(lines.mains.gain, lines.other.gain):
        return study
    noise = estimate_noise(experiments, study.channel, lines.mains.amplitude, lines.mains.frequency_hz)
    noises = tuple(noise for _ in study.problem.noises)
    return replace(study, problem=replace(study.problem, noises=noises))
