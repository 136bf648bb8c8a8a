"""Finding a contact: the force changes against what it was at rest."""

import numpy as np

from dragrig.config.errors import SettingsError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.reading import Reading

_WINDOW_S = 0.01
_LEAST_NOISES = 5.0
"""A change smaller than so many standard deviations of the averaged force would be found in noise."""


class ContactSeeker:
    """Told every reading of an approach from rest, it says yes at the contact.

    Forces are averages over 10 ms.

    Parameters
    ----------
    force_mN
        Change of the force, to either side, that is a contact.
    """

    def __init__(self, force_mN: float, rate_hz: float) -> None:
        self._force_mN = force_mN
        self._window = max(1, round(_WINDOW_S * rate_hz))
        self._at_rest: list[FloatArray] = []
        self._rest_mN: float | None = None
        self._force: FloatArray = np.zeros(0)
        self._position: FloatArray = np.zeros(0)
        self.position_mm: float | None = None
        """Where the contact is, relative to where the approach began; None before it is found."""
        self.change_mN = 0.0
        """Change of the force at the contact; before it, the largest so far."""

    def __call__(self, reading: Reading) -> bool:
        """Take the next reading; return whether the contact is found.

        Raises
        ------
        SettingsError
            When the noise at rest is too large for the force that is sought.
        """
        resting = reading.phase == Phase.REST
        force = reading.channels["force"].astype(np.float64)
        self._at_rest.append(force[resting])
        if resting.all():
            return False
        rest_mN = self._rest() if self._rest_mN is None else self._rest_mN
        self._force = np.concatenate((self._force, force[~resting]))
        self._position = np.concatenate((self._position, reading.channels["position"][~resting].astype(np.float64)))
        if len(self._force) < self._window:
            return False
        return self._look(self._averages(self._force) - rest_mN)

    def _rest(self) -> float:
        force = np.concatenate(self._at_rest)
        averages = self._averages(force)
        noise = float(averages.std())
        if self._force_mN < _LEAST_NOISES * noise:
            raise SettingsError(
                f"force_mN = {self._force_mN:g}: is lost in the noise at rest of {noise:.1f} mN; seek at least "
                f"{_LEAST_NOISES * noise:.1f} mN."
            )
        self._rest_mN = float(force.mean())
        return self._rest_mN

    def _look(self, change: FloatArray) -> bool:
        over = np.flatnonzero(np.abs(change) >= self._force_mN)
        found = int(over[0]) if over.size else int(np.abs(change).argmax())
        if over.size or abs(change[found]) > abs(self.change_mN):
            self.change_mN = float(change[found])
        if over.size:
            self.position_mm = float(self._position[found + self._window // 2])
        kept = self._window - 1
        self._force, self._position = (
            self._force[len(self._force) - kept :],
            self._position[len(self._position) - kept :],
        )
        return bool(over.size)

    def _averages(self, force: FloatArray) -> FloatArray:
        return np.convolve(force, np.full(self._window, 1.0 / self._window), "valid")
