"""NI's gRPC device service on the card's double: its calls, its attributes, and how its errors travel back.

The real `nidaqmx` reaches it through `Task(grpc_options=…)`; it is the service that `nidaqmx` itself was generated for.
A method of `ServiceCalls` is named like its call. As with NI's server, a task outlives the client that made it: a
client that was killed leaves its tasks running, and the next one attaches to them by their name or finds the card
reserved.
"""

import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import NoReturn, Protocol

import grpc
import numpy as np
from google.protobuf.message import Message
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx.error_codes import DAQmxErrors as Status
from session_pb2 import SESSION_INITIALIZATION_BEHAVIOR_ATTACH_TO_EXISTING as ATTACH
from session_pb2 import SESSION_INITIALIZATION_BEHAVIOR_INITIALIZE_NEW as NEW
from session_pb2 import Session

from dragrig.rig.profile import FloatArray
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.card.pci6229 import Attribute, AttributeValue, CardError

Call = Callable[[Message], Message]

_CALL_NAME = re.compile("(?P<what>Get|Set)(Task|Chan|Read|Write|Buffer|Timing|Device|SystemInfo)Attribute.*")


class AttributeCalls:
    """The attributes of one card.

    Parameters
    ----------
    task
        Returns the handle of a session's task.
    """

    def __init__(self, card: Card, task: Callable[[Session], int]) -> None:
        self._card = card
        self._task = task

    def find(self, method: str) -> Call | None:
        """Return what carries out a call; None when it is none of an attribute that the card has."""
        name = _CALL_NAME.fullmatch(method)
        if name is None:
            return None
        respond = message_class(method, "Response")
        if name["what"] == "Get":
            return lambda request: _with_value(respond(), self._get(request))
        return lambda request: self._set(request, respond())

    def _get(self, request: Message) -> AttributeValue:
        subject = self._handle(request) if _has_field(request, "task") else _text_field(request, "device_name")
        return self._card.get_attribute(subject, _attribute_number(request), _text_field(request, "channel"))

    def _set(self, request: Message, response: Message) -> Message:
        value: AttributeValue = getattr(request, _value_field(request))
        channel = _text_field(request, "channel")
        self._card.set_attribute(self._handle(request), _attribute_number(request), value, channel)
        return response

    def _handle(self, request: Message) -> int:
        session = getattr(request, "task")  # noqa: B009 - the field is there in every message of these calls
        return self._task(session)


def message_class(method: str, kind: str) -> type[Message]:
    """Return the class of a call's messages; kind is Request or Response."""
    result: type[Message] = getattr(pb, method + kind)
    return result


def _with_value(response: Message, value: AttributeValue) -> Message:
    setattr(response, _value_field(response), value)
    return response


def _value_field(of: Message) -> str:
    # Enumerated values come in two fields, of which the raw one takes any number.
    return "value_raw" if _has_field(of, "value_raw") else "value"


def _attribute_number(request: Message) -> int:
    return int(getattr(request, "attribute_raw", 0))


def _text_field(request: Message, *fields: str) -> str:
    return next((str(getattr(request, field)) for field in fields if _has_field(request, field)), "")


def _has_field(of: Message, field: str) -> bool:
    return field in of.DESCRIPTOR.fields_by_name


class _ReadRequest(Protocol):
    @property
    def task(self) -> Session: ...
    @property
    def num_samps_per_chan(self) -> int: ...
    @property
    def timeout(self) -> float: ...
    @property
    def fill_mode_raw(self) -> int: ...
    @property
    def array_size_in_samps(self) -> int: ...


class ServiceCalls:
    """The calls, on one card. Tasks are sessions, which belong to the server and not to the client that made them."""

    def __init__(self, card: Card) -> None:
        self._card = card
        self._sessions: dict[str, int] = {}
        self._lock = threading.Lock()

    def task(self, session: Session) -> int:
        """Return the handle of a session's task; raises `CardError` when there is none."""
        with self._lock:
            handle = self._sessions.get(session.name)
        if handle is None:
            raise CardError(
                Status.INVALID_TASK, f"Task specified is invalid or does not exist.\n\nTask Name: {session.name}"
            )
        return handle

    def CreateTask(self, request: pb.CreateTaskRequest) -> pb.CreateTaskResponse:
        """Attach to a session of this name if there is one and the client lets it, else make one."""
        name, behaviour = request.session_name, request.initialization_behavior
        with self._lock:
            there = bool(name) and name in self._sessions
            if behaviour == ATTACH and not there:
                raise CardError(Status.INVALID_TASK, f"There is no session to attach to.\n\nTask Name: {name}")
            if there and behaviour == NEW:
                raise CardError(Status.DUPLICATE_TASK, f"There is a session of this name already.\n\nTask Name: {name}")
            if not there:
                handle = self._card.create_task(name)
                name = str(self._card.get_attribute(handle, Attribute.TASK_NAME))
                self._sessions[name] = handle
        return pb.CreateTaskResponse(task=Session(name=name), new_session_initialized=not there)

    def ClearTask(self, request: pb.ClearTaskRequest) -> pb.ClearTaskResponse:
        """Forget a session and its task."""
        handle = self.task(request.task)
        with self._lock:
            self._sessions.pop(request.task.name, None)
        self._card.clear_task(handle)
        return pb.ClearTaskResponse()

    def StartTask(self, request: pb.StartTaskRequest) -> pb.StartTaskResponse:
        """Start."""
        self._card.start(self.task(request.task))
        return pb.StartTaskResponse()

    def StopTask(self, request: pb.StopTaskRequest) -> pb.StopTaskResponse:
        """Stop."""
        self._card.stop(self.task(request.task))
        return pb.StopTaskResponse()

    def TaskControl(self, request: pb.TaskControlRequest) -> pb.TaskControlResponse:
        """Reserve, commit, …."""
        self._card.control(self.task(request.task), request.action_raw)
        return pb.TaskControlResponse()

    def CreateAIVoltageChan(self, request: pb.CreateAIVoltageChanRequest) -> pb.CreateAIVoltageChanResponse:
        """Add analog inputs."""
        self._card.create_ai_voltage_chan(
            self.task(request.task),
            request.physical_channel,
            request.name_to_assign_to_channel,
            request.terminal_config_raw,
            request.min_val,
            request.max_val,
        )
        return pb.CreateAIVoltageChanResponse()

    def CreateAOVoltageChan(self, request: pb.CreateAOVoltageChanRequest) -> pb.CreateAOVoltageChanResponse:
        """Add analog outputs."""
        self._card.create_ao_voltage_chan(
            self.task(request.task),
            request.physical_channel,
            request.name_to_assign_to_channel,
            request.min_val,
            request.max_val,
        )
        return pb.CreateAOVoltageChanResponse()

    def CreateCILinEncoderChan(self, request: pb.CreateCILinEncoderChanRequest) -> pb.CreateCILinEncoderChanResponse:
        """Add the encoder."""
        self._card.create_ci_lin_encoder_chan(
            self.task(request.task),
            request.counter,
            request.name_to_assign_to_channel,
            request.zidx_enable,
            request.zidx_val,
            request.zidx_phase_raw or request.zidx_phase,
            request.dist_per_pulse,
            request.initial_pos,
        )
        return pb.CreateCILinEncoderChanResponse()

    def CreateDIChan(self, request: pb.CreateDIChanRequest) -> pb.CreateDIChanResponse:
        """Add digital inputs."""
        self._card.create_di_chan(
            self.task(request.task), request.lines, request.name_to_assign_to_lines, request.line_grouping_raw
        )
        return pb.CreateDIChanResponse()

    def CreateDOChan(self, request: pb.CreateDOChanRequest) -> pb.CreateDOChanResponse:
        """Add digital outputs."""
        self._card.create_do_chan(
            self.task(request.task), request.lines, request.name_to_assign_to_lines, request.line_grouping_raw
        )
        return pb.CreateDOChanResponse()

    def CfgSampClkTiming(self, request: pb.CfgSampClkTimingRequest) -> pb.CfgSampClkTimingResponse:
        """Set the sample clock."""
        self._card.cfg_samp_clk_timing(
            self.task(request.task),
            request.source,
            request.rate,
            request.sample_mode_raw,
            request.samps_per_chan,
        )
        return pb.CfgSampClkTimingResponse()

    def CfgDigEdgeStartTrig(self, request: pb.CfgDigEdgeStartTrigRequest) -> pb.CfgDigEdgeStartTrigResponse:
        """Set the terminal whose edge starts a task."""
        self._card.cfg_dig_edge_start_trig(self.task(request.task), request.trigger_source)
        return pb.CfgDigEdgeStartTrigResponse()

    def ReadAnalogF64(self, request: pb.ReadAnalogF64Request) -> pb.ReadAnalogF64Response:
        """Read volts."""
        status, samples, out = self._read(self._card.read_analog_f64, request)
        return pb.ReadAnalogF64Response(status=status, samps_per_chan_read=samples, read_array=out)

    def ReadCounterF64Ex(self, request: pb.ReadCounterF64ExRequest) -> pb.ReadCounterF64ExResponse:
        """Read positions."""
        status, samples, out = self._read(self._card.read_counter_f64, request)
        return pb.ReadCounterF64ExResponse(status=status, samps_per_chan_read=samples, read_array=out)

    def ReadDigitalLines(self, request: pb.ReadDigitalLinesRequest) -> pb.ReadDigitalLinesResponse:
        """Read levels, a byte a line."""
        out = np.zeros(request.array_size_in_bytes, bool)
        samples = self._card.read_digital_lines(self.task(request.task), request.num_samps_per_chan, out)
        return pb.ReadDigitalLinesResponse(read_array=out.tobytes(), samps_per_chan_read=samples, num_bytes_per_samp=1)

    def WriteDigitalLines(self, request: pb.WriteDigitalLinesRequest) -> pb.WriteDigitalLinesResponse:
        """Set levels, a byte a line."""
        written = self._card.write_digital_lines(
            self.task(request.task),
            request.num_samps_per_chan,
            request.auto_start,
            np.frombuffer(request.write_array, bool),
        )
        return pb.WriteDigitalLinesResponse(samps_per_chan_written=written)

    def WriteAnalogF64(self, request: pb.WriteAnalogF64Request) -> pb.WriteAnalogF64Response:
        """Set voltages or add to a waveform."""
        written = self._card.write_analog_f64(
            self.task(request.task),
            request.auto_start,
            request.timeout,
            np.array(request.write_array, np.float64),
        )
        return pb.WriteAnalogF64Response(samps_per_chan_written=written)

    def _read(
        self, read: Callable[[int, int, float, int, FloatArray], int], request: _ReadRequest
    ) -> tuple[int, int, FloatArray]:
        out = np.zeros(request.array_size_in_samps)
        try:
            samples = read(
                self.task(request.task), request.num_samps_per_chan, request.timeout, request.fill_mode_raw, out
            )
        except CardError as error:
            if error.code != Status.SAMPLES_NOT_YET_AVAILABLE:
                raise
            return error.code, error.samples, out  # a status beside the samples, so that they are not lost
        return 0, samples, out


_COUNT_KEYS = {"Read": "ni-samps-per-chan-read", "Write": "ni-samps-per-chan-written"}


def device_service(card: Card) -> "grpc.GenericRpcHandler[Message, Message]":
    """Return NI's service on one card; calls that the double does not know are answered as unimplemented."""
    ours = pb.DESCRIPTOR.services_by_name["NiDAQmx"]
    calls = ServiceCalls(card)
    attributes = AttributeCalls(card, calls.task)
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
            _abort(context, method, error)

    return grpc.unary_unary_rpc_method_handler(
        answer, message_class(method, "Request").FromString, message_class(method, "Response").SerializeToString
    )


def _abort(context: grpc.ServicerContext, method: str, error: CardError) -> NoReturn:
    counts = [(key, str(error.samples)) for start, key in _COUNT_KEYS.items() if method.startswith(start)]
    context.set_trailing_metadata((("ni-error", str(error.code)), *counts))
    context.abort(grpc.StatusCode.UNKNOWN, error.message)


LOOPBACK = "127.0.0.1"
UNLIMITED_MESSAGES = (("grpc.max_send_message_length", -1), ("grpc.max_receive_message_length", -1))
"""Options of the server and of a channel to it: a long read outgrows gRPC's 4 MB."""
_MAX_CALLS = 16
"""Calls at once; a read that waits for samples takes one."""


class CardServer:
    """The server on loopback, serving from `__enter__` to `__exit__`.

    Parameters
    ----------
    port
        TCP port; 0 for any that is free.
    """

    def __init__(self, card: Card, port: int = 0) -> None:
        self._server = grpc.server(
            ThreadPoolExecutor(_MAX_CALLS, "card"),
            handlers=[device_service(card)],
            options=[*UNLIMITED_MESSAGES, ("grpc.so_reuseport", 0)],
        )
        self.port = self._server.add_insecure_port(f"{LOOPBACK}:{port}")

    def __enter__(self) -> "CardServer":
        self._server.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """End every call at once, as a server that dies; safe to call twice."""
        self._server.stop(grace=None).wait()
