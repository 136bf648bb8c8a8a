"""Sample clocks as programs set them, checked as the driver checks them."""

from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, Code, Quantity
from dragrig.sim_backend.doubles.card.tasks import Task, Timing


def timing_of(task: Task, device: str, source: str, rate_hz: float, quantity: int, samples: int) -> Timing:
    """Return a sample clock at the nearest rate that the card can make.

    Raises
    ------
    CardError
        For a rate, a terminal or a number of samples that the card does not have.
    """
    if quantity not in {Quantity.FINITE, Quantity.CONTINUOUS}:
        raise CardError(Code.INVALID_ATTRIBUTE_VALUE, f"Sample mode {quantity} is not supported by this task.")
    if not rate_hz > 0:
        raise CardError(Code.INVALID_ATTRIBUTE_VALUE, f"Sample rate must be above 0, not {rate_hz:g}.")
    if quantity == Quantity.FINITE and samples < 1:
        raise CardError(Code.INVALID_ATTRIBUTE_VALUE, "A finite task needs at least one sample per channel.")
    place = pci6229.terminal(source, device) if source and source != "OnboardClock" else ""
    match task.kind:
        case ChannelKind.ANALOG_INPUT:
            most_hz = pci6229.AI_MAX_RATE_HZ / len(task.channels)
        case ChannelKind.ANALOG_OUTPUT:
            most_hz = pci6229.AO_MAX_RATE_HZ
        case ChannelKind.COUNTER_INPUT:
            return Timing(rate_hz, place, Quantity(quantity), samples)
        case None:
            raise CardError(Code.NO_CHANNELS, f"Task has no channels.\n\nTask Name: {task.name}")
        case _:
            raise CardError(Code.ATTRIBUTE_NOT_SUPPORTED, "These digital lines have no sample clock.")
    rate_hz = pci6229.possible_rate(rate_hz)
    if rate_hz > most_hz * (1 + 1e-9):
        code = Code.RATE_TOO_HIGH if len(task.channels) == 1 else Code.TOO_FAST_FOR_CHANNELS
        raise CardError(
            code, f"Sample rate {rate_hz:g} Hz is above the {most_hz:g} Hz that {len(task.channels)} channels can have."
        )
    return Timing(rate_hz, place, Quantity(quantity), samples)
