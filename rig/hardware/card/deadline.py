"""Time limit for calls of a remote card: a device server that hangs must not hang this program."""

from collections.abc import Callable
from typing import TypeVar

import grpc

CallT = TypeVar("CallT")


class _CallDetails(grpc.ClientCallDetails):
    """A call's details of which only the time is another; grpc keeps what is left out."""

    def __init__(self, timeout_s: float) -> None:
        self.timeout = timeout_s


class CallTimeout(grpc.UnaryUnaryClientInterceptor):  # type: ignore[type-arg]  # generic in its stubs only
    """Fails every call, as of a server that is gone, that has not returned in time."""

    def __init__(self, timeout_s: float) -> None:
        self._details = _CallDetails(timeout_s)

    def intercept_unary_unary(
        self,
        continuation: Callable[[grpc.ClientCallDetails, object], CallT],
        client_call_details: grpc.ClientCallDetails,
        request: object,
    ) -> CallT:
        """Make the call with a limit to its time."""
        del client_call_details
        return continuation(self._details, request)
