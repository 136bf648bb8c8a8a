"""Live samples: read in order, each once; who reads late has missed the oldest and is told."""

import multiprocessing

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.engine_host.messages import LiveRingReader, LiveRingWriter, shared_memory
from dragrig.rig.reading import Reading
from property_tests import examples

RATE_HZ = 1000.0


def reading(first: int, count: int) -> Reading:
    index = np.arange(first, first + count)
    phase = (index // 7 % 5).astype(np.uint8)
    values = index.astype(np.float32)
    return Reading(first, index / RATE_HZ, values, phase, {"force": values, "position": -values})


def ring(samples: int) -> tuple[LiveRingWriter, LiveRingReader]:
    memory = shared_memory(multiprocessing.get_context("spawn"), samples)
    return LiveRingWriter(memory), LiveRingReader(memory)


@settings(deadline=None, max_examples=examples(60))
@given(st.lists(st.tuples(st.integers(1, 90), st.integers(0, 30), st.booleans()), min_size=1, max_size=40))
def test_samples_are_read_as_written(blocks: list[tuple[int, int, bool]]) -> None:
    writer, reader = ring(256)
    writer.begin()
    at = seen = 0
    for count, lost, looks in blocks:
        at += lost
        writer.put(reading(at, count))
        at += count
        if not looks:
            continue
        fresh = reader.read()
        assert fresh is not None
        assert fresh.first_index == seen + fresh.missed
        assert fresh.first_index + len(fresh.force) == at
        seen = at
        index = np.arange(fresh.first_index, at)
        there = ~np.isnan(fresh.force)
        np.testing.assert_array_equal(fresh.force[there], index[there])
        np.testing.assert_array_equal(fresh.position[there], -index[there])
        assert fresh.rate_hz == RATE_HZ
        assert reader.read() is None


def test_a_late_reader_knows_how_many_samples_it_missed() -> None:
    writer, reader = ring(256)
    writer.begin()
    for first in range(0, 1000, 50):
        writer.put(reading(first, 50))
    fresh = reader.read()
    assert fresh is not None
    assert fresh.missed == 1000 - len(fresh.force) > 0
    assert fresh.force[-1] == 999


def test_lost_samples_leave_a_gap() -> None:
    writer, reader = ring(1024)
    writer.begin()
    writer.put(reading(0, 10))
    writer.put(reading(40, 10))
    fresh = reader.read()
    assert fresh is not None
    assert np.isnan(fresh.force[10:40]).all()
    assert fresh.force[40] == 40


def test_a_block_larger_than_the_ring_keeps_its_end() -> None:
    writer, reader = ring(128)
    writer.begin()
    writer.put(reading(0, 1000))
    fresh = reader.read()
    assert fresh is not None
    np.testing.assert_array_equal(fresh.force, np.arange(fresh.first_index, 1000))


def test_the_next_run_counts_from_its_own_start() -> None:
    writer, reader = ring(256)
    writer.begin()
    writer.put(reading(0, 100))
    first = reader.read()
    writer.begin()
    writer.put(reading(0, 30))
    second = reader.read()
    assert first is not None
    assert second is not None
    assert second.serial != first.serial
    assert (second.first_index, len(second.force), second.missed) == (0, 30, 0)
