"""Episode traces on disk: one npz an episode, no pickle, atomic, the same bytes for the same trace."""

from __future__ import annotations

import hashlib
from dataclasses import fields
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
_PER_AGENT = ("x", "y", "yaw", "speed", "active")


def _meta(trace: EpisodeTrace) -> dict[str, Any]:
    meta: dict[str, Any] = {name: getattr(trace, name) for name in _META}
    return meta | {"names": list(trace.names), "models": list(trace.models), "dt": float(trace.dt)}


def _arrays(trace: EpisodeTrace) -> dict[str, npt.NDArray[Any]]:
    return {name: np.ascontiguousarray(getattr(trace, name), dtype) for name, dtype in _ARRAYS.items()}


def save_trace(path: str | Path, trace: EpisodeTrace) -> None:
    """Write a trace, compressed and atomically.

    Raises:
        StoreError: The file cannot be written.
    """
    meta = safeio.dump_json(_meta(trace) | {"format": FORMAT})
    safeio.save_npz(path, {"meta": np.frombuffer(meta.encode(), np.uint8), **_arrays(trace)})


def load_trace(path: str | Path) -> EpisodeTrace:
    """Read a trace; its arrays are read-only. FormatError when the file is broken or of another kind."""
    data = safeio.load_npz(path)
    if "meta" not in data:
        raise FormatError(f"{path}: not an episode trace")
    meta = safeio.parse_json(data.pop("meta").tobytes(), str(path))
    if not isinstance(meta, dict) or meta.pop("format", None) != FORMAT:
        raise FormatError(f"{path}: an episode trace of another format; run the suite again into a new folder")
    missing = (set(_META) - set(meta)) | (set(_ARRAYS) - set(data))
    wrong = [name for name, dtype in _ARRAYS.items() if name in data and data[name].dtype != dtype]
    if missing or wrong:
        raise FormatError(f"{path}: not a whole episode trace ({', '.join(sorted(missing) or wrong)})")
    steps, agents = len(data["accel"]), len(data["kind"])
    for name in _PER_AGENT:
        if data[name].shape != (steps, agents):
            raise FormatError(f"{path}: not a whole episode trace ({name} has shape {data[name].shape})")
    meta["names"], meta["models"] = tuple(meta["names"]), tuple(meta["models"])
    values: dict[str, Any] = {name: meta[name] for name in _META} | {name: data[name] for name in _ARRAYS}
    return EpisodeTrace(**values)


def trace_hash(trace: EpisodeTrace) -> str:
    """64 hex digits over every bit of the trace (names, shapes and values), whatever the compression."""
    total = hashlib.sha256(safeio.dump_json(_meta(trace)).encode())
    for name, array in _arrays(trace).items():
        total.update(f"{name}{array.dtype.str}{array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def motion_hash(trace: EpisodeTrace) -> str:
    """32 hex digits over how everybody moved, whatever the episode is called: equal in copies of one case."""
    total = hashlib.sha256(safeio.dump_json([trace.town, trace.dt, *trace.models]).encode())
    for name in _PER_AGENT:
        total.update(np.ascontiguousarray(getattr(trace, name), _ARRAYS[name]).tobytes())
    return total.hexdigest()[:32]


def first_difference(a: EpisodeTrace, b: EpisodeTrace) -> str | None:
    """None when equal to the bit, else one line: which array differs first, at which step."""
    for name in _META:
        if _meta(a)[name] != _meta(b)[name]:
            return f"{name}: {_meta(a)[name]!r} against {_meta(b)[name]!r}"
    left, right = _arrays(a), _arrays(b)
    found: list[tuple[int, str]] = []
    for name in _ARRAYS:
        x, y = left[name], right[name]
        if x.shape != y.shape:
            found.append((min(len(x), len(y)), f"{name}: shape {x.shape} against {y.shape}"))
            continue
        if x.tobytes() != y.tobytes():
            step = next(i for i in range(len(x)) if x[i].tobytes() != y[i].tobytes())
            found.append((step, f"{name}: {x[step]} against {y[step]}"))
    if not found:
        return None
    step, text = min(found)
    return " ".join(f"step {step}: {text}".split())
