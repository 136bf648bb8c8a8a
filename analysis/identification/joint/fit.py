"""One fit of everything: parameters with priors, and in each run a zero and factors of its own.

The runs' own zeros and factors are Gaussian and enter linearly, so that they are integrated out: they are part of
each run's covariance. That covariance is laid out around the present prediction and kept while the parameters are
fitted, then laid out again, until nothing moves; so a weaker model does not buy itself a smaller error.
"""

from dragrig.analysis.identification.joint.posterior import joint_fit
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.joint.solve import solve
from dragrig.analysis.identification.results import JointFit
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.protocol import NominalModel


@one_thread()
def fit_jointly(selection: Selection, nominal: NominalModel) -> JointFit:
    """Fit a nominal model to all runs of a specimen at once.

    Parameters
    ----------
    selection
        The runs.
    nominal
        Model with priors; see `dragrig.analysis.nominal`.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs, or a run lacks what it needs.
    """
    problem = Problem.of(selection, nominal)
    return joint_fit(problem, solve(problem))
