"""The official results file of the nuScenes detection task, into columns.

    {"meta": {...}, "results": {SAMPLE_TOKEN: [{"sample_token", "translation", "size", "rotation", "velocity",
     "detection_name", "detection_score", "attribute_name"}, ...]}}

What the devkit's assertions refuse ends in a FormatError that names file, sample and box. Source: nuscenes.org,
detection task; nuscenes-devkit 1.2.0, eval/common/loaders.py, eval/detection/data_classes.py (`DetectionBox`).
"""

from __future__ import annotations

import gc
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
import numpy as np
import numpy.typing as npt

from ssad.core.boxes import size_columns
from ssad.core.errors import FormatError
from ssad.core.nuscenes_names import ATTRIBUTES, CLASSES
from ssad.core.types import F64, I32
from ssad.metrics.detection_boxes import BoxTable

BLOCK: Final = 4 << 20
MAX_BOXES: Final = 500
_LABEL: Final = {name: i for i, name in enumerate(CLASSES)}
_ATTRIBUTE: Final = {"": -1} | {name: i for i, name in enumerate(ATTRIBUTES)}
# columns of the numbers of a box
_TRANSLATION, _SIZE, _ROTATION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 12)
_SCORE, _POINTS, _WIDTH = 12, 13, 14

Number = float | None  # null stands for NaN, which JSON does not have


class _Box(msgspec.Struct, gc=False):
    """A box of the file."""

    sample_token: str
    translation: tuple[Number, Number, Number]
    size: tuple[Number, Number, Number]
    rotation: tuple[Number, Number, Number, Number]
    velocity: tuple[Number, Number]
    detection_name: str
    attribute_name: str
    detection_score: Number = -1.0
    num_pts: float = -1.0


# a row of floats in MessagePack: a byte for the list, and a byte before each number
_PACKED: Final = np.dtype([("list", "u1"), ("values", [("kind", "u1"), ("value", ">f8")], _WIDTH)])
_ENCODER: Final = msgspec.msgpack.Encoder()


class _File(msgspec.Struct):
    """The file: each sample's list is decoded on its own."""

    meta: dict[str, Any]
    results: dict[str, msgspec.Raw]


@dataclass(frozen=True)
class Results:
    """A results file.

    Attributes:
        samples: Tokens [S].
        boxes: Rows in the order of the file; ego_distance is NaN.
        points: LiDAR and radar points in each box [N], -1 where the file does not say; boxes with 0 do not count in the
            devkit.
        meta: The meta of the file.
    """

    samples: tuple[str, ...]
    boxes: BoxTable
    points: I32
    meta: dict[str, Any]


def read_results(
    path: str | Path, samples: Sequence[str] | None = None, *, subset: bool = False, max_boxes: int = MAX_BOXES
) -> Results:
    """Read a results file. Velocities may be NaN (also written null).

    Args:
        path: The file.
        samples: Tokens that it must have, no more and no less; `BoxTable.sample` indexes them. None: as the file has
            them.
        subset: The file may have more samples, which are ignored, and the rows follow the order of `samples` (as in the
            devkit for a custom split).
        max_boxes: Maximum number of boxes in a sample.

    Raises:
        FormatError: The file is broken, or has other samples.
    """
    file = _decode(path)
    found, meta = file.results, file.meta
    names = tuple(found) if samples is None else tuple(samples)
    index = {token: i for i, token in enumerate(names)}
    missing = next((token for token in names if token not in found), None)
    if missing is not None:
        raise FormatError(
            f"{path}: sample {missing} is missing; every sample of the split needs a list, even an empty one"
        )
    if subset:
        file.results = found = {token: found[token] for token in names}
    foreign = next((token for token in found if token not in index), None)
    if foreign is not None:
        raise FormatError(f"{path}: sample {foreign} is not in the split; leave it out or choose its split")
    with uncollected():
        boxes, points = _columns(path, found, index, max_boxes=max_boxes)
    return Results(names, boxes, points, meta)


def with_ego(boxes: BoxTable, ego: F64) -> BoxTable:
    """The boxes with their distance from the ego in the plane.

    Args:
        boxes: The boxes.
        ego: Global position of the ego at each sample [S, 3], m.
    """
    with np.errstate(over="ignore"):
        dx, dy = (boxes.centre[:, :2] - ego[boxes.sample, :2]).T
        return replace(boxes, ego_distance=np.sqrt(dx * dx + dy * dy))


def _columns(
    path: str | Path, found: dict[str, msgspec.Raw], index: Mapping[str, int], *, max_boxes: int
) -> tuple[BoxTable, I32]:
    """Boxes and their points; `index` gives the number of each sample; `found` is emptied to free the text."""
    decoder = msgspec.json.Decoder(list[_Box])
    numbers: list[F64] = []
    labels: list[npt.NDArray[np.int8]] = []
    attributes: list[npt.NDArray[np.int8]] = []
    counts = np.zeros(len(found), np.int64)
    for i, (token, raw) in enumerate(found.items()):
        try:
            boxes = decoder.decode(raw)
        except msgspec.MsgspecError as error:
            raise FormatError(f"{path}: sample {token}: {_place(error)}") from None
        counts[i] = len(boxes)
        if len(boxes) > max_boxes:
            raise FormatError(f"{path}: sample {token}: {len(boxes)} boxes, but at most {max_boxes} are allowed")
        if not boxes:
            continue
        numbers.append(_numbers(boxes))
        try:
            labels.append(np.array([_LABEL[b.detection_name] for b in boxes], np.int8))
            attributes.append(np.array([_ATTRIBUTE[b.attribute_name] for b in boxes], np.int8))
        except KeyError:
            raise _unknown(path, token, boxes) from None
        if any(b.sample_token != token for b in boxes):
            wrong = next(i for i, b in enumerate(boxes) if b.sample_token != token)
            raise FormatError(f"{path}: sample {token}: box {wrong}: its sample_token is '{boxes[wrong].sample_token}'")
    sample = np.repeat(np.array([index[token] for token in found], np.int32), counts)
    found.clear()
    table = np.concatenate(numbers) if numbers else np.zeros((0, _WIDTH))
    numbers.clear()
    for name, columns in (("translation", _TRANSLATION), ("size", _SIZE), ("rotation", _ROTATION), ("score", [_SCORE])):
        bad = np.isnan(table[:, columns]).any(axis=1)
        if bad.any():
            row = int(bad.argmax())
            place = row - int((sample == sample[row]).argmax())
            raise FormatError(f"{path}: sample {list(index)[sample[row]]}: box {place}: its {name} is NaN")
    result = BoxTable(
        sample=sample,
        label=np.concatenate(labels) if labels else np.zeros(0, np.int8),
        centre=table[:, _TRANSLATION],
        size_lwh=table[:, _SIZE][:, size_columns("wlh", "lwh")],
        rotation=table[:, _ROTATION],
        velocity=table[:, _VELOCITY],
        attribute=np.concatenate(attributes) if attributes else np.zeros(0, np.int8),
        score=np.ascontiguousarray(table[:, _SCORE]),
        ego_distance=np.full(len(table), np.nan),
    )
    return result, np.clip(table[:, _POINTS], -1, 2**31 - 1).astype(np.int32)


def _numbers(boxes: Sequence[_Box]) -> F64:
    """The numbers [n, _WIDTH] of boxes; null becomes NaN."""
    rows = [(*b.translation, *b.size, *b.rotation, *b.velocity, b.detection_score, b.num_pts) for b in boxes]
    packed = _ENCODER.encode(rows)  # three times as fast as np.array(rows)
    offset = len(packed) - len(rows) * _PACKED.itemsize
    if offset < 0:  # there are nulls, which take one byte
        return np.array(rows, np.float64)
    return np.frombuffer(packed, _PACKED, len(rows), offset)["values"]["value"].astype(np.float64)


@contextmanager
def uncollected() -> Iterator[None]:
    """No cycle collection meanwhile: many small objects without cycles would set it off again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _decode(path: str | Path) -> _File:
    data = _read(path)
    try:
        return msgspec.json.decode(data, type=_File)
    except msgspec.ValidationError as error:
        raise FormatError(f"{path}: not a results file: {error}") from None
    except msgspec.MsgspecError as error:
        hint = " (Infinity is not a number that JSON has)" if b"Infinity" in data else ""
        raise FormatError(f"{path}: not valid JSON: {error}{hint}") from None


def _read(path: str | Path) -> bytes | bytearray:
    """The file's text with NaN outside of strings replaced by null."""
    try:
        with open(path, "rb") as file:
            data = file.read()
            if b"NaN" not in data:
                return data
            del data  # the text is held only once
            file.seek(0)
            return _without_nan(file)
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


def _without_nan(file: BinaryIO) -> bytearray:
    """The text block by block; a NaN is inside of a string where an odd number of quotation marks goes before."""
    out = bytearray()
    counted, quotes = 0, 0  # quotation marks among the first `counted` bytes of out
    rest = b""
    while True:
        data = file.read(BLOCK)
        block = rest + data
        cut = block.rfind(b",") + 1 if data else len(block)  # no comma is inside NaN
        block, rest = block[:cut], block[cut:]
        first, *pieces = block.split(b"NaN")
        out += first
        for piece in pieces:
            quotes += _quotes(out[counted:])
            counted = len(out)
            out += (b"null" if quotes % 2 == 0 else b"NaN") + piece
        if not data:
            return out


def _quotes(text: bytearray) -> int:
    """Number of quotation marks that begin or end a string."""
    return (re.sub(rb"\\.", b"", text, flags=re.DOTALL) if b"\\" in text else text).count(b'"')


def _place(error: msgspec.MsgspecError) -> str:
    """The message of a msgspec error, with its path `$[3].size` in words."""
    text = str(error)
    found = re.search(r" - at `\$(?:\[(\d+|\.\.\.)\])?\.?(.*?)`$", text)
    if found is None:
        return text
    where = "".join(f"{part}: " for part in (f"box {found[1]}" if found[1] else "", found[2]) if part)
    return where + text[: found.start()]


def _unknown(path: str | Path, token: str, boxes: Sequence[_Box]) -> FormatError:
    for i, box in enumerate(boxes):
        if box.detection_name not in _LABEL:
            what = f"unknown detection_name '{box.detection_name}'; known: {', '.join(CLASSES)}"
            return FormatError(f"{path}: sample {token}: box {i}: {what}")
        if box.attribute_name not in _ATTRIBUTE:
            what = f"unknown attribute_name '{box.attribute_name}'; known: {', '.join(ATTRIBUTES)} or empty"
            return FormatError(f"{path}: sample {token}: box {i}: {what}")
    raise AssertionError
