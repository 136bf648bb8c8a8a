"""Word to a person who is not at the rig, by real programs, a real mail server and a real desktop bus."""

import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from email import message_from_bytes
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
from aiosmtpd.controller import Controller

import dragrig
from dragrig import notification
from dragrig.config.errors import SettingsError
from dragrig.notification import Notifier, check_notification
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.setup import create_lab
from driving import until

LOG = """
import sys
from pathlib import Path
with Path(sys.argv[1]).open("a", encoding="utf-8") as log:
    log.write(" | ".join(sys.argv[2:]) + "\\n")
"""
# Apprise loads a module that Python 3.11 and 3.12 announce the end of.
pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    create_lab(tmp_path / "lab")
    return tmp_path / "lab"


def settle_for(lab: Path, settings: str) -> None:
    (lab / "notification.toml").write_text(settings, "utf-8")


def logging_command(lab: Path) -> str:
    (lab / "log.py").write_text(LOG, "utf-8")
    return f"command = ['{sys.executable}', '{lab / 'log.py'}', '{lab / 'log.txt'}']"


def told(lab: Path) -> list[str]:
    log = lab / "log.txt"
    return log.read_text("utf-8").splitlines() if log.exists() else []


class Mailbox:
    """Keeps what a mail server gets."""

    def __init__(self) -> None:
        self.letters: list[Message] = []

    async def handle_DATA(self, server: object, session: object, envelope: Any) -> str:  # the server's name
        del server, session
        self.letters.append(message_from_bytes(envelope.content))
        return "250 OK"


@pytest.fixture
def mail() -> Iterator[tuple[Controller, Mailbox]]:
    mailbox = Mailbox()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    controller = Controller(mailbox, hostname="127.0.0.1", port=port)
    controller.start()
    yield controller, mailbox
    controller.stop()


class AwayOperator(NullOperator):
    """A person who comes when called."""

    def __init__(self, lab: Path) -> None:
        self._lab = lab

    def ask(self, prompt: Prompt) -> Answer:
        """Answer once a message has come."""
        until(lambda: bool(told(self._lab)))
        return Answer.DONE


def test_a_prompt_that_waits_and_the_end_of_a_session_are_told(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab)
    settle_for(lab, f"after_s = 0.0\n{logging_command(lab)}\n")
    dragrig.run("drag", out=lab / "runs" / "monday", person=AwayOperator(lab))
    waits, ended = told(lab)
    assert waits == "dragrig waits for you | Lay a fresh specimen on the foam and insert the capsule"
    assert ended == "dragrig: monday complete | Every run of the session is made."


def test_an_answered_prompt_is_told_no_later(lab: Path) -> None:
    settle_for(lab, f"after_s = 600\n{logging_command(lab)}\n")
    before = set(threading.enumerate())
    with Notifier(lab, pytest.fail).prompting("Lay a specimen"):
        assert set(threading.enumerate()) > before
    until(lambda: not set(threading.enumerate()) - before, within_s=60)
    assert told(lab) == []


def test_a_trip_is_told_with_its_cause(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab)
    settle_for(lab, f"after_s = 0.0\n{logging_command(lab)}\n")
    dragrig.run("drag", out=lab / "runs" / "monday", assignments={"rig.guard.force_limit_mN": 40})
    (ended,) = [line for line in told(lab) if "monday" in line]
    assert ended.startswith("dragrig: monday tripped | ")
    assert "40 mN" in ended


def test_nobody_is_told_of_a_short_session(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab)
    settle_for(lab, f"after_s = 600\n{logging_command(lab)}\n")
    dragrig.run("drag", out=lab / "runs" / "monday")
    assert told(lab) == []


def test_a_letter_reaches_a_mail_server(lab: Path, mail: tuple[Controller, Mailbox]) -> None:
    controller, mailbox = mail
    address = f"mailto://127.0.0.1:{controller.port}?smtp=127.0.0.1&mode=insecure&from=rig@lab.org&to=anna@lab.org"
    settle_for(lab, f'addresses = ["{address}"]')
    (check,) = check_notification(lab)
    assert check.passed, check
    (letter,) = mailbox.letters
    assert letter["Subject"] == "dragrig: a trial"
    assert "anna@lab.org" in letter["To"]


def test_addresses_that_differ_in_hidden_parts_alone_are_all_sent_to(
    lab: Path, mail: tuple[Controller, Mailbox]
) -> None:
    controller, mailbox = mail
    address = f"mailto://127.0.0.1:{controller.port}/anna@lab.org?smtp=127.0.0.1&mode=insecure&from="
    settle_for(lab, f'addresses = ["{address}rig@lab.org", "{address}other@lab.org"]')
    assert [check.passed for check in check_notification(lab)] == [True, True]
    assert len(mailbox.letters) == 2


def test_failures_are_told_without_a_password_and_end_nothing(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab)
    address = "mailto://user:secret@localhost:1?smtp=127.0.0.1&mode=insecure&from=rig@lab.org&to=anna@lab.org"
    fails = f"""command = ['{sys.executable}', '-c', 'raise SystemExit("no line")']"""
    settle_for(lab, f'after_s = 0.0\naddresses = ["{address}"]\n{fails}\n')
    made = dragrig.run("drag", out=lab / "runs" / "monday")
    assert made.session.status == "complete"
    said: list[str] = []
    Notifier(lab, said.append).ended("monday", "complete", "")
    by_program, by_mail = sorted(said, key=lambda sentence: "mailto" in sentence)
    assert by_program == f"No notification by command {sys.executable}: it ended with code 1: no line."
    assert by_mail.endswith("the server did not take it.")
    files = b"".join(path.read_bytes() for path in (lab / "runs" / "monday").iterdir())
    assert b"secret" not in files
    assert "secret" not in by_mail


def test_a_program_that_hangs_keeps_nobody(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notification, "_SENDING_S", 0.3)
    settle_for(lab, f"command = ['{sys.executable}', '-c', 'import time; time.sleep(30)']")
    begun_s = time.monotonic()
    (check,) = check_notification(lab)
    assert time.monotonic() - begun_s < 20
    assert not check.passed
    assert check.detail == "it took more than 0.3 s"


DESKTOP = """
import asyncio, sys
from dbus_fast.aio import MessageBus
from dbus_fast.service import ServiceInterface, dbus_method
from pathlib import Path
from dragrig.notification import check_notification

shown = []

class Notifications(ServiceInterface):
    @dbus_method()
    def Notify(
        self, app: "s", number: "u", icon: "s", title: "s", text: "s", actions: "as", hints: "a{sv}", ms: "i"
    ) -> "u":
        shown.append((app, title, sorted(hints)))
        return 1
    @dbus_method()
    def GetCapabilities(self) -> "as":
        return ["body", "sound"]
    @dbus_method()
    def GetServerInformation(self) -> "ssss":
        return ["test", "test", "1", "1.2"]

async def main():
    bus = await MessageBus().connect()
    bus.export("/org/freedesktop/Notifications", Notifications("org.freedesktop.Notifications"))
    await bus.request_name("org.freedesktop.Notifications")
    (check,) = await asyncio.to_thread(lambda: list(check_notification(Path(sys.argv[1]))))
    print(check.passed, shown)

asyncio.run(main())
"""


@pytest.mark.skipif(shutil.which("dbus-run-session") is None, reason="needs Linux, and its package dbus")
def test_a_desktop_shows_it_with_a_sound(lab: Path) -> None:
    settle_for(lab, "desktop = true")
    command = ["dbus-run-session", "--", sys.executable, "-c", DESKTOP, str(lab)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True [('dragrig', 'dragrig: a trial', ['sound-name', 'urgency'])]"


@pytest.mark.skipif(sys.platform != "linux", reason="Windows always has a desktop")
def test_where_no_desktop_is_the_check_says_so(lab: Path) -> None:
    settle_for(lab, "desktop = true")
    bare = {name: value for name, value in os.environ.items() if name not in {"DBUS_SESSION_BUS_ADDRESS", "DISPLAY"}}
    command = [sys.executable, "-m", "dragrig", "check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=lab, env=bare)
    assert done.returncode == 5
    assert "there is no desktop that shows notifications" in " ".join(done.stdout.split())
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ('addresses = ["anna at lab"]', "addresses[0] is no address that Apprise knows"),
        ("after_s = -1", "after_s"),
        ('adresses = ["ntfy://rig"]', "did you mean addresses"),
    ],
)
def test_a_mistake_is_said_before_anything_moves(lab: Path, settings: str, sentence: str) -> None:
    settle_for(lab, settings)
    with pytest.raises(SettingsError) as said:
        Notifier(lab, print)
    assert sentence in str(said.value)
    assert "notification.toml" in str(said.value)


def test_what_is_not_installed_is_named_with_its_remedy(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "apprise", None)
    settle_for(lab, 'addresses = ["ntfy://rig"]')
    with pytest.raises(SettingsError, match=r'pip install "dragrig\[notification\]"'):
        Notifier(lab, print)
