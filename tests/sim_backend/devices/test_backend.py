"""What a simulated rig keeps from one opening to the next, and what hangs on its sensor."""

from pathlib import Path

import pytest

import dragrig
from dragrig.rig.devices import RigMemory
from dragrig.rig.operator import NullOperator
from dragrig.setup import create_lab


def test_weights_on_the_simulated_sensor_give_its_gain_and_a_push_its_travel(tmp_path: Path) -> None:
    create_lab(tmp_path)
    rig = tmp_path / "rig.toml"
    force = dragrig.calibrate_force([0, 50, 100, 200], rig=rig, person=NullOperator())
    assert force.entry.gain == pytest.approx(1e3, rel=0.01)
    assert force.notes == ()
    travel = dragrig.calibrate_encoder(20.0, by_hand=True, duration_s=1.0, rig=rig, person=NullOperator())
    assert [point.counts for point in travel.points] == [20_000, -20_000, 20_000]


def test_position_and_home_outlast_an_opening_where_a_memory_is_given_and_nowhere_else() -> None:
    memory = RigMemory()
    dragrig.home(backend="simulated", person=NullOperator())
    assert dragrig.jog(5.0, backend="simulated", memory=memory, person=NullOperator()).position_mm == 5.0
    assert dragrig.jog(5.0, backend="simulated", memory=memory, person=NullOperator()).position_mm == 10.0
    assert dragrig.jog(5.0, backend="simulated", person=NullOperator()).position_mm == 5.0
