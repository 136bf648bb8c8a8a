"""Runs of the friction model that several tests ask for."""

from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece, trapezoid

ROUGH = Capsule(name="rough", surface="rough", diameter_mm=12.9, length_mm=15.2, mass_g=50.1)
SMOOTH = Capsule(name="smooth", surface="smooth", diameter_mm=13.0, length_mm=15.2, mass_g=50.1)


def moves(*strokes: tuple[float, float], acceleration: float = 400.0, rest: float = 1.0, hold: float = 3.0,
          between: float = 0.0) -> MotionProfile:  # fmt: skip
    """Trapezoids of (travel, speed), with a rest before, pauses between and a hold after."""
    pieces: list[Piece] = [stationary_piece(rest, Phase.REST)]
    for travel, speed in strokes:
        pieces += [*trapezoid(travel, speed, acceleration), stationary_piece(between, Phase.HOLD)]
    return MotionProfile.from_pieces([*pieces, stationary_piece(hold, Phase.HOLD)])


def sliding(profile: MotionProfile, capsule: Capsule = ROUGH, fixture: Fixture = Fixture.FOAM,
            dwell: float = 60.0) -> Acquisition:  # fmt: skip
    return _acquisition(profile, capsule, fixture, Contact.SLIDING, dwell=dwell)


def sticking(profile: MotionProfile, strain: float, sheared_from: float = 0.0) -> Acquisition:
    return _acquisition(
        profile, ROUGH, Fixture.VACUUM, Contact.STICKING, shear_strain=strain, sheared_from=sheared_from
    )


def blank(profile: MotionProfile) -> Acquisition:
    return _acquisition(profile, ROUGH, Fixture.NONE, Contact.NONE)


def _acquisition(profile: MotionProfile, capsule: Capsule, fixture: Fixture, contact: Contact, *, dwell: float = 60.0,
                 shear_strain: float = 0.0, sheared_from: float = 0.0) -> Acquisition:  # fmt: skip
    return Acquisition(
        run_id="000-test",
        order=0,
        kind="drag",
        profile=profile,
        capsule=capsule,
        specimen=Specimen(name="test"),
        fixture=fixture,
        contact=contact,
        insertion_dwell_s=dwell,
        shear_strain=shear_strain,
        sheared_from=sheared_from,
    )
