"""Clocks of foreign files: even grids, gaps, late stamps, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.analysis.importing.conversion import detect_phases
from dragrig.analysis.importing.readers import read_foreign
from dragrig.analysis.importing.time_grid import counted_grid, fit_sample_grid, resample
from dragrig.config.errors import ImportDataError
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from places import DATA
from property_tests import examples

HERE = Path("clock.csv")
FOREIGN = DATA / "foreign"


def stamps(rate: float, index: object, decimals: int = 9, start: float = 0.0) -> FloatArray:
    return np.round(start + np.asarray(index, dtype=np.float64) / rate, decimals)


@settings(max_examples=examples(150), deadline=None)
@given(
    rate=st.sampled_from([1.0, 7.0, 60.0, 100.0, 333.0, 500.0, 1000.0, 48_000.0]),
    rows=st.integers(50, 3000),
    lost=st.lists(st.tuples(st.integers(1, 2998), st.integers(1, 40)), max_size=4),
    start=st.sampled_from([0.0, 12.5, 20_086.207]),
)
def test_an_even_clock_gives_its_rate_and_every_gap(
    rate: float, rows: int, lost: list[tuple[int, int]], start: float
) -> None:
    index = np.arange(rows)
    for at, count in lost:
        index[at:] += count
    grid = fit_sample_grid(HERE, stamps(rate, index, 7, start), 0.1)
    assert grid.sample_rate_hz == pytest.approx(rate, rel=1e-9)
    np.testing.assert_array_equal(grid.index, index)
    assert sum(event.kind == "gap" for event in grid.events) == np.count_nonzero(np.diff(index) > 1)


def test_rounded_stamps_are_put_back_in_their_places() -> None:
    grid = fit_sample_grid(HERE, stamps(300.0, np.arange(5000), 3), 0.1)
    assert grid.sample_rate_hz == pytest.approx(300, rel=1e-6)
    np.testing.assert_array_equal(grid.index, np.arange(5000))
    assert grid.events == ()
    assert grid.time[-1] == pytest.approx(4999 / 300)


def test_rows_off_the_grid_are_refused_and_counted() -> None:
    late = stamps(1000.0, np.arange(2000))
    late[700:705] += np.array([0.0024, 0.0016, 0.0012, 0.0007, 0.0003])
    with pytest.raises(match=r"5 of 2000 rows are off an even rate of 1000 Hz, the first at 0\.7024 s"):
        fit_sample_grid(HERE, late, 0.1)
    grid = counted_grid(HERE, late, np.arange(2000), 1000.0)
    np.testing.assert_array_equal(grid.index, np.arange(2000))


def test_the_motors_stalls_are_in_its_positions_so_that_rows_must_not_be_moved() -> None:
    table = read_foreign(FOREIGN / "cogging" / "speed_test.txt")[0]
    time, position, velocity = (table.columns[k].values for k in (0, 1, 2))
    with pytest.raises(match=r"rows are off an even rate of 1000 Hz.*resample_hz"):
        fit_sample_grid(table.path, time, 0.1)
    stall = int(np.diff(time).argmax())
    moved = position[stall + 2] - position[stall + 1]
    assert moved == pytest.approx(velocity[stall + 2] * (time[stall + 1] - time[stall]), rel=0.15)
    grid, columns = resample(time, {"position": position}, 1000.0)
    assert grid.sample_rate_hz == 1000
    assert np.abs(columns["position"] - np.interp(time[0] + grid.time, time, position)).max() < 1e-12


def test_uneven_and_changing_clocks_are_refused_with_what_can_be_done() -> None:
    sepiolite = read_foreign(FOREIGN / "velocity-steps" / "sepiolite.txt")[0]
    with pytest.raises(match=r"0\.126 to 0\.176 s apart.*unevenly.*state resample_hz"):
        fit_sample_grid(sepiolite.path, sepiolite.columns[0].values, 0.1)
    basalt = read_foreign(FOREIGN / "velocity-steps" / "basalt.txt")[0]
    with pytest.raises(match=r"0\.1 s apart at the start and 0\.01 s at the end.*from_s and to_s"):
        fit_sample_grid(basalt.path, basalt.columns[0].values, 0.1)


def test_a_clock_coarser_than_the_sampling_is_refused_until_the_rate_is_stated() -> None:
    coarse = stamps(3000.0, np.arange(300), 3)
    with pytest.raises(match=r"several rows have the time .* state sample_rate_hz"):
        fit_sample_grid(HERE, coarse, 0.1)
    grid = counted_grid(HERE, coarse, np.arange(300), 3000.0)
    np.testing.assert_allclose(grid.time, np.arange(300) / 3000)
    with pytest.raises(ImportDataError, match=r"300 rows at 1000 Hz span 0\.299 s, their time stamps 0\.1 s"):
        counted_grid(HERE, coarse, np.arange(300), 1000.0)


def test_a_tolerance_can_be_stated() -> None:
    early = stamps(1000.0, np.arange(500))
    early[250] -= 0.0004
    np.testing.assert_array_equal(fit_sample_grid(HERE, early, 0.45).index, np.arange(500))
    with pytest.raises(ImportDataError):
        fit_sample_grid(HERE, early, 0.1)


def test_one_row_has_no_rate() -> None:
    with pytest.raises(ImportDataError, match="1 row only"):
        fit_sample_grid(HERE, np.array([3.0]), 0.1)


def test_resampling_keeps_straight_lines_and_says_what_it_did() -> None:
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.12, 0.18, 500))
    grid, columns = resample(times, {"line": 3 * times, "level": np.full(500, 7.0)}, 7.0)
    np.testing.assert_allclose(columns["line"], 3 * (times[0] + grid.time), atol=1e-9)
    np.testing.assert_allclose(columns["level"], 7.0)
    assert "resampled to 7 Hz from 500 rows" in grid.events[0].message


def test_downsampling_averages_so_that_fast_parts_do_not_alias() -> None:
    times = np.arange(10_000) / 1000
    fast = np.sin(2 * np.pi * 99 * times)
    grid, columns = resample(times, {"fast": fast}, 20.0)
    assert np.abs(columns["fast"][1:-1]).max() < 0.25
    assert "200 samples are means" in grid.events[0].message


def test_gaps_are_never_filled_and_invented_samples_are_counted() -> None:
    times = np.concatenate((np.arange(200) * 0.1, 60 + np.arange(200) * 0.1))
    grid, columns = resample(times, {"x": times}, 20.0)
    assert not ((grid.time > 19.95) & (grid.time < 59.95)).any()
    np.testing.assert_allclose(columns["x"], grid.time, atol=1e-9)
    kinds = [event.kind for event in grid.events]
    assert kinds.count("gap") == 1
    assert "not measured" in grid.events[1].message


@pytest.mark.parametrize("direction", [1, -1])
def test_phases_of_a_single_move_are_found(direction: int) -> None:
    profile = MotionProfile.from_pieces(
        (
            stationary_piece(1.0, Phase.REST),
            *trapezoid(direction * 40.0, 20.0, 100.0),
            stationary_piece(2.0, Phase.HOLD),
        )
    )
    time = np.arange(profile.samples(500.0)) / 500
    result = detect_phases(np.round(profile.position(time), 3), 500.0)
    assert result is not None
    wanted = profile.phase_at(time)
    assert (result == wanted).mean() > 0.97
    assert sorted(set(result.tolist())) == [0, 1, 2, 3, 4]


def test_no_phases_are_made_up() -> None:
    time = np.arange(5000) / 500
    assert detect_phases(np.zeros(5000), 500.0) is None
    assert detect_phases(5 * time, 500.0) is None
    assert detect_phases(np.sin(time), 500.0) is None
    back_and_forth = np.interp(time, [0, 1, 3, 4, 6, 10], [0, 0, 20, 20, 0, 0])
    assert detect_phases(back_and_forth, 500.0) is None
    two_speeds = np.interp(time, [0, 1, 4, 7, 10], [0, 0, 3, 30, 30])
    assert detect_phases(two_speeds, 500.0) is None
    assert detect_phases(np.full(5000, np.nan), 500.0) is None
    assert detect_phases(np.zeros(3), 500.0) is None
