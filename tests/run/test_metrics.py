"""Metrics: what is written is read back exactly; TensorBoard holds every iteration once; the curve is drawn."""

import math
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from tensorboardX.proto.event_pb2 import Event

from metrpo.run import curve
from metrpo.run.curve import draw_curve
from metrpo.run.metrics import Events, plain, read_metrics, to_csv, without_clocks

cells = st.none() | st.integers(-(2**63), 2**63) | st.floats()


@given(st.lists(st.tuples(cells, cells), min_size=1, max_size=5))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_rows_come_back_exactly(tmp_path, values):
    rows = [{"a": a, "b,\n": b} for a, b in values]
    (tmp_path / "metrics.csv").write_bytes(to_csv(rows).encode())
    back = read_metrics(tmp_path / "metrics.csv")
    assert repr(read_metrics(tmp_path)) == repr(back), "a run directory will do"
    assert [[repr(v) for v in row.values()] for row in back] == [[repr(v) for v in row.values()] for row in rows]
    assert list(back[0]) == ["a", "b,\n"]


def test_the_text_is_what_other_programs_read():
    rows = [{"iteration": 1, "loss": 0.1, "gap": float("nan"), "wall_seconds": None}]
    assert to_csv(rows) == "iteration,loss,gap,wall_seconds\n1,0.1,nan,\n"
    assert to_csv([]) == ""


def test_array_scalars_become_plain_numbers():
    row = plain({"a": np.int64(3), "b": np.float64(0.1), "c": jnp.float32(0.5), "d": np.bool_(True), "e": None, "f": 2})
    assert row == {"a": 3, "b": 0.1, "c": 0.5, "d": 1, "e": None, "f": 2}
    assert [type(v) for v in row.values()] == [int, float, float, int, type(None), int]


def test_only_clocks_are_left_out():
    row = {"iteration": 1, "seconds_fit": 0.5, "wall_seconds": 3.0, "second_best": 1.0}
    assert without_clocks(row) == {"iteration": 1, "seconds_fit": None, "wall_seconds": None, "second_best": 1.0}


def test_other_columns_are_an_error():
    with pytest.raises(ValueError, match=r"expected the columns \['a'\], got \['b'\]"):
        to_csv([{"a": 1}, {"b": 1}])


def scalars(directory):
    """(tag, step, value) of every event, read as the records that TensorBoard reads."""
    found = []
    for path in directory.glob("events.out.tfevents.*"):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + length])
            found += [(v.tag, event.step, v.simple_value) for v in event.summary.value]
            data = data[16 + length :]
    return sorted(found)


def test_events_hold_every_iteration_once_after_a_resume(tmp_path):
    rows = [{"iteration": i, "real_steps": 100 * i, "gap": math.nan if i == 1 else 0.5 * i} for i in (1, 2, 3)]
    first = Events(tmp_path, rows[:1])
    first.add(rows[1])
    (written,) = tmp_path.iterdir()
    written.rename(tmp_path / "events.out.tfevents.1.elsewhere")  # the name holds the second in which it was written
    second = Events(tmp_path, rows[:2])
    second.add(rows[2])
    expected = [("gap", 200, 1.0), ("gap", 300, 1.5)]
    expected += [(name, 100 * i, row[name]) for i, row in enumerate(rows, 1) for name in ("iteration", "real_steps")]
    assert scalars(tmp_path) == sorted(expected)


CURVE = {"return_real": 1.0, "return_real_std": 0.1, "return_collected": 0.5, "return_imagined": 1e9, "gap": 1e9}


@pytest.mark.parametrize(
    "rows",
    [
        [CURVE | {"real_steps": 100 * i, "return_real": i, "fraction_improved": 0.5} for i in range(1, 4)],
        [CURVE | {"real_steps": 100}],
        [dict.fromkeys(CURVE, math.nan) | {"real_steps": 100}],
        [{"real_steps": 100, "return_real": None}],
    ],
)
def test_a_curve_is_drawn_whatever_the_numbers(tmp_path, rows):
    draw_curve(rows, tmp_path / "curve.png", "Swimmer")
    with Image.open(tmp_path / "curve.png") as picture:
        assert picture.size == (1350, 1050)
        assert len(set(picture.convert("L").tobytes())) > 10
    assert [p.name for p in tmp_path.iterdir()] == ["curve.png"]


def test_imagined_points_stay_on_the_axis_without_evaluations(monkeypatch, tmp_path):
    limits, drawn = [], curve._draw_returns
    monkeypatch.setattr(
        curve, "_draw_returns", lambda axes, *rest: (drawn(axes, *rest), limits.append(axes.get_ylim()))
    )
    row = CURVE | {"return_real": math.nan, "return_real_std": math.nan, "return_imagined": 900.0, "real_steps": 100}
    for r in (row, row | {"return_real": 1.0, "return_real_std": 0.1}):
        draw_curve([r], tmp_path / "curve.png", "Swimmer", {"doing nothing": 0.0, "random actions": -1.0})
    (low, high), (_, beside_real) = limits
    assert low < -1
    assert high > 900
    assert beside_real < 900, "a real curve is not flattened"
