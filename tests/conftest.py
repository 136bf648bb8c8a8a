"""The two tiers of the tests, and disks and folders that refuse, for root too."""

import gc
import os
import subprocess
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock
from hypothesis import settings

# Tests run side by side, so that a second thread of linear algebra only waits for the first.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests start hundreds of processes, and run in several. Where bytecode must not be written beside its source, each
# would compile all that it imports, for a second and more, so its bytecode is kept with what pytest remembers.
if sys.dont_write_bytecode:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(Path(__file__).parents[1] / ".pytest_cache" / "bytecode")
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"]
    sys.dont_write_bytecode = False

if os.name == "nt":
    # Elsewhere programs write UTF-8 into a pipe; Windows' would write in the letters of its consoles.
    os.environ.setdefault("PYTHONIOENCODING", "utf-8")

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("PYTEST_QT_API", "pyside6")

import finishing
from disks import is_root, mounted
from places import ROOT
from windows import lacking

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from diagnosed import DiagnosedCampaigns
    from rig_faults import Bench

# What is loaded and collected stays till the end, and to look through it again and again takes a third of the time.
gc.disable()

# How long an example takes says how busy the machine is, so no example fails by its time.
settings.register_profile("line", deadline=None, max_examples=25)
settings.register_profile("thorough", deadline=None, max_examples=300)

# Where Qt cannot be loaded its plugin would end every test, so it is loaded here and not by itself.
pytest_plugins = () if lacking() else ("pytestqt.plugin",)


def pytest_configure(config: pytest.Config) -> None:
    """Try properties with as many examples as the tier has time for."""
    settings.load_profile("thorough" if is_thorough(config) else "line")


def is_thorough(config: pytest.Config) -> bool:
    """Tell whether the tests that `pytest -m thorough` adds to the test line are asked for."""
    return config.getoption("markexpr") == "thorough"


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Have a single process compile the tests where that was never done, for all others would compile the same."""
    if hasattr(session.config, "workerinput"):
        cache = ROOT / ".pytest_cache"
        cache.mkdir(exist_ok=True)
        compiled = cache / f"compiled-{sys.implementation.cache_tag}"
        with FileLock(f"{compiled}.lock"):
            if not compiled.exists():
                result = yield
                compiled.touch()
                return result
    return (yield)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Count properties among the thorough tests too, where they have more examples; begin with the types.

    To check them takes a minute of one core where nothing is cached, in which the other would idle at the end. Tests
    that wait for a stage are spread over all others, so that a process that waits leaves its core to one that works.
    """
    waiting = {path for path in {item.path for item in items} if waits_for_a_stage(path)}
    counts = [Counter(item.path for item in items if (item.path in waiting) == waits) for waits in (True, False)]
    turns = {
        path: before / modules.total()
        for modules in counts
        for path, before in zip(modules, accumulate(modules.values(), initial=0), strict=False)
    }
    items.sort(key=lambda item: (item.path.name != "test_house.py", turns[item.path]))
    if is_thorough(config):
        for item in items:
            if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
                item.add_marker("thorough")


def waits_for_a_stage(path: Path) -> bool:
    """Tell whether a file's tests are of a room where a stage moves, or its engine or window waits for it."""
    return any((ROOT / "tests" / room) in path.parents for room in ("rig", "app/engine_host", "app/window"))


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Say at the end of the test line what it leaves out."""
    if config.getoption("markexpr") == "not thorough":
        (left_out,) = (line for line in config.getini("markers") if line.startswith("thorough:"))
        sentence = f"Not in this line: {left_out.removeprefix('thorough: ')}. They run with"
        for line in (*textwrap.wrap(sentence, 80), "    python3 -m uv run pytest -m thorough"):
            terminalreporter.write_line(line)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Spare the garbage collector what stays till the end: all modules and all tests that were collected."""
    gc.collect()
    gc.freeze()
    gc.enable()
    if hasattr(session.config, "workerinput"):
        # A rig freezes all objects for its time: what it lets go of afterwards would be looked through at the next.
        gc.unfreeze = lambda: None  # type: ignore[assignment]


@pytest.fixture(scope="module")
def finished_here() -> Iterator[None]:
    """Have this process finish its run files: to start another takes longer than a quick session itself."""
    with finishing.finished_here():
        yield


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all processes of a test run share; what is made in it needs a file lock."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def diagnosed(shared_folder: Path) -> "DiagnosedCampaigns":
    """Campaigns with a known secret and their diagnoses, by name."""
    from diagnosed import DiagnosedCampaigns

    return DiagnosedCampaigns(shared_folder)


@pytest.fixture(scope="module")
def faulty_bench(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[Bench]":
    """The real rig's devices, doubled for a module's tests, with a lab folder.

    No longer than that, for the doubles of a stage that stands take processor time all the same.
    """
    from rig_faults import bench

    with bench(tmp_path_factory.mktemp("lab")) as entry:
        yield entry


@pytest.fixture
def faulty_rig(faulty_bench: "Bench") -> "Iterator[Bench]":
    """The same, repaired after the test."""
    yield faulty_bench
    faulty_bench.repair()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 32 MB, which only root on Linux can have."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not is_root() or not mounted("-t", "tmpfs", "-o", "size=32m", "tmpfs", str(folder)):
        pytest.skip("mounting a small disk to fill it needs root on Linux")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def close_folder() -> Iterator[Callable[[Path], None]]:
    """Return what makes a folder refuse files: by its mode, or for root by mounting it read-only over itself."""
    closed: list[Path] = []

    def close(folder: Path) -> None:
        if os.name == "nt":
            pytest.skip("a folder's mode means nothing on Windows")
        if not is_root():
            folder.chmod(0o500)
        elif mounted("--bind", str(folder), str(folder)):
            closed.append(folder)
            assert mounted("-o", "remount,ro,bind", str(folder))
        else:
            pytest.skip("root may write anywhere, and nothing can be mounted here")

    yield close
    for folder in closed:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """A real Chromium without a window; where there is none, the test is skipped, and fails where CI is true."""
    from browsing import chromium

    with chromium() as entry:
        yield entry
