"""A look at the rig: every device, the limits and the calibrations; nothing moves."""

from collections.abc import Iterator
from contextlib import closing
from typing import Unpack

from dragrig.backends import open_backend
from dragrig.rig import sanity
from dragrig.rig.backend import BackendRequest, Finding
from dragrig.rigs import QUANTITIES, RigChoices, RigSetup, resolve_rig


def examine(**choices: Unpack[RigChoices]) -> Iterator[Finding]:
    """Look at the rig's limits, calibrations and devices, and tell one after the other; nothing moves.

    Parameters
    ----------
    choices
        `rig`, `model`: a file or a shipped name each; `backend`: a name; `double`: whether its double is meant;
        `assignments`: changes as on the command line, `["rig.hardware.drive.port=COM3"]`.

    Raises
    ------
    SettingsError
        For settings that cannot be used at all.
    DeviceError
        When the backend cannot be loaded; what a device refuses is a finding.

    Examples
    --------
    >>> import dragrig
    >>> all(finding.fine for finding in dragrig.examine(backend="simulated"))
    True
    """
    return _findings(resolve_rig(**choices))


def _findings(setup: RigSetup) -> Iterator[Finding]:
    rig, calibrations = setup.rig, setup.calibrations()
    request = BackendRequest(rig, setup.model, calibrations=calibrations, connect=False)
    with closing(open_backend(setup.backend, request, double=setup.double)) as backend:
        yield sanity.limits(rig)
        if backend.needs_hands:
            yield from sanity.wiring(rig, calibrations)
        for quantity in QUANTITIES:
            if quantity in calibrations or (backend.needs_hands and not setup.double):
                yield sanity.calibration(quantity, calibrations.get(quantity), rig, backend.clock.now())
        yield from backend.examine()
