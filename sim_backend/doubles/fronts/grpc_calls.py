"""What each call of NI's gRPC service does on the card's double, but for attributes; a method is named as its call."""

import threading
from collections.abc import Callable
from typing import Protocol

import numpy as np
from nidaqmx._stubs import nidaqmx_pb2 as pb
from session_pb2 import SESSION_INITIALIZATION_BEHAVIOR_ATTACH_TO_EXISTING as ATTACH
from session_pb2 import SESSION_INITIALIZATION_BEHAVIOR_INITIALIZE_NEW as NEW
from session_pb2 import Session

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card.card import Card, CardError
from dragrig.sim_backend.doubles.card.daqmx import Code

_TASK_NAME = 0x1276


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


class Calls:
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
                Code.INVALID_TASK, f"Task specified is invalid or does not exist.\n\nTask Name: {session.name}"
            )
        return handle

    def CreateTask(self, request: pb.CreateTaskRequest) -> pb.CreateTaskResponse:
        """Attach to a session of this name if there is one and the client lets it, else make one."""
        name, behaviour = request.session_name, request.initialization_behavior
        with self._lock:
            there = bool(name) and name in self._sessions
            if behaviour == ATTACH and not there:
                raise CardError(Code.INVALID_TASK, f"There is no session to attach to.\n\nTask Name: {name}")
            if there and behaviour == NEW:
                raise CardError(Code.DUPLICATE_TASK, f"There is a session of this name already.\n\nTask Name: {name}")
            if not there:
                handle = self._card.create_task(name)
                name = str(self._card.get_attribute("task", handle, _TASK_NAME))
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

    def IsTaskDone(self, request: pb.IsTaskDoneRequest) -> pb.IsTaskDoneResponse:
        """Say whether a task is done."""
        return pb.IsTaskDoneResponse(is_task_done=self._card.is_task_done(self.task(request.task)))

    def WaitUntilTaskDone(self, request: pb.WaitUntilTaskDoneRequest) -> pb.WaitUntilTaskDoneResponse:
        """Wait until a task is done."""
        self._card.wait_until_done(self.task(request.task), request.time_to_wait)
        return pb.WaitUntilTaskDoneResponse()

    def CreateAIVoltageChan(self, request: pb.CreateAIVoltageChanRequest) -> pb.CreateAIVoltageChanResponse:
        """Add analog inputs."""
        self._card.create_ai_voltage_chan(
            self.task(request.task),
            request.physical_channel,
            request.name_to_assign_to_channel,
            request.terminal_config_raw,
            request.min_val,
            request.max_val,
            request.units_raw,
            request.custom_scale_name,
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
            request.units_raw,
            request.custom_scale_name,
        )
        return pb.CreateAOVoltageChanResponse()

    def CreateCILinEncoderChan(self, request: pb.CreateCILinEncoderChanRequest) -> pb.CreateCILinEncoderChanResponse:
        """Add the encoder."""
        self._card.create_ci_lin_encoder_chan(
            self.task(request.task),
            request.counter,
            request.name_to_assign_to_channel,
            request.decoding_type_raw,
            request.zidx_enable,
            request.zidx_val,
            request.zidx_phase_raw,
            request.units_raw,
            request.dist_per_pulse,
            request.initial_pos,
            request.custom_scale_name,
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
            request.active_edge_raw,
            request.sample_mode_raw,
            request.samps_per_chan,
        )
        return pb.CfgSampClkTimingResponse()

    def CfgDigEdgeStartTrig(self, request: pb.CfgDigEdgeStartTrigRequest) -> pb.CfgDigEdgeStartTrigResponse:
        """Set the terminal whose edge starts a task."""
        self._card.cfg_dig_edge_start_trig(self.task(request.task), request.trigger_source, request.trigger_edge_raw)
        return pb.CfgDigEdgeStartTrigResponse()

    def ReadAnalogF64(self, request: pb.ReadAnalogF64Request) -> pb.ReadAnalogF64Response:
        """Read volts."""
        status, samples, out = self._read(self._card.read_analog_f64, request)
        return pb.ReadAnalogF64Response(status=status, samps_per_chan_read=samples, read_array=out)

    def ReadCounterF64Ex(self, request: pb.ReadCounterF64ExRequest) -> pb.ReadCounterF64ExResponse:
        """Read positions."""
        status, samples, out = self._read(self._card.read_counter_f64, request)
        return pb.ReadCounterF64ExResponse(status=status, samps_per_chan_read=samples, read_array=out)

    def ReadAnalogScalarF64(self, request: pb.ReadAnalogScalarF64Request) -> pb.ReadAnalogScalarF64Response:
        """Read one voltage."""
        value = self._card.read_analog_scalar_f64(self.task(request.task), request.timeout)
        return pb.ReadAnalogScalarF64Response(value=value)

    def ReadCounterScalarF64(self, request: pb.ReadCounterScalarF64Request) -> pb.ReadCounterScalarF64Response:
        """Read one position."""
        value = self._card.read_counter_scalar_f64(self.task(request.task), request.timeout)
        return pb.ReadCounterScalarF64Response(value=value)

    def ReadDigitalLines(self, request: pb.ReadDigitalLinesRequest) -> pb.ReadDigitalLinesResponse:
        """Read levels, a byte a line."""
        out = np.zeros(request.array_size_in_bytes, bool)
        samples, lines = self._card.read_digital_lines(
            self.task(request.task), request.num_samps_per_chan, request.fill_mode_raw, out
        )
        return pb.ReadDigitalLinesResponse(
            read_array=out.tobytes(), samps_per_chan_read=samples, num_bytes_per_samp=lines
        )

    def ReadDigitalU32(self, request: pb.ReadDigitalU32Request) -> pb.ReadDigitalU32Response:
        """Read levels, a word a channel."""
        words = self._card.read_digital_u32(self.task(request.task), request.num_samps_per_chan, request.fill_mode_raw)
        return pb.ReadDigitalU32Response(read_array=words, samps_per_chan_read=1)

    def WriteDigitalLines(self, request: pb.WriteDigitalLinesRequest) -> pb.WriteDigitalLinesResponse:
        """Set levels, a byte a line."""
        written = self._card.write_digital_lines(
            self.task(request.task),
            request.num_samps_per_chan,
            request.auto_start,
            request.data_layout_raw,
            np.frombuffer(request.write_array, bool),
        )
        return pb.WriteDigitalLinesResponse(samps_per_chan_written=written)

    def WriteAnalogF64(self, request: pb.WriteAnalogF64Request) -> pb.WriteAnalogF64Response:
        """Set voltages or add to a waveform."""
        written = self._card.write_analog_f64(
            self.task(request.task),
            request.num_samps_per_chan,
            request.auto_start,
            request.timeout,
            request.data_layout_raw,
            np.array(request.write_array, np.float64),
        )
        return pb.WriteAnalogF64Response(samps_per_chan_written=written)

    def ResetDevice(self, request: pb.ResetDeviceRequest) -> pb.ResetDeviceResponse:
        """Put the card into its initial state."""
        self._card.reset_device(request.device_name)
        return pb.ResetDeviceResponse()

    def _read(
        self, read: Callable[[int, int, float, int, FloatArray], int], request: _ReadRequest
    ) -> tuple[int, int, FloatArray]:
        out = np.zeros(request.array_size_in_samps)
        try:
            samples = read(
                self.task(request.task), request.num_samps_per_chan, request.timeout, request.fill_mode_raw, out
            )
        except CardError as error:
            if error.code != Code.SAMPLES_NOT_YET_AVAILABLE:
                raise
            return error.code, error.samples, out  # a status beside the samples, so that they are not lost
        return 0, samples, out
