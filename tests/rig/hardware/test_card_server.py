"""A card in another computer, whose server hangs or was left by a program that was killed."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import grpc
import numpy as np
import pytest

from card_server import CardServer
from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import CardSettings
from dragrig.rig.hardware.backend import identify_card
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.tasks import PositionCounter, VoltageOutput
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, SimulatedBench
from simulated import settings


class Hanging(grpc.GenericRpcHandler):
    """A server that takes every call and answers none."""

    def __init__(self) -> None:
        self.ended = threading.Event()

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> "grpc.RpcMethodHandler[bytes, bytes]":
        def hang(request: bytes, context: grpc.ServicerContext) -> bytes:
            self.ended.wait()
            return request

        return grpc.unary_unary_rpc_method_handler(hang)


@pytest.fixture
def port() -> Iterator[int]:
    handler = Hanging()
    server = grpc.server(ThreadPoolExecutor(4), handlers=[handler])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield port
    finally:
        handler.ended.set()
        server.stop(None).wait()


def test_a_server_that_hangs_counts_as_gone(port: int) -> None:
    connection = Connection(CardSettings(server=f"127.0.0.1:{port}"), server_timeout_s=0.3)
    failed: list[BaseException] = []

    def look() -> None:
        try:
            identify_card(connection)
        except DeviceError as error:
            failed.append(error)

    looking = threading.Thread(target=look, daemon=True)
    looking.start()
    looking.join(600.0)
    connection.close()
    assert not looking.is_alive()
    assert "no NI gRPC device server answers" in str(failed[0])


def test_output_and_counter_of_a_killed_program_are_taken_back() -> None:
    bench = SimulatedBench(settings(), FrictionModelSettings(), DoubleClock(1.0))
    with CardServer(Card(bench)) as server, ExitStack() as stack:
        for _ in range(2):
            connection = Connection(CardSettings(server=f"127.0.0.1:{server.port}"))
            stack.callback(connection.close)
            counter, output = PositionCounter(connection, "ctr1", 1e-3), VoltageOutput(connection, "ao0", 1000.0, 60)
            counter.begin(12.0)
            output.begin(np.zeros(100))
            assert counter.read() == pytest.approx(12.0)
        output.end()
        counter.close()
