"""Traces keep every bit, and say where two of them part."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.traces import first_difference, load_trace, merge_steps, save_trace, trace_hash
from ssad.core.types import EpisodeTrace, array_dtypes

T, A, S = 5, 3, 2
SMALL_HASH = "cca9d38a0c85684b7807bc25da3ced9dd663ef93e79f3a1f4a76fe7a1d871678"


def make_trace(seed: int = 0, steps: int = T) -> EpisodeTrace:
    rng = np.random.default_rng(seed)
    shapes = {"kind": (A,), "length": (A,), "width": (A,), "signal_ids": (S,), "signal": (steps, S), "route": (9, 2)}
    shapes |= dict.fromkeys(("x", "y", "yaw", "speed", "active", "turn_signal"), (steps, A))
    kinds = {"F32": np.float32, "I8": np.int8, "I32": np.int32, "U8": np.uint8, "Bool": np.bool_}
    values = {
        f.name: (rng.random(shapes.get(f.name, (steps,))) * 3).astype(kinds[str(f.type)])
        for f in fields(EpisodeTrace)
        if str(f.type) in kinds
    }
    return EpisodeTrace(
        key="k", town="Town", dt=0.1, names=("ego", "a", "b"), models=("car",) * 3, end="complete", **values
    )


def test_round_trip_to_the_bit(tmp_path: Path) -> None:
    trace = make_trace()
    save_trace(tmp_path / "t.npz", trace)
    loaded = load_trace(tmp_path / "t.npz")
    assert first_difference(trace, loaded) is None
    assert trace_hash(loaded) == trace_hash(trace)
    for field in fields(EpisodeTrace):
        one, two = getattr(trace, field.name), getattr(loaded, field.name)
        assert np.array_equal(one, two), field.name
    before = (tmp_path / "t.npz").read_bytes()
    save_trace(tmp_path / "t.npz", loaded)
    assert (tmp_path / "t.npz").read_bytes() == before


def test_stated_heights_are_stored_and_checked(tmp_path: Path) -> None:
    trace = replace(make_trace(), heights=(1.5, 1.4, 1.8))
    save_trace(tmp_path / "t.npz", trace)
    assert load_trace(tmp_path / "t.npz").heights == (1.5, 1.4, 1.8)
    save_trace(tmp_path / "t.npz", replace(trace, heights=(1.5,)))
    with pytest.raises(FormatError, match="heights of 3 agents"):
        load_trace(tmp_path / "t.npz")


def test_a_trace_without_turn_signals_is_that_of_earlier_versions(tmp_path: Path) -> None:
    trace = replace(make_trace(), turn_signal=np.zeros((0, 0), np.int8))
    save_trace(tmp_path / "t.npz", trace)
    assert "turn_signal" not in safeio.load_npz(tmp_path / "t.npz")
    assert load_trace(tmp_path / "t.npz").turn_signal.shape == (0, 0)
    assert str(first_difference(trace, make_trace())) == "step 0: turn_signal: shape (0, 0) against (5, 3)"


def test_without_signals(tmp_path: Path) -> None:
    trace = replace(make_trace(), signal_ids=np.zeros(0, np.int32), signal=np.zeros((T, 0), np.uint8))
    save_trace(tmp_path / "t.npz", trace)
    assert first_difference(trace, load_trace(tmp_path / "t.npz")) is None


@pytest.mark.parametrize("name", [f.name for f in fields(EpisodeTrace) if f.name not in ("names", "models")])
def test_any_change_shows(name: str) -> None:
    trace = make_trace()
    value = getattr(trace, name)
    if isinstance(value, np.ndarray):
        changed = value.copy()
        changed.reshape(-1).view(np.uint8)[-1] ^= 1
    elif isinstance(value, tuple):
        changed = (1.5,) * A
    else:
        changed = value + 1 if isinstance(value, float) else value + "x"
    other = replace(trace, **{name: changed})
    assert name in str(first_difference(trace, other))
    assert trace_hash(trace) != trace_hash(other)


def test_difference_names_the_first_step() -> None:
    trace = make_trace()
    x, speed = trace.x.copy(), trace.speed.copy()
    x[3, 1] = np.nextafter(x[3, 1], np.float32(9))
    speed[4, 0] += 1
    assert str(first_difference(trace, replace(trace, x=x, speed=speed))).startswith("step 3: x")


def test_other_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    with pytest.raises(FormatError, match="not an episode trace"):
        load_trace(tmp_path / "a.npz")
    save_trace(tmp_path / "t.npz", make_trace())
    data = (tmp_path / "t.npz").read_bytes()
    (tmp_path / "t.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"t\.npz"):
        load_trace(tmp_path / "t.npz")
    save_trace(tmp_path / "t.npz", replace(make_trace(), x=np.zeros((2, 2), np.float32)))
    with pytest.raises(FormatError, match="x has shape"):
        load_trace(tmp_path / "t.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": np.zeros((T, A))}, "not a whole episode trace (x)"),  # float64
        ({"kind": np.zeros(A, np.int32)}, "not a whole episode trace (kind)"),
        ({"active": np.ones((T, A), np.uint8)}, "not a whole episode trace (active)"),
        ({"speed": None}, "not a whole episode trace (speed)"),
        ({"yaw": np.zeros((A, T), np.float32)}, "yaw has shape (3, 5)"),
        ({"active": np.zeros((T, A + 1), bool)}, "active has shape (5, 4)"),
        ({"turn_signal": np.zeros((T, 1), np.int8)}, "turn_signal has shape (5, 1)"),
        ({"meta": np.frombuffer(b'{"format":1}', np.uint8)}, "dt, end, key, models, names, town"),
        ({"meta": np.frombuffer(b'{"format":2}', np.uint8)}, "of another format"),
        ({"meta": np.frombuffer(b"[1]", np.uint8)}, "of another format"),
        ({"meta": np.frombuffer(b"{", np.uint8)}, "not valid JSON"),
    ],
)
def test_a_trace_with_a_wrong_part_is_refused_by_its_name(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """A file of other types would be read as other numbers, and its hash would be another's."""
    save_trace(tmp_path / "t.npz", make_trace())
    arrays = {k: v for k, v in (safeio.load_npz(tmp_path / "t.npz") | changes).items() if v is not None}
    safeio.save_npz(tmp_path / "t.npz", arrays)
    with pytest.raises(FormatError) as caught:
        load_trace(tmp_path / "t.npz")
    assert message in str(caught.value)
    assert "t.npz" in str(caught.value)


def test_what_is_read_cannot_be_changed(tmp_path: Path) -> None:
    save_trace(tmp_path / "t.npz", make_trace())
    loaded = load_trace(tmp_path / "t.npz")
    assert loaded.names == ("ego", "a", "b")
    assert loaded.models == ("car",) * 3
    with pytest.raises(ValueError, match="read-only"):
        loaded.x[0, 0] = 1.0


def test_the_hash_is_the_same_for_ever() -> None:
    """Results on disk hold it."""
    small = {f.name: np.zeros(0) for f in fields(EpisodeTrace)}
    small |= {"key": "k", "town": "Town", "dt": 0.1, "names": ("ego",), "models": ("car",), "end": "complete"}
    small["heights"] = ()
    assert trace_hash(EpisodeTrace(**small)) == SMALL_HASH  # type: ignore[arg-type]


def test_a_difference_is_told_by_name_values_and_step() -> None:
    trace = make_trace()
    assert first_difference(trace, replace(trace, town="Else")) == "town: 'Town' against 'Else'"
    shorter = replace(trace, accel=trace.accel[:-2], x=trace.x + 1)
    assert str(first_difference(trace, shorter)).startswith("step 0: x: ")
    assert first_difference(trace, replace(trace, accel=trace.accel[:-2])) == "step 3: accel: shape (5,) against (3,)"


def test_merged_steps_add_up_events_and_keep_the_last_state() -> None:
    trace = replace(
        make_trace(steps=7),
        dt=0.05,
        contact=np.array([0, 1, 0, 0, 4, 2, 0], np.uint8),
        contact_agent=np.array([-1, 1, -1, -1, 2, 1, -1], np.int32),
        lane_invasion=np.array([0, 1, 1, 0, 0, 0, 1], np.uint8),
        throttle=np.array([0.0, 0.5, 1.0, 0.0, 0.0, 1.0, 0.25], np.float32),
    )
    merged = merge_steps(trace, 2)
    assert merged.dt == 0.1
    for name in ("x", "speed", "active", "driven", "signal"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(trace, name)[[0, 2, 4, 6]])
    assert merged.contact.tolist() == [0, 1, 4, 2]
    assert merged.contact_agent.tolist() == [-1, 1, 2, 1]
    assert merged.lane_invasion.tolist() == [0, 2, 0, 1]
    assert merged.throttle.tolist() == [0.0, 0.75, 0.0, 0.625]
    odd = merge_steps(replace(make_trace(steps=6), dt=0.05), 2)
    assert len(odd.x) == 4, "the last step is a half"
    np.testing.assert_array_equal(odd.x[-1], make_trace(steps=6).x[-1])
    for name in array_dtypes(EpisodeTrace):
        assert getattr(merged, name).dtype == getattr(trace, name).dtype, name
        if getattr(trace, name).ndim and getattr(trace, name).shape[0] == 7:
            assert len(getattr(merged, name)) == 4, name
