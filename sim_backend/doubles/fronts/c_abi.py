"""The card's double where nidaqmx looks for NI's library, so that plain `nidaqmx.Task()` runs its own code on it.

The functions are real C function pointers. nidaqmx sets their argument types itself, as it does with NI's library, and
thereby refuses arrays that are not C-contiguous float64; what the double does not have, nidaqmx calls unsupported.
"""

import ctypes
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from nidaqmx._lib import DaqFunctionImporter, lib_importer

from dragrig.sim_backend.doubles.card.card import Card, CardError
from dragrig.sim_backend.doubles.fronts.c_attributes import attribute_functions
from dragrig.sim_backend.doubles.fronts.c_calls import CFunction, call_functions

ENCODING = "utf-8"
_INTERNAL_ERROR = -200001


@contextmanager
def installed(card: Card) -> Iterator[None]:
    """Let nidaqmx find `card` in place of NI's library within the context; only one at a time in a process.

    Tasks are to be closed before it ends.
    """
    library = DaqFunctionImporter(_Library(card))
    ours = {"_windll": library, "_cdll": library, "_encoding": ENCODING}
    before = {name: getattr(lib_importer, name) for name in ours}
    try:
        for name, value in ours.items():
            setattr(lib_importer, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(lib_importer, name, value)


class _Library(ctypes.CDLL):
    """A library whose functions are callbacks; it loads nothing."""

    def __init__(self, card: Card) -> None:
        super().__init__("double of NI-DAQmx", handle=0)
        self._failure = _Failure()
        functions: Mapping[str, CFunction] = {
            **call_functions(card),
            **attribute_functions(card),
            "GetExtendedErrorInfo": ((ctypes.c_void_p, ctypes.c_uint32), self._failure.copy),
            "GetErrorString": (
                (ctypes.c_int32, ctypes.c_void_p, ctypes.c_uint32),
                self._failure.name,
            ),
        }
        # The callbacks live as long as the library: a pointer to one that was collected would crash the process.
        self._callbacks = {
            f"DAQmx{name}": ctypes.CFUNCTYPE(ctypes.c_int32, *types)(self._failure.guarded(call))
            for name, (types, call) in functions.items()
        }

    def __getitem__(self, name_or_ordinal: str | int) -> Callable[..., int]:  # type: ignore[override]
        callback = self._callbacks.get(str(name_or_ordinal))
        if callback is None:
            raise AttributeError(name_or_ordinal)
        return self._FuncPtr(ctypes.cast(callback, ctypes.c_void_p).value or 0)


class _Failure:
    """The last error in each thread, in words."""

    def __init__(self) -> None:
        self._last = threading.local()

    def guarded(self, call: Callable[..., int | None]) -> Callable[..., int]:
        """Return `call` with its errors as status codes."""

        def answer(*arguments: object) -> int:
            try:
                return call(*arguments) or 0
            except CardError as error:
                self._last.words = error.message
                return error.code
            except Exception as error:  # noqa: BLE001 - nothing can be raised through C, and silence would hide it
                self._last.words = f"The double of NI-DAQmx failed: {type(error).__name__}: {error}"
                return _INTERNAL_ERROR

        return answer

    def copy(self, place: int, size: int) -> None:
        """Write the last error's words."""
        _write(getattr(self._last, "words", ""), place, size)

    def name(self, code: int, place: int, size: int) -> None:
        """Write what a status code means."""
        _write(f"Status {code}.", place, size)


def _write(words: str, place: int, size: int) -> None:
    text = words.encode(ENCODING)[: size - 1] + b"\0"
    ctypes.memmove(place, text, len(text))
