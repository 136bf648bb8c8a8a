"""Pieces of work side by side: the same results, nothing lost, nothing twice, whoever is killed."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path

import pytest

from clusters import dask_cluster
from dragrig import parallel as processes
from dragrig.config.errors import SettingsError, WorkerError
from dragrig.parallel import SerialExecutor, available_cores, open_executor, parallel_map
from ending import kill
from loaded_processes import loaded_processes
from spreading_pieces import PATIENCE_S, deadly, failing, loaded, product, traced

SEEDS = range(6)


@pytest.fixture(scope="module", autouse=True)
def starting_at_once() -> Iterator[None]:
    """Start worker processes of a process that has loaded what they need."""
    with loaded_processes():
        yield


def kill_when_begun(folder: Path, answer: list[int], done_before: list[int]) -> threading.Thread:
    """Kill the process that works on number 3 as soon as it does, and note what had been told by then."""

    def wait_and_kill() -> None:
        trace = folder / "3-begun-0"
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            if trace.exists() and (pid := trace.read_text("utf-8")):
                done_before.extend(answer)
                kill(int(pid))
                return
            time.sleep(0.01)

    thread = threading.Thread(target=wait_and_kill)
    thread.start()
    return thread


def require_nothing_lost_or_twice(folder: Path, result: list[bytes], answer: list[int], once: list[int]) -> None:
    assert result == [product(seed) for seed in SEEDS]
    assert sorted(answer) == list(SEEDS)
    assert len(list(folder.glob("3-begun-*"))) == 2
    for seed in once:
        assert [path.name for path in folder.glob(f"{seed}-ended-*")] == [f"{seed}-ended-0"]


@pytest.fixture(scope="module")
def two() -> Iterator[Executor]:
    with open_executor(2) as executor:
        yield executor


def test_results_are_the_same_bits_in_the_order_of_the_pieces_for_any_number_of_workers(two: Executor) -> None:
    with open_executor(1) as here:
        assert isinstance(here, SerialExecutor)
        alone = parallel_map(here, product, SEEDS)
    assert parallel_map(two, product, SEEDS) == alone
    assert alone == [product(seed) for seed in SEEDS]


def test_a_process_killed_midway_loses_nothing_and_does_nothing_twice(two: Executor, tmp_path: Path) -> None:
    answer: list[int] = []
    killer = kill_when_begun(tmp_path, answer, [])
    pieces = [(tmp_path, seed) for seed in SEEDS]
    result = parallel_map(two, traced, pieces, lambda piece, _: answer.append(piece[1]))
    killer.join()
    require_nothing_lost_or_twice(tmp_path, result, answer, list(SEEDS))


def test_a_process_killed_while_it_waits_is_replaced() -> None:
    with open_executor(1, own_process=True) as entry:
        [(pid, _)] = parallel_map(entry, loaded, ["dragrig"])
        assert pid != os.getpid()
        kill(pid)
        [(second, _)] = parallel_map(entry, loaded, ["dragrig"])
    assert second not in {pid, os.getpid()}


def test_a_piece_that_takes_every_process_along_is_given_up_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """No dead pool is shut down or let go in its own thread.

    From Python 3.12 on that thread holds the pool's lock then, and would wait for it for ever.
    """
    where: list[threading.Thread] = []

    class Noted(ProcessPoolExecutor):
        def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
            where.append(threading.current_thread())
            super().shutdown(wait, cancel_futures=cancel_futures)

        def __del__(self) -> None:
            where.append(threading.current_thread())

    monkeypatch.setattr(processes, "ProcessPoolExecutor", Noted)
    with pytest.raises(WorkerError, match="ended 3 times"), open_executor(1, own_process=True) as entry:
        parallel_map(entry, deadly, [1])
    assert set(where) == {threading.main_thread()}


@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_piece_raises_comes_out_once_what_was_done_before_has_been_told(workers: int, two: Executor) -> None:
    answer: list[tuple[int, int]] = []
    some = two if workers == 2 else SerialExecutor()
    with pytest.raises(ValueError, match="not liked"):
        parallel_map(some, failing, [0, 0, 0, 1], lambda piece, result: answer.append((piece, result)))
    assert answer == [(0, 0)] * len(answer)
    assert len(answer) >= 4 - workers


def test_workers_are_the_cores_unless_told() -> None:
    with open_executor(tasks=1) as entry:
        assert isinstance(entry, SerialExecutor)
    assert available_cores() >= 1
    with pytest.raises(SettingsError, match="at least one worker"), open_executor(0):
        pass
    with pytest.raises(SettingsError, match="give one"), open_executor(2, "tcp://127.0.0.1:1"):
        pass


def test_a_dask_cluster_gives_the_same_and_is_refused_without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster:
        with monkeypatch.context() as hasty:
            hasty.setattr("dragrig.parallel.CLUSTER_TIMEOUT_S", 1)
            refused = pytest.raises(SettingsError, match="has no workers")
            with refused, open_executor(scheduler=cluster.scheduler_address):
                pass
        cluster.scale(1)
        with open_executor(scheduler=cluster.scheduler_address) as workers:
            assert parallel_map(workers, product, SEEDS) == [product(seed) for seed in SEEDS]


@pytest.mark.thorough
def test_a_dask_cluster_whose_worker_is_killed_midway_gives_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a busy machine its processes take long to start.
    monkeypatch.setattr("dragrig.parallel.CLUSTER_TIMEOUT_S", 100)
    answer, done_before = list[int](), list[int]()
    with dask_cluster() as address:
        killer = kill_when_begun(tmp_path, answer, done_before)
        with open_executor(scheduler=address) as workers:
            pieces = [(tmp_path, seed) for seed in SEEDS]
            result = parallel_map(workers, traced, pieces, lambda piece, _: answer.append(piece[1]))
        killer.join()
    # What a worker had done but not yet handed over when it was killed is done anew by another.
    require_nothing_lost_or_twice(tmp_path, result, answer, done_before)


@pytest.mark.thorough
def test_a_cluster_that_goes_away_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("dragrig.parallel.CLUSTER_TIMEOUT_S", 100)
    with dask_cluster(1) as address:
        from distributed import Client

        with Client(address, set_as_default=False) as client:
            scheduler = client.run_on_scheduler(os.getpid)
        finished: list[int] = []

        def told(piece: tuple[Path, int], _: bytes) -> None:
            finished.append(piece[1])
            kill(scheduler)

        with pytest.raises(WorkerError, match="the cluster went away"), open_executor(scheduler=address) as workers:
            parallel_map(workers, traced, [(tmp_path, seed) for seed in SEEDS], told)
    assert finished


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "abc://x:1"])
def test_a_scheduler_that_does_not_answer_is_told(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dragrig.parallel.CLUSTER_TIMEOUT_S", 1)
    with pytest.raises(SettingsError, match="no Dask scheduler answers there"), open_executor(scheduler=address):
        pass


def test_dask_that_is_not_installed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(SettingsError, match=r"install dragrig\[dask\]"),
        open_executor(scheduler="tcp://127.0.0.1:8786"),
    ):
        pass
