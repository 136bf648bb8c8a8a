"""pymodbus's own server as the far end of the Modbus dialect: framing, CRC and exceptions are none of ours."""

import asyncio
import socket
import threading
from typing import Self

from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerType
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from dragrig.rig.hardware.dialects.modbus import RegisterMap
from dragrig.sim_backend.doubles.drive_double import DriveDouble
from dragrig.sim_backend.doubles.drive_sides import ModbusDrive

_READ, _REGISTERS = 3, 0x60


class PymodbusPort:
    """RTU frames over TCP, as a serial device server passes them on; its registers move a drive's double."""

    def __init__(self, drive: DriveDouble) -> None:
        self._drive = drive
        settings = drive.bench.rig.hardware.drive
        self._side = ModbusDrive(settings, RegisterMap())
        self._station = settings.station
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self._number: int = probe.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="pymodbus", daemon=True)

    @property
    def address(self) -> str:
        """What pyserial opens."""
        return f"socket://127.0.0.1:{self._number}"

    def __enter__(self) -> Self:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._serve(), self._loop).result(60)
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._server.shutdown(), self._loop).result(60)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _serve(self) -> None:
        registers = SimData(0, count=_REGISTERS, values=0, datatype=DataType.REGISTERS)
        device = SimDevice(self._station, simdata=[registers], action=self._act)
        self._server = ModbusTcpServer(device, framer=FramerType.RTU, address=("127.0.0.1", self._number))
        await self._server.serve_forever(background=True)

    async def _act(
        self, function_code: int, start_address: int, address: int, count: int, current_registers: list[int],
        set_values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:  # fmt: skip
        if function_code == _READ:
            words = self._side.read(address, count, self._drive.act)
            current_registers[address - start_address : address - start_address + count] = words
            return None if words else ExcCodes.ILLEGAL_ADDRESS
        exception = self._side.write(address, [int(word) for word in set_values or ()], self._drive.act)
        return ExcCodes(exception) if exception else None
