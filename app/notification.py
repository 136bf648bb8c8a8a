"""A word to a person who is not at the rig: a session has ended, the guard has tripped, a prompt waits."""

import logging
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from dragrig.config import NOTIFICATION_FILE, NotificationSettings, RigCheck, SettingsError, read_settings_file

if TYPE_CHECKING:
    from apprise import Apprise
    from desktop_notifier.sync import DesktopNotifierSync

Channels: TypeAlias = Mapping[str, Callable[[str, str], object]]
"""Functions that send a title and a text, by names without passwords."""
_SENDING_S = 15.0
"""A mail server that does not answer keeps a program no longer from its end."""
_SILENT = logging.NullHandler()


class Notifier:
    """Tells a person of what happens in a session.

    Parameters
    ----------
    lab
        Folder with the settings; without them, nothing is told.
    tell
        Called with a warning where a message could not be sent; from another thread where a prompt waits.

    Raises
    ------
    SettingsError
        When the settings are invalid, name an address of an unknown kind, or need what is not installed.
    """

    def __init__(self, lab: Path | None, tell: Callable[[str], None]) -> None:
        self._after_s, self._channels = open_channels(lab)
        self._tell, self._begun_s = tell, time.monotonic()

    @contextmanager
    def prompting(self, text: str) -> Iterator[None]:
        """Tell that a prompt waits, once it has been open for long."""
        timer = threading.Timer(self._after_s, self._send, ("dragrig waits for you", text))
        timer.daemon = True
        if self._channels:
            timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def ended(self, campaign: str, status: str, reason: str) -> None:
        """Tell how a session ended, unless it was short."""
        if time.monotonic() - self._begun_s >= self._after_s:
            self._send(f"dragrig: {campaign} {status}", reason or "Every run of the session is made.")

    def _send(self, title: str, text: str) -> None:
        for name, why in send(self._channels, title, text).items():
            if why:
                self._tell(f"No notification by {name}: {why}.")


def check_notification(lab: Path | None) -> Iterator[RigCheck]:
    """Send a message in every way that a lab's settings name; a finding for each. Raises `SettingsError`."""
    text = "So dragrig tells that a session has ended, the guard has tripped, or a prompt waits."
    for name, why in send(open_channels(lab)[1], "dragrig: a trial", text).items():
        yield RigCheck(f"notification by {name}", not why, why or "sent")


def send(channels: Channels, title: str, text: str) -> Mapping[str, str]:
    """Send a message in all ways at once; return by their names why it was not sent, empty where it was."""
    failures = dict.fromkeys(channels, f"it took more than {_SENDING_S:g} s")

    def send_by(name: str) -> None:
        try:
            channels[name](title, text)
            failures[name] = ""
        except Exception as error:  # noqa: BLE001  # of any library or program: a session has ended all the same
            failures[name] = " ".join(str(error).split()) or type(error).__name__

    threads = [threading.Thread(target=send_by, args=(name,), name=f"notify {name}", daemon=True) for name in channels]
    for thread in threads:
        thread.start()
    until_s = time.monotonic() + _SENDING_S
    for thread in threads:
        thread.join(max(0.0, until_s - time.monotonic()))
    return dict(failures)


def open_channels(lab: Path | None) -> tuple[float, Channels]:
    """Return after how many seconds a lab wants to be told, and by what means; raises `SettingsError`."""
    file = None if lab is None else lab / NOTIFICATION_FILE
    if file is None or not file.exists():
        return 0.0, {}
    settings = read_settings_file(NotificationSettings, file)
    channels: dict[str, Callable[[str, str], object]] = {}
    try:
        if settings.desktop:
            from desktop_notifier.sync import DesktopNotifierSync

            channels["desktop"] = partial(show, DesktopNotifierSync("dragrig"))
        if settings.command:
            channels[f"command {settings.command[0]}"] = partial(execute, settings.command)
        for number, address in enumerate(settings.addresses):
            from apprise import Apprise

            service = Apprise()
            if not service.add(address):
                example = "mailtos://user:password@example.org"
                raise SettingsError(f"{file}: addresses[{number}] is no address that Apprise knows, such as {example}.")
            # Numbered: two addresses may be the same but for what is hidden.
            channels[f"addresses[{number}] {service.urls(privacy=True)[0].partition('?')[0]}"] = partial(post, service)
    except ImportError as error:
        raise SettingsError(f'{file}: needs {error.name}: pip install "dragrig[notification]".') from error
    # It logs a failure, which is told here, with its traceback; without any handler, on standard error.
    logging.getLogger("desktop_notifier").addHandler(_SILENT)
    return settings.after_s, channels


def show(desktop: "DesktopNotifierSync", title: str, text: str) -> None:
    """Show a notification with the desktop's sound; raises `OSError` where no desktop takes it."""
    from desktop_notifier import DEFAULT_SOUND

    taken = threading.Event()
    desktop.send(title, text, sound=DEFAULT_SOUND, on_dispatched=taken.set)
    if not taken.is_set():
        raise OSError("there is no desktop that shows notifications")


def execute(command: tuple[str, ...], title: str, text: str) -> None:
    """Run a program with title and text as its last arguments; raises `OSError` where it fails.

    It is killed after twice the time that anybody waits for it (`TimeoutExpired`).
    """
    nothing, longest_s = subprocess.DEVNULL, 2 * _SENDING_S
    done = subprocess.run([*command, title, text], stdin=nothing, capture_output=True, check=False, timeout=longest_s)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise OSError(f"it ended with code {done.returncode}" + f": {said}" * bool(said))


def post(service: "Apprise", title: str, text: str) -> None:
    """Post a message; raises `OSError` where the server does not take it."""
    if not service.notify(text, title):
        raise OSError("the server did not take it")
