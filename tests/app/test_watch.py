"""Following a campaign from elsewhere: what is seen while it runs, when it waits, when it is over."""

import errno
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

import dragrig
from dragrig.campaign_session import start_campaign
from dragrig.cli import main
from dragrig.config.errors import OutputError, RunFileError
from dragrig.hosted_session import SessionOptions
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.programme import PlannedRun
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import RunStatus
from dragrig.session_state import LOCK_FILE, STATE_FILE, SessionState, read_state, session_lock
from dragrig.setup import resolve
from dragrig.watch import (
    HIDDEN_TAB_S,
    MAX_CONNECTIONS,
    MAX_TAB_CHARACTERS,
    MAX_TABS,
    CampaignState,
    CampaignWatch,
    serve_state_page,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.usefixtures("finished_here")
INTERPRETER = sys.executable
PLAN = """
name = "two"
[[steps]]
kind = "blank"
speed_mm_s = [20.0, 40.0]
travel_mm = 10.0
prompt = "Take the capsule off"
"""


class Onlooker(NullOperator):
    """Answers prompts, and looks at the campaign while the session is asked something and while it records."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.asked: list[CampaignState] = []
        self.recorded: list[CampaignState] = []
        self.state_written_ns: set[int] = set()
        """When the state file was written that is there while samples are taken."""
        self.process: subprocess.Popen[str] | None = None
        self.followed = ""

    def ask(self, prompt: Prompt) -> Answer:
        self.asked.append(CampaignWatch(self._folder).look())
        self.process = subprocess.Popen(
            [INTERPRETER, "-m", "dragrig", "watch", str(self._folder.parent), "--every", "0.05"],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert "waiting for the operator: Take the capsule off" in self.process.stdout.readline()
        return Answer.DONE

    def reads(self, reading: Reading) -> None:
        self.state_written_ns.add((self._folder / STATE_FILE).stat().st_mtime_ns)
        if reading.time[-1] > 0.5 and not self.recorded:
            watch = CampaignWatch(self._folder)
            while (state := watch.look()).recording is None or not state.recording.samples:
                pass  # what was offered is on file within a flush
            self.recorded.append(state)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Onlooker]:
    folder = tmp_path_factory.mktemp("runs") / "two"
    plan = folder.parent / "two.toml"
    plan.write_text(PLAN, "utf-8")
    onlooker = Onlooker(folder)
    try:
        made = dragrig.run(str(plan), out=folder, person=onlooker, assignments=["rig.recording.flush_s=0.02"])
        made.session.require()
        assert onlooker.process is not None
        onlooker.followed, _ = onlooker.process.communicate()
        yield onlooker
    finally:
        if onlooker.process is not None and onlooker.process.poll() is None:
            onlooker.process.kill()
            onlooker.process.communicate()


def test_an_open_prompt_is_shown(seen: Onlooker) -> None:
    [state] = seen.asked
    assert (state.doing, state.message) == ("asking", "Take the capsule off")
    assert (state.run, state.runs, state.finished) == (0, 4, ())
    assert state.left_s is None  # on a simulated rig nobody knows yet
    assert not state.over


def test_a_run_is_shown_while_it_is_recorded(seen: Onlooker) -> None:
    [state] = seen.recorded
    assert (state.doing, state.run, state.backend) == ("recording", 1, "simulated")
    recording = state.recording
    assert recording is not None
    assert (recording.kind, recording.order) == ("blank", 0)
    assert recording.phase in {"rest", "accelerate", "steady"}
    assert 0 < recording.time_s < (recording.run_s or 0)
    assert recording.samples == pytest.approx(1000 * recording.time_s, abs=2)
    assert recording.force_mN == pytest.approx(0.0, abs=20.0)
    assert 1 < len(recording.recent_s) == len(recording.recent_mN) < 700


def test_the_state_is_written_once_a_run_and_never_while_it_samples(seen: Onlooker) -> None:
    assert len(seen.state_written_ns) == 4


def test_following_from_another_process_ends_with_the_campaign(seen: Onlooker) -> None:
    assert seen.process is not None
    assert seen.process.returncode == 0
    assert seen.followed.splitlines()[-1] == "two: 4 of 4 runs, ended, complete"


def test_an_ended_campaign_shows_its_status(seen: Onlooker, capsys: pytest.CaptureFixture[str]) -> None:
    folder = seen.asked[0].folder
    before = {path: path.stat().st_mtime_ns for path in (folder, *folder.iterdir())}
    assert main(["watch", str(folder), "--once", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["doing"], answer["status"], answer["recording"], answer["left_s"]) == (
        "ended",
        "complete",
        None,
        None,
    )
    assert [row["kind"] for row in answer["finished"]] == ["blank", "return", "blank", "return"]
    assert main(["watch", str(folder)]) == 0
    assert capsys.readouterr().out == "two: 4 of 4 runs, ended, complete\n"
    assert {path: path.stat().st_mtime_ns for path in (folder, *folder.iterdir())} == before


def test_a_session_whose_process_is_gone_has_died(seen: Onlooker, tmp_path: Path) -> None:
    state = read_state(seen.asked[0].folder)
    assert isinstance(state, SessionState)
    (tmp_path / "session-1.toml").touch()
    (tmp_path / "20260504-093000-blank-000.recording.h5").touch()
    (tmp_path / STATE_FILE).write_text(state.model_copy(update={"doing": "recording"}).model_dump_json(), "utf-8")
    result = CampaignWatch(tmp_path).look()
    assert (result.doing, result.over, result.left_s) == ("died", True, None)
    assert "dragrig recover" in result.message


def test_without_locks_the_last_state_is_shown(seen: Onlooker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    state = read_state(seen.asked[0].folder)
    assert isinstance(state, SessionState)
    (tmp_path / "session-1.toml").touch()
    (tmp_path / LOCK_FILE).touch()
    (tmp_path / STATE_FILE).write_text(state.model_copy(update={"doing": "waiting"}).model_dump_json(), "utf-8")
    assert CampaignWatch(tmp_path).look().doing == "died"
    monkeypatch.setattr("msvcrt.locking" if sys.platform == "win32" else "fcntl.flock", flock)
    assert CampaignWatch(tmp_path).look().doing == "waiting"


@pytest.mark.parametrize("content", ["", "{}", '{"plan": 1', "\x00"])
def test_a_damaged_state_is_ignored(content: str, tmp_path: Path) -> None:
    (tmp_path / "session-1.toml").touch()
    (tmp_path / STATE_FILE).write_text(content, "utf-8")
    assert CampaignWatch(tmp_path).look().message == "no session is running here"


def test_a_session_without_a_state_has_not_ended(tmp_path: Path) -> None:
    (tmp_path / "session-1.toml").touch()
    with session_lock(tmp_path):
        state = CampaignWatch(tmp_path).look()
    assert (state.doing, state.over) == ("preparing", False)
    assert not (tmp_path / LOCK_FILE).exists()


def test_a_campaign_has_one_session_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not a run is being recorded: the other session waits for a person."""
    monkeypatch.setattr("dragrig.session_state.LOCK_TIMEOUT_S", 0.1)
    folder = tmp_path / "runs" / "one"
    answer: list[str] = []

    class Second(NullOperator):
        def ask(self, prompt: Prompt) -> Answer:
            for again in (
                lambda: dragrig.resume(folder),
                lambda: dragrig.run("blank", out=folder, assignments=["rig.sampling.rate_hz=200"]),
            ):
                with pytest.raises(OutputError) as refused:
                    again()
                answer.append(str(refused.value))
            answer.append(CampaignWatch(folder).look().doing)
            return super().ask(prompt)

    plan = tmp_path / "one.toml"
    plan.write_text(PLAN, "utf-8")
    dragrig.run(str(plan), out=folder, person=Second()).session.require()
    assert len(answer) == 3
    assert all("another session of this campaign is running" in entry for entry in answer[:2])
    assert answer[2] == "asking"
    assert len(list(folder.glob("session-*.toml"))) == 1


def test_sessions_started_at_once_have_separate_folders(tmp_path: Path) -> None:
    at = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)
    setup = resolve("blank", assignments=[f"rig.data.root='{tmp_path}'", "rig.sampling.rate_hz=200", "speed_mm_s=20"])
    with ThreadPoolExecutor(3) as some:
        made = list(some.map(lambda _: start_campaign(setup, None, SessionOptions(Path(), origin=at), None), range(3)))
    assert [entry.session.status for entry in made] == [RunStatus.COMPLETE] * 3
    names = sorted(entry.folder.name for entry in made)
    assert names == ["20260504-093000-blank", *(f"20260504-093000-blank-{nth}" for nth in (2, 3))]


def test_runs_made_again_or_skipped_count_once(tmp_path: Path) -> None:
    plan = tmp_path / "some.toml"
    plan.write_text(PLAN.replace("prompt =", "prompt_each = true\nprompt ="), "utf-8")
    folder = tmp_path / "some"
    answers = iter((Answer.DONE, Answer.REDO, Answer.DONE, Answer.SKIP))
    at: list[tuple[int, int]] = []

    class Person(NullOperator):
        def ask(self, prompt: Prompt) -> Answer:
            return next(answers)

        def run_begins(self, run: PlannedRun, order: int) -> None:
            state = read_state(folder)
            assert state is not None
            at.append((state.made, state.runs))

    dragrig.run(str(plan), out=folder, person=Person()).session.require()
    assert at == [(1, 4), (2, 4), (1, 4), (2, 4)]


def test_a_disconnected_browser_does_no_harm(seen: Onlooker, capfd: pytest.CaptureFixture[str]) -> None:
    with serve_state_page(0) as page:
        page.html = b"x" * (1 << 24)
        with socket.create_connection(("127.0.0.1", page.port)) as gone:
            gone.sendall(b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
            assert gone.recv(10)
            gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        while [entry for entry in threading.enumerate() if "process_request_thread" in entry.name]:
            time.sleep(0.01)
    assert capfd.readouterr().err == ""


def test_a_folder_without_a_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunFileError, match="holds no campaign"):
        CampaignWatch(tmp_path)
    with pytest.raises(RunFileError, match="no such folder"):
        CampaignWatch(tmp_path / "gone")


def test_the_page_is_served_to_this_machine_alone(seen: Onlooker) -> None:
    with serve_state_page(0) as page:
        page.show(seen.recorded[0])
        address = f"http://127.0.0.1:{page.port}"
        with urlopen(f"{address}/state.json") as answer:
            assert json.load(answer)["doing"] == "recording"
        with pytest.raises(HTTPError, match="403"):
            urlopen(Request(f"{address}/state.json", headers={"Host": "elsewhere.example"}))
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{address}/etc")


def test_other_machines_need_the_token(seen: Onlooker) -> None:
    with serve_state_page(0, "0.0.0.0") as page:
        page.show(seen.recorded[0])
        own = f"http://127.0.0.1:{page.port}"
        for path in ("/", "/state.json", "/state.json?token=guess"):
            with pytest.raises(HTTPError, match="403"):
                urlopen(f"{own}{path}")
        assert page.address.endswith(f"/?token={page.token}")
        with urlopen(Request(f"{own}/state.json?token={page.token}", headers={"Host": "rig.lab"})) as answer:
            assert json.load(answer)["doing"] == "recording"


def test_every_tab_is_told_the_end(seen: Onlooker) -> None:
    def ask(tab: str) -> str:
        with urlopen(f"{page.address}state.json?tab={tab}") as answer:
            return str(json.load(answer)["doing"])

    with serve_state_page(0) as page:
        page.show(seen.recorded[0])
        assert {ask("desk"), ask("phone"), ask("closed")} == {"recording"}
        page.show(CampaignWatch(seen.asked[0].folder).look())
        waiting = threading.Thread(target=page.wait_for_tabs)
        waiting.start()
        assert ask("desk") == "ended"
        urlopen(f"{page.address}closed?tab=closed").close()
        waiting.join(0.2)
        assert waiting.is_alive()
        assert ask("phone") == "ended"
        waiting.join()


def test_a_tab_that_asks_no_more_is_not_waited_for_without_end(seen: Onlooker, monkeypatch: pytest.MonkeyPatch) -> None:
    assert HIDDEN_TAB_S == 70.0
    monkeypatch.setattr("dragrig.watch.HIDDEN_TAB_S", 0.3)
    with serve_state_page(0) as page:
        page.show(seen.recorded[0])
        urlopen(f"{page.address}state.json?tab=asleep").close()
        asked_s = time.monotonic()
        page.wait_for_tabs()
        assert time.monotonic() - asked_s > 0.1


def test_a_page_without_an_answer_says_since_when_and_goes_on_asking(seen: Onlooker, browser: "Browser") -> None:
    from playwright.sync_api import expect

    from browsing import PHONE_PX, opened

    with serve_state_page(0) as server:
        server.show(seen.recorded[0])
        port = server.port
        with opened(browser, f"http://127.0.0.1:{port}/", PHONE_PX) as (page, _):
            expect(page.locator("#run")).to_have_text("1 of 4", timeout=600_000)
            page.route("**/state.json*", lambda asked: asked.abort())
            expect(page.locator("#state")).to_contain_text("No answer from dragrig watch since", timeout=600_000)
            expect(page.locator("#run")).to_have_text("1 of 4")
            page.unroute("**/state.json*")
            expect(page.locator("#state")).to_contain_text("Records", timeout=600_000)


def server_threads() -> int:
    return sum("process_request_thread" in thread.name for thread in threading.enumerate())


def test_half_open_requests_are_few_at_a_time_and_keep_nobody_out(seen: Onlooker) -> None:
    with ExitStack() as stack, serve_state_page(0) as page:
        page.show(seen.recorded[0])
        most = 0
        for number in range(300):
            half = stack.enter_context(socket.create_connection(("127.0.0.1", page.port)))
            half.sendall(b"GET / HTTP/1.0\r\nHost: ")
            if number % 50 == 49:
                with urlopen(f"{page.address}state.json", timeout=60.0) as answer:
                    assert json.load(answer)["doing"] == "recording"
                most = max(most, server_threads())
        # The last to be ended may still be on their way.
        assert most <= 2 * MAX_CONNECTIONS


def test_a_request_that_never_ends_is_ended(seen: Onlooker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dragrig.watch.CONNECTION_S", 0.3)
    with serve_state_page(0) as page, socket.create_connection(("127.0.0.1", page.port)) as half:
        half.sendall(b"GET / HTTP/1.0\r\n")
        half.settimeout(60.0)
        assert half.recv(1) == b""


def test_a_request_without_bound_is_not_read(seen: Onlooker) -> None:
    with serve_state_page(0) as page, socket.create_connection(("127.0.0.1", page.port)) as endless:
        endless.settimeout(60.0)
        with suppress(OSError):
            endless.sendall(b"GET / HTTP/1.0\r\n" + b"X: " + b"y" * 60_000 + b"\r\n")
        received = b""
        with suppress(OSError):
            received = endless.recv(1 << 16)
        assert received == b""


def test_tabs_without_bound_are_forgotten(seen: Onlooker) -> None:
    with serve_state_page(0, "0.0.0.0") as page:
        page.show(seen.recorded[0])
        for number in range(2 * MAX_TABS):
            page.content(f"{number}{'x' * 1000}")
        tab = "y" * 3000
        urlopen(f"http://127.0.0.1:{page.port}/state.json?token={page.token}&tab={tab}").close()
        for number in range(MAX_TABS + 1, 2 * MAX_TABS):
            page.forget(f"{number}{'x' * 1000}")
        waiting = threading.Thread(target=page.wait_for_tabs)
        waiting.start()
        waiting.join(0.2)
        assert waiting.is_alive(), "the last tab was forgotten"
        page.forget(tab[:MAX_TAB_CHARACTERS])
        waiting.join(0.9 * HIDDEN_TAB_S)
        assert not waiting.is_alive(), "another tab is waited for"


def test_the_time_left_follows_the_pace(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    folder = tmp_path / "paced"
    folder.mkdir()
    (folder / "session-1.toml").touch()
    state = SessionState(plan="p", backend="simulated", doing="between", total_s=3600.0, after_s=2700.0, busy_s=10.0)

    def left_s(state: SessionState) -> float | None:
        (folder / STATE_FILE).write_text(state.model_dump_json(), "utf-8")
        with session_lock(folder):
            return CampaignWatch(folder).look().left_s

    state = state.model_copy(update={"since": now})
    left = left_s(state)
    assert left is not None
    assert 30.0 <= left < 3 * (10.0 + 600.0)
    asking = state.model_copy(update={"doing": "asking"})
    assert left_s(asking) == pytest.approx(30.0)
    assert left_s(asking.model_copy(update={"after_s": 3500.0})) is None
    assert left_s(asking.model_copy(update={"after_s": 3500.0, "real_time": True})) == 3500.0


def test_the_page_shows_the_run_and_its_end(seen: Onlooker, browser: "Browser") -> None:
    from playwright.sync_api import expect

    from browsing import PHONE_PX, opened

    with serve_state_page(0) as server:
        server.show(seen.recorded[0])
        address = f"http://127.0.0.1:{server.port}/"
        with opened(browser, address, PHONE_PX) as (page, heard):
            expect(page.locator("#run")).to_have_text("1 of 4", timeout=600_000)
            assert page.locator("#force").inner_text().endswith(" mN")
            assert page.locator("#line").get_attribute("points")
            assert page.evaluate("document.documentElement.scrollWidth") <= PHONE_PX
            server.show(CampaignWatch(seen.asked[0].folder).look())
            expect(page.locator("#state")).to_have_text("Over, complete", timeout=600_000)
            expect(page.locator("#left")).to_have_text("4 complete")
            assert page.locator("#runs tbody tr").count() == 4
            assert heard.messages == []
            assert {line.split("?")[0] for line in heard.requests} == {address, f"{address}state.json"}
