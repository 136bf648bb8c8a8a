"""What DAQmx tells of the driver and of the card itself."""

from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.attributes import Device, System
from dragrig.sim_backend.doubles.card.daqmx import CardError, Code
from dragrig.sim_backend.doubles.card.engine import Engine
from dragrig.sim_backend.doubles.card.tasks import Value

_M_SERIES, _PCI = 14643, 12582


def driver_facts(engine: Engine) -> dict[int, Value]:
    """Return the driver's version and what it knows."""
    trouble = engine.bench.mishaps.now
    missing = trouble.card_absent or trouble.card_gone or trouble.card_unplugged
    return {
        **dict(zip((System.MAJOR, System.MINOR, System.UPDATE), pci6229.DRIVER_VERSION, strict=True)),
        System.DEVICES: "" if missing else engine.wiring.device,
        System.TASKS: "",
        System.CHANNELS: "",
        System.SCALES: "",
    }


def device_facts(engine: Engine, name: str) -> dict[int, Value]:
    """Return what the card is and has; raises `CardError` when the driver knows no device of that name."""
    device = engine.wiring.device
    if name.lower() != device.lower():
        raise CardError(Code.INVALID_DEVICE, f"Device identifier is invalid.\n\nDevice Specified: {name}")
    engine.find()

    def listed(names: tuple[str, ...]) -> str:
        return ", ".join(f"{device}/{one}" for one in names)

    lines, ports = listed(pci6229.LINES), listed(tuple(pci6229.PORTS))
    return {
        Device.PRODUCT: pci6229.PRODUCT,
        Device.SERIAL: pci6229.SERIAL_NUMBER,
        Device.PRODUCT_NUMBER: pci6229.PRODUCT_NUMBER,
        Device.SIMULATED: False,
        Device.CATEGORY: _M_SERIES,
        Device.BUS: _PCI,
        Device.TERMINALS: ", ".join(f"/{device}/{one}" for one in pci6229.TERMINALS),
        Device.AI: listed(pci6229.AI),
        Device.AO: listed(pci6229.AO),
        Device.CI: listed(pci6229.COUNTERS),
        Device.CO: listed(pci6229.COUNTERS),
        Device.DI_LINES: lines,
        Device.DO_LINES: lines,
        Device.DI_PORTS: ports,
        Device.DO_PORTS: ports,
        Device.AI_MAX_SINGLE_RATE: pci6229.AI_MAX_RATE_HZ,
        Device.AI_MAX_RATE: pci6229.AI_MAX_RATE_HZ,
        Device.AI_RANGES: [signed for one in pci6229.AI_RANGES_V for signed in (-one, one)],
        Device.AO_RANGES: [-pci6229.AO_RANGE_V, pci6229.AO_RANGE_V],
    }
