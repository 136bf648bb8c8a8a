"""Hysteresis of the plant that examines a diagnosis."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dragrig.sim_backend.blind.effects.hidden_effect import dahl_operator, play_operator

LOADS = st.lists(st.floats(-100, 100, allow_subnormal=False).map(lambda load: round(load, 3)), min_size=2, max_size=40)


@given(LOADS, st.floats(0.5, 50))
def test_a_play_follows_within_its_half_width_and_no_faster_than_its_input(loads: list[float], half: float) -> None:
    values = np.array(loads)
    # A play that starts in the middle of its gap stays where it is until the gap is taken up.
    out, last = [], values[0]
    for value in values.tolist():
        last = min(max(last, value - half), value + half)
        out.append(last)
    assert np.allclose(play_operator(values, half), out)


@given(LOADS, st.floats(0.5, 50))
def test_dahls_state_is_that_of_its_equation_step_by_step(loads: list[float], width: float) -> None:
    values = np.array(loads)
    state, wanted = 0.0, [0.0]
    for step in np.diff(values).tolist():
        way = np.sign(step)
        state = float(way - (way - state) * np.exp(-abs(step) / width)) if step else state
        wanted.append(state)
    assert np.allclose(dahl_operator(values, width), wanted)


@given(LOADS, st.floats(0.5, 50), st.integers(2, 5))
def test_hysteresis_does_not_depend_on_how_fast_the_input_goes(loads: list[float], width: float, finer: int) -> None:
    values = np.array(loads)
    at = np.arange(values.size)
    interp = np.interp(np.arange((values.size - 1) * finer + 1) / finer, at, values)
    for hysteron in (play_operator, dahl_operator):
        assert np.allclose(hysteron(interp, width)[::finer], hysteron(values, width), atol=1e-9)
