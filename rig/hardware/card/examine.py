"""A look at card, force sensor, encoder and lines while nothing moves."""

import re
from collections.abc import Iterator

from dragrig.config.errors import DeviceError, plain
from dragrig.config.rig import RigSettings
from dragrig.rig.backend import Finding
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.faults import told_in_words
from dragrig.rig.hardware.card.lines import CardLines
from dragrig.rig.hardware.card.sampler import AGGREGATE_HZ, CardSampler
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.lines import Lines
from dragrig.rig.raw import RawReading

MEASURED_S = 0.5
"""How long force and encoder are looked at."""
_PRODUCT = "PCI-6229"
_M_SERIES = re.compile(r"62\d\d")
_LARGEST_ZERO = 0.1
"""Part of the force range that the zero may be off without a word."""
_STILL_COUNTS = 2
"""Counts that an encoder between two of them may jitter."""


def identify(connection: Connection) -> dict[str, str]:
    """Return what run files say of the card: its name, product and serial number.

    Raises
    ------
    DeviceError
        When the driver or the card is not there.
    """
    card = connection.card
    with told_in_words(card, "it is looked up"):
        device = connection.device()
        product, serial = str(device.product_type), int(device.serial_num)
    return {"card_device": card.device, "card_product": product, "card_serial": f"{serial:08X}"}


def examine(
    connection: Connection, rig: RigSettings, sampler: CardSampler, scaling: Scaling, lines: Lines | None = None
) -> Iterator[Finding]:
    """Look at the card; what it has not found it does not look at further.

    Parameters
    ----------
    sampler
        Idle.
    lines
        The lines where they are open already; else they are opened and closed again.
    """
    try:
        facts = identify(connection)
        yield _product(facts)
        yield _rate(rig)
        yield _switches(connection, lines)
        reading = sampler.measure(MEASURED_S)
    except DeviceError as error:
        yield Finding("card", False, plain(error))
        return
    yield Finding("card's tasks", True, "analog inputs, counter and digital lines can be reserved, and samples arrive")
    yield _force(rig, scaling, reading)
    yield _encoder(reading)


def _product(facts: dict[str, str]) -> Finding:
    product = facts["card_product"]
    known = _M_SERIES.search(product) is not None
    note = (
        "" if product == _PRODUCT else f", which is no {_PRODUCT}: check channels, ranges and rate against its manual"
    )
    detail = f"{product} {facts['card_serial']} as {facts['card_device']}{note}"
    return Finding("card", known, detail)


def _rate(rig: RigSettings) -> Finding:
    inputs = 1 + len(rig.hardware.card.inputs)
    asked = inputs * rig.sampling.rate_hz
    detail = f"{inputs} × {rig.sampling.rate_hz:g} of {AGGREGATE_HZ:,} samples a second"
    return Finding("sampling rate", asked <= AGGREGATE_HZ, detail)


def _switches(connection: Connection, lines: Lines | None) -> Finding:
    if lines is None:
        own = CardLines(connection)
        try:
            trip = own.pressed().trip()
        finally:
            own.close()
    else:
        trip = lines.pressed().trip()
    return Finding("switches", trip is None, "none is pressed" if trip is None else trip.message)


def _force(rig: RigSettings, scaling: Scaling, reading: RawReading) -> Finding:
    zero = scaling.mN_per_V * reading.force_V + scaling.zero_mN
    noise = abs(scaling.mN_per_V) * reading.force_V_sd
    accuracy = rig.force_sensor.accuracy_mN
    low, high = scaling.force_range_mN
    detail = f"zero {zero:.1f} mN, noise {noise:.2f} mN ({reading.force_V:.4f} V)"
    if trip := scaling.fault_at(abs(reading.force_V)):
        return Finding("force sensor", False, f"{detail}: {trip.message}")
    if noise > accuracy:
        return Finding(
            "force sensor", False, f"{detail}: noisier than its accuracy of {accuracy:g} mN; check shield and ground"
        )
    if abs(zero) > _LARGEST_ZERO * (high - low) / 2:
        return Finding(
            "force sensor", False, f"{detail}: far from zero; is something hanging on it, or was it overloaded?"
        )
    return Finding("force sensor", True, detail)


def _encoder(reading: RawReading) -> Finding:
    moved = abs(reading.counts_end - reading.counts_begin)
    if moved > _STILL_COUNTS:
        return Finding(
            "encoder", False, f"counted {moved} in {MEASURED_S:g} s while nothing moved: check line receiver and shield"
        )
    return Finding("encoder", True, "reads and stands still; a jog shows whether it counts")
