"""The model, given a specimen's true values, explains runs that somebody else's plant made down to the noise."""

from pathlib import Path

import numpy as np
import pytest

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition
from dragrig.rig.protocols import protocol_kinds
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import Run
from dragrig.sim_backend.friction import prepare
from places import CAMPAIGN
from true_model import TRUE_MODEL


def as_commanded(run: Run) -> Acquisition:
    header = run.info.header
    kind = protocol_kinds()[header.kind]
    protocol = kind.model_validate({key: header.protocol[key] for key in kind.model_fields})
    specimen = Specimen(name="jejunum")
    sizes = {key: float(value) for key, value in header.capsule.items() if not isinstance(value, str)}
    return Acquisition(
        run_id=header.run_id,
        order=header.order,
        kind=header.kind,
        profile=protocol.profile(specimen),
        capsule=Capsule.model_validate({"name": "foreign", "surface": "smooth", **sizes}),
        specimen=specimen,
        fixture=Fixture(str(header.specimen["fixture"])),
        contact=protocol.contact,
        insertion_dwell_s=float(header.entry["insertion_dwell_s"]),
        shear_strain=protocol.strain(),
    )


def residual_sd(run: Run, model: FrictionModelSettings) -> float:
    return float(np.std(run.trace.force - prepare(as_commanded(run), model).force(run.trace.time)))


@pytest.mark.parametrize("file", sorted(CAMPAIGN.glob("*.h5")), ids=lambda file: file.stem)
def test_true_values_leave_noise_and_repeatability(file: Path) -> None:
    run = read_run(file)
    noise = float(np.std(run.trace.force[run.trace.phase == 0]))
    # Stiffness varies by 2 % and friction by 1.5 % from run to run.
    scatter = 0.02 * float(np.std(run.trace.force))
    assert residual_sd(run, TRUE_MODEL) < np.hypot(1.15 * noise, 2 * scatter)


def test_the_papers_values_do_not() -> None:
    run = read_run(CAMPAIGN / "001-relaxation.h5")
    assert residual_sd(run, FrictionModelSettings()) > 2 * residual_sd(run, TRUE_MODEL)


@pytest.mark.parametrize("file", sorted(CAMPAIGN.glob("*.h5")), ids=lambda file: file.stem)
def test_a_protocol_yields_the_motion_that_others_command(file: Path) -> None:
    run = read_run(file)
    profile = as_commanded(run).profile
    assert profile.samples(run.trace.sample_rate_hz) == len(run.trace.time)
    np.testing.assert_array_equal(profile.phase_at(run.trace.time), run.trace.phase)
    np.testing.assert_allclose(profile.position(run.trace.time), run.trace.command, atol=1e-5)
