"""Where a model's effects come from when a gap was diagnosed; kept beside them, never needed to simulate."""

from collections.abc import Mapping

from dragrig.config.base import Settings


class DiagnosedSettings(Settings):
    """A diagnosis in short.

    `nominal` holds the parameters of the nominal model as they were refitted without the effects, so that what the
    effects are worth can be measured on other runs; `promised` the share of the gap that they closed.
    """

    specimen: str
    verdict: str
    effects: tuple[str, ...]
    probability: float
    runs: int
    promised: float | None = None
    nominal: Mapping[str, float] = {}
