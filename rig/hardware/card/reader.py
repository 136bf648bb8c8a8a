"""The thread that fetches samples, and hands them over as blocks to the thread that reads them."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, Full, Queue
from threading import Event as Signal
from threading import Thread

from dragrig.config.errors import DeviceError
from dragrig.config.hardware import CardSettings
from dragrig.rig.devices import Block
from dragrig.rig.hardware.card.faults import driver_errors, in_words, silent
from dragrig.rig.hardware.card.fetching import Fetched, Fetcher
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.trips import Cause, Trip

_AHEAD = 256
"""Blocks that wait for the thread that reads; beyond them, samples wait in the card's buffer."""
_WAKE_S = 0.02
_HELD_S = 0.1
"""A wait of `_WAKE_S` that takes so long says that the whole program was frozen meanwhile."""
_TAIL_S = 0.02
"""How much is sampled after a stop once the stage stands."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """How much to sample, in what blocks, and how long without samples is too long."""

    samples: int
    block_samples: int
    rate_hz: float
    stale_s: float


class Reader:
    """Fetches one acquisition's samples on a thread of its own, which closes the tasks when it ends.

    Parameters
    ----------
    fetcher, close
        The started tasks' samples, and what closes the tasks. Both belong to the thread from here on.
    """

    def __init__(
        self,
        fetcher: Fetcher,
        scaling: Scaling,
        stretch: Stretch,
        coupling: Coupling,
        card: CardSettings,
        close: Callable[[], None],
    ) -> None:
        self._fetcher, self._scaling, self._stretch, self._coupling = fetcher, scaling, stretch, coupling
        self._card, self._close = card, close
        self._ready: Queue[Block | Exception | None] = Queue(_AHEAD)
        self._ending = Signal()
        self._closing_error: Exception | None = None
        self._last: int | None = None
        self._origin = 0.0
        self._over = False
        self._error: Exception | None = None
        self._heard_s = time.monotonic()
        self._thread = Thread(target=self._run, name="card reader", daemon=True)
        self._thread.start()

    def take(self, cancel: Signal, fed: Callable[[], None]) -> Block | None:
        """Return the next block; None after the last one, and once `cancel` is set or the reader told to end.

        Raises
        ------
        StaleDataError
            When no sample arrived for longer than `Stretch.stale_s`, in the wall's time.
        DeviceError
            What ended the thread; again at every call.
        """
        while not (cancel.is_set() or self._ending.is_set()):
            fed()
            if self._error is not None:
                raise self._error
            if self._over:
                return None
            asked_s = time.monotonic()
            try:
                item = self._ready.get(timeout=_WAKE_S)
            except Empty:
                if time.monotonic() - asked_s < _HELD_S:
                    self._refuse_stale()
                else:
                    # The program itself was held up, so that nobody knows yet whether samples are there.
                    self._heard_s = time.monotonic()
                continue
            if isinstance(item, Block):
                return item
            self._over, self._error = True, item
        return None

    def end(self, longest_s: float) -> bool:
        """Have the tasks closed; return False when the driver does not return within `longest_s`.

        Raises
        ------
        DeviceError
            When the tasks could not be closed properly.
        """
        self._ending.set()
        self._thread.join(longest_s)
        if self._closing_error is not None:
            raise self._closing_error
        return not self.alive

    @property
    def alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    def _refuse_stale(self) -> None:
        silent_s = self._stretch.stale_s
        if time.monotonic() - self._heard_s > silent_s and self._ready.empty():
            raise silent(self._card, silent_s)

    def _run(self) -> None:
        failed = False
        try:
            while (block := self._next()) is not None:
                self._hand_over(block)
            self._hand_over(None)
        except Exception as error:  # noqa: BLE001  # raised again in the thread that reads
            failed = True
            self._hand_over(self._in_words(error))
        finally:
            self._close_tasks(failed)

    def _close_tasks(self, failed: bool) -> None:
        try:
            self._close()
        except Exception as error:  # noqa: BLE001  # raised again where the reader is ended
            # A card that has failed fails here once more, which says nothing new.
            self._closing_error = None if failed else self._in_words(error)

    def _next(self) -> Block | None:
        while not self._ending.is_set():
            wanted = min(self._stretch.block_samples, self._end() - self._fetcher.next_index)
            if wanted <= 0:
                self._refuse_silent_loss()
                return None
            fetched = self._fetcher.fetch(wanted)
            if fetched.samples:
                self._heard_s = time.monotonic()
                return self._block(fetched)
        return None

    def _end(self) -> int:
        """Return where sampling ends: with the profile, or once a stage that was told to stop stands."""
        if self._last is None and self._coupling.stopped:
            tail = math.ceil(_TAIL_S * self._stretch.rate_hz)
            if self._coupling.moving:
                return self._fetcher.next_index + self._stretch.block_samples
            self._last = max(self._fetcher.next_index, self._fetcher.acquired + tail)
        return self._stretch.samples if self._last is None else self._last

    def _block(self, fetched: Fetched) -> Block:
        if fetched.first_index == 0:
            self._origin = float(fetched.counts[0])
        fault = self._overrun(fetched) or self._scaling.fault(fetched.volts[0])
        return Block(fetched.first_index, self._scaling.scale(fetched.volts, fetched.counts, self._origin), fault)

    def _overrun(self, fetched: Fetched) -> Trip | None:
        if not fetched.lost:
            return None
        at_s = (fetched.first_index - fetched.lost) / self._stretch.rate_hz
        return Trip(
            Cause.OVERRUN,
            f"{fetched.lost} samples from {at_s:.3f} s on are lost, because this computer did not fetch them in time",
        )

    def _refuse_silent_loss(self) -> None:
        if lost := self._fetcher.lost:
            raise DeviceError(
                f"the last {lost} samples are lost, because this computer did not fetch them in time: end other "
                "programs, or lower sampling.rate_hz."
            )

    def _in_words(self, error: Exception) -> Exception:
        return in_words(error, self._card, "it samples") if isinstance(error, driver_errors()) else error

    def _hand_over(self, item: Block | Exception | None) -> None:
        while not self._ending.is_set():
            try:
                self._ready.put(item, timeout=_WAKE_S)
            except Full:
                continue
            return
