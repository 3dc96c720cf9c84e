"""Episode traces on disk: one npz an episode, no pickle, atomic, the same bytes for the same trace."""

from __future__ import annotations

import hashlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.types import EpisodeTrace, array_dtypes

FORMAT = 1
_ARRAYS = array_dtypes(EpisodeTrace)
_META = [f.name for f in fields(EpisodeTrace) if f.name not in _ARRAYS]
_PER_STEP = (
    *("x", "y", "yaw", "speed", "active", "accel", "contact", "contact_agent", "off_road", "route_distance"),
    *("route_complete", "driven", "lane_invasion", "red_light", "stop_sign", "throttle", "brake", "steer", "signal"),
)
_PER_AGENT = ("x", "y", "yaw", "speed", "active")


def _meta(trace: EpisodeTrace) -> dict[str, Any]:
    meta: dict[str, Any] = {name: getattr(trace, name) for name in _META}
    # Absent where models say it all, so that the hash of such a trace is that of earlier versions.
    heights = {"heights": list(trace.heights)} if trace.heights else {}
    del meta["heights"]
    return meta | {"names": list(trace.names), "models": list(trace.models), "dt": float(trace.dt)} | heights


def _arrays(trace: EpisodeTrace) -> dict[str, npt.NDArray[Any]]:
    arrays = {name: np.ascontiguousarray(getattr(trace, name), dtype) for name, dtype in _ARRAYS.items()}
    if not arrays["turn_signal"].size:
        del arrays["turn_signal"]  # likewise: the hash of such a trace is that of earlier versions
    return arrays


def merge_steps(trace: EpisodeTrace, count: int) -> EpisodeTrace:
    """Return a trace with `count` steps merged into one; the last one may hold fewer.

    States are those at the end of the merged steps; events are added up; controls and the acceleration are means.

    Args:
        trace: The trace.
        count: Steps that make one; 1 leaves the trace as it is.
    """
    if count == 1:
        return trace
    row_count = len(trace.x)
    ends = np.unique([0, *range(count, row_count, count), row_count - 1])
    starts = np.concatenate([[0], ends[:-1] + 1])
    merged: dict[str, Any] = {name: getattr(trace, name)[ends] for name in _PER_STEP}
    if trace.turn_signal.size:
        merged["turn_signal"] = trace.turn_signal[ends]
    for name in ("lane_invasion", "red_light", "stop_sign"):
        merged[name] = np.add.reduceat(getattr(trace, name), starts).astype(getattr(trace, name).dtype)
    merged["contact"] = np.bitwise_or.reduceat(trace.contact, starts)
    for name in ("accel", "throttle", "brake", "steer"):
        values = getattr(trace, name)
        sums = np.add.reduceat(values.astype(np.float64), starts)
        merged[name] = (sums / (ends - starts + 1)).astype(values.dtype)
    for row, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        touched = trace.contact_agent[start : end + 1]
        merged["contact_agent"][row] = touched[np.argmax(touched != -1)]
    return replace(trace, dt=trace.dt * count, **merged)


def save_trace(path: str | Path, trace: EpisodeTrace) -> None:
    """Write a trace, compressed and atomically.

    Raises:
        StoreError: The file cannot be written.
    """
    meta = safeio.dump_json(_meta(trace) | {"format": FORMAT})
    safeio.save_npz(path, {"meta": np.frombuffer(meta.encode(), np.uint8), **_arrays(trace)})


def load_trace(path: str | Path) -> EpisodeTrace:
    """Read a trace; its arrays are read-only.

    Raises:
        FormatError: The file is broken or of another kind.
    """
    stored = safeio.load_npz(path)
    if "meta" not in stored:
        raise FormatError(f"{path}: not an episode trace")
    meta = safeio.parse_json(stored.pop("meta").tobytes(), str(path))
    if not isinstance(meta, dict) or meta.pop("format", None) != FORMAT:
        raise FormatError(f"{path}: an episode trace of another format; run the suite again into a new folder")
    meta.setdefault("heights", ())
    stored.setdefault("turn_signal", np.zeros((0, 0), np.int8))
    missing = (set(_META) - set(meta)) | (set(_ARRAYS) - set(stored))
    mistyped = [name for name, dtype in _ARRAYS.items() if name in stored and stored[name].dtype != dtype]
    if missing or mistyped:
        raise FormatError(f"{path}: not a whole episode trace ({', '.join(sorted(missing) or mistyped)})")
    steps, agents = len(stored["accel"]), len(stored["kind"])
    for name in _PER_AGENT:
        if stored[name].shape != (steps, agents):
            raise FormatError(f"{path}: not a whole episode trace ({name} has shape {stored[name].shape})")
    if stored["turn_signal"].shape not in ((0, 0), (steps, agents)):
        raise FormatError(f"{path}: not a whole episode trace (turn_signal has shape {stored['turn_signal'].shape})")
    heights = meta["heights"]
    if not isinstance(heights, list | tuple) or (
        heights and (len(heights) != agents or not all(isinstance(value, float) and value > 0.0 for value in heights))
    ):
        raise FormatError(f"{path}: not a whole episode trace (heights of {agents} agents are not {heights!r})")
    meta["names"], meta["models"], meta["heights"] = (tuple(meta[name]) for name in ("names", "models", "heights"))
    trace_fields: dict[str, Any] = {name: meta[name] for name in _META} | {name: stored[name] for name in _ARRAYS}
    return EpisodeTrace(**trace_fields)


def trace_hash(trace: EpisodeTrace) -> str:
    """Return 64 hex digits over every bit of the trace (names, shapes and values), independent of the compression."""
    hasher = hashlib.sha256(safeio.dump_json(_meta(trace)).encode())
    for name, array in _arrays(trace).items():
        hasher.update(f"{name}{array.dtype.str}{array.shape}".encode())
        hasher.update(array.tobytes())
    return hasher.hexdigest()


def motion_hash(trace: EpisodeTrace) -> str:
    """Return 32 hex digits over the motion of all agents, equal in copies of one case under any name."""
    hasher = hashlib.sha256(safeio.dump_json([trace.town, trace.dt, *trace.models]).encode())
    for name in _PER_AGENT:
        hasher.update(np.ascontiguousarray(getattr(trace, name), _ARRAYS[name]).tobytes())
    return hasher.hexdigest()[:32]


def first_difference(first: EpisodeTrace, second: EpisodeTrace) -> str | None:
    """None when equal to the bit, else one line: which array differs first, at which step."""
    for name in _META:
        if _meta(first).get(name) != _meta(second).get(name):
            return f"{name}: {_meta(first).get(name)!r} against {_meta(second).get(name)!r}"
    left_arrays, right_arrays = (
        {name: np.ascontiguousarray(getattr(trace, name), dtype) for name, dtype in _ARRAYS.items()}
        for trace in (first, second)
    )
    differences: list[tuple[int, str]] = []
    for name in _ARRAYS:
        left_array, right_array = left_arrays[name], right_arrays[name]
        if left_array.shape != right_array.shape:
            differences.append(
                (
                    min(len(left_array), len(right_array)),
                    f"{name}: shape {left_array.shape} against {right_array.shape}",
                )
            )
            continue
        # Bytes, since NaN is unequal to itself and 0.0 equals -0.0.
        if left_array.tobytes() != right_array.tobytes():
            first_step = next(
                row for row in range(len(left_array)) if left_array[row].tobytes() != right_array[row].tobytes()
            )
            differences.append((first_step, f"{name}: {left_array[first_step]} against {right_array[first_step]}"))
    if not differences:
        return None
    first_step, description = min(differences)
    return " ".join(f"step {first_step}: {description}".split())
