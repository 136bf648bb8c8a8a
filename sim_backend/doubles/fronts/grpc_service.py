"""How a call of NI's gRPC service finds what carries it out, and how its errors travel back."""

from typing import NoReturn

import grpc
from google.protobuf.message import Message
from nidaqmx._stubs import nidaqmx_pb2 as pb

from dragrig.sim_backend.doubles.card.card import Card, CardError
from dragrig.sim_backend.doubles.fronts.grpc_attributes import Attributes, Call, message
from dragrig.sim_backend.doubles.fronts.grpc_calls import Calls

_COUNTS = {"Read": "ni-samps-per-chan-read", "Write": "ni-samps-per-chan-written"}


def service(card: Card) -> "grpc.GenericRpcHandler[Message, Message]":
    """Return NI's service on one card; calls that the double does not know are answered as unimplemented."""
    ours = pb.DESCRIPTOR.services_by_name["NiDAQmx"]
    calls = Calls(card)
    attributes = Attributes(card, calls.task)
    handlers: dict[str, grpc.RpcMethodHandler[Message, Message]] = {}
    for method in ours.methods_by_name:
        call: Call | None = getattr(calls, method, None) or attributes.find(method)
        if call is not None:
            handlers[method] = _handler(method, call)
    return grpc.method_handlers_generic_handler(ours.full_name, handlers)


def _handler(method: str, call: Call) -> "grpc.RpcMethodHandler[Message, Message]":
    def answer(request: Message, context: grpc.ServicerContext) -> Message:
        try:
            return call(request)
        except CardError as error:
            _refuse(context, method, error)

    return grpc.unary_unary_rpc_method_handler(
        answer, message(method, "Request").FromString, message(method, "Response").SerializeToString
    )


def _refuse(context: grpc.ServicerContext, method: str, error: CardError) -> NoReturn:
    counts = [(key, str(error.samples)) for start, key in _COUNTS.items() if method.startswith(start)]
    context.set_trailing_metadata((("ni-error", str(error.code)), *counts))
    context.abort(grpc.StatusCode.UNKNOWN, error.message)
