"""The official results file of the nuScenes detection task, as columns.

    {"meta": {...}, "results": {SAMPLE_TOKEN: [{"sample_token", "translation", "size", "rotation", "velocity",
     "detection_name", "detection_score", "attribute_name"}, ...]}}

Whatever the devkit's assertions refuse raises a FormatError that names file, sample and box. Source: nuscenes.org,
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
from ssad.datasets.nuscenes.tables import BROKEN
from ssad.metrics.detection_boxes import BoxTable

BLOCK: Final = 4 << 20
MAX_BOXES: Final = 500
_LABEL: Final = {name: i for i, name in enumerate(CLASSES)}
_ATTRIBUTE: Final = {"": -1} | {name: i for i, name in enumerate(ATTRIBUTES)}
# columns of the numbers of a box
_TRANSLATION, _SIZE, _ROTATION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 12)
_SCORE, _POINTS, _WIDTH = 12, 13, 14

Number = float | None  # null stands for NaN, which JSON lacks


class _Box(msgspec.Struct, gc=False):
    """A box of the results file."""

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
    """The results file: the list of each sample is decoded separately."""

    meta: dict[str, Any]
    results: dict[str, msgspec.Raw]


@dataclass(frozen=True)
class DetectionResults:
    """A results file.

    Attributes:
        samples: Tokens [S].
        boxes: Rows in the order of the file; ego_distance is NaN.
        points: LiDAR and radar points in each box [N], -1 where the file does not say; boxes with 0 do not
            count in the devkit.
        meta: The meta of the file.
    """

    samples: tuple[str, ...]
    boxes: BoxTable
    points: I32
    meta: dict[str, Any]


def read_results(
    path: str | Path, samples: Sequence[str] | None = None, *, subset: bool = False, max_boxes: int = MAX_BOXES
) -> DetectionResults:
    """Read a results file. Velocities may be NaN (also written null).

    Args:
        path: The file.
        samples: Tokens that the file must have, no more and no less; `BoxTable.sample` indexes them. None: as
            in the file.
        subset: The file may have more samples, which are ignored, and the rows follow the order of `samples`
            (as in the devkit for a custom split).
        max_boxes: Maximum number of boxes in a sample.

    Raises:
        FormatError: The file is broken, or has other samples.
    """
    content = _decode(path)
    sample_boxes, meta = content.results, content.meta
    sample_tokens = tuple(sample_boxes) if samples is None else tuple(samples)
    sample_index = {token: position for position, token in enumerate(sample_tokens)}
    missing = next((token for token in sample_tokens if token not in sample_boxes), None)
    if missing is not None:
        raise FormatError(
            f"{path}: sample {missing} is missing; every sample of the split needs a list, even an empty one"
        )
    if subset:
        content.results = sample_boxes = {token: sample_boxes[token] for token in sample_tokens}
    unexpected = next((token for token in sample_boxes if token not in sample_index), None)
    if unexpected is not None:
        raise FormatError(f"{path}: sample {unexpected} is not in the split; leave it out or choose its split")
    with pause_garbage_collection():
        boxes, points = _columns(path, sample_boxes, sample_index, max_boxes=max_boxes)
    return DetectionResults(sample_tokens, boxes, points, meta)


def add_ego_distance(boxes: BoxTable, ego: F64) -> BoxTable:
    """Return the boxes with their distance from the ego in the plane.

    Args:
        boxes: The boxes.
        ego: Global position of the ego at each sample [S, 3], m.
    """
    # A results file may hold huge finite coordinates, whose distance overflows to infinity.
    with np.errstate(over="ignore"):
        dx, dy = (boxes.centre[:, :2] - ego[boxes.sample, :2]).T
        return replace(boxes, ego_distance=np.sqrt(dx * dx + dy * dy))


def _columns(
    path: str | Path, boxes_by_sample: dict[str, msgspec.Raw], index: Mapping[str, int], *, max_boxes: int
) -> tuple[BoxTable, I32]:
    """Return boxes and their points, samples numbered by `index`; empties `boxes_by_sample` to free the text."""
    decoder = msgspec.json.Decoder(list[_Box])
    value_blocks: list[F64] = []
    labels: list[npt.NDArray[np.int8]] = []
    attributes: list[npt.NDArray[np.int8]] = []
    counts = np.zeros(len(boxes_by_sample), np.int64)
    for sample_number, (token, encoded) in enumerate(boxes_by_sample.items()):
        try:
            boxes = decoder.decode(encoded)
        except BROKEN as error:
            raise FormatError(f"{path}: sample {token}: {_describe_path(error)}") from None
        counts[sample_number] = len(boxes)
        if len(boxes) > max_boxes:
            raise FormatError(f"{path}: sample {token}: {len(boxes)} boxes, but at most {max_boxes} are allowed")
        if not boxes:
            continue
        value_blocks.append(_numbers(boxes))
        try:
            labels.append(np.array([_LABEL[box.detection_name] for box in boxes], np.int8))
            attributes.append(np.array([_ATTRIBUTE[box.attribute_name] for box in boxes], np.int8))
        except KeyError:
            raise _unknown_sample_error(path, token, boxes) from None
        if any(box.sample_token != token for box in boxes):
            box_number = next(sample_number for sample_number, box in enumerate(boxes) if box.sample_token != token)
            raise FormatError(
                f"{path}: sample {token}: box {box_number}: its sample_token is '{boxes[box_number].sample_token}'"
            )
    sample = np.repeat(np.array([index[token] for token in boxes_by_sample], np.int32), counts)
    boxes_by_sample.clear()
    table = np.concatenate(value_blocks) if value_blocks else np.zeros((0, _WIDTH))
    value_blocks.clear()
    for name, columns in (("translation", _TRANSLATION), ("size", _SIZE), ("rotation", _ROTATION), ("score", [_SCORE])):
        is_nan = np.isnan(table[:, columns]).any(axis=1)
        if is_nan.any():
            table_row = int(is_nan.argmax())
            box_index = table_row - int((sample == sample[table_row]).argmax())
            raise FormatError(f"{path}: sample {list(index)[sample[table_row]]}: box {box_index}: its {name} is NaN")
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
    """Return the numbers [n, _WIDTH] of boxes; null becomes NaN."""
    rows = [
        (*box.translation, *box.size, *box.rotation, *box.velocity, box.detection_score, box.num_pts) for box in boxes
    ]
    packed = _ENCODER.encode(rows)  # three times as fast as np.array(rows)
    offset = len(packed) - len(rows) * _PACKED.itemsize
    if offset < 0:  # a null takes one byte, not nine
        return np.array(rows, np.float64)
    return np.frombuffer(packed, _PACKED, len(rows), offset)["values"]["value"].astype(np.float64)


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    """Pause garbage collection: many small objects without cycles would trigger it again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _decode(path: str | Path) -> _File:
    text = _read(path)
    try:
        return msgspec.json.decode(text, type=_File)
    except msgspec.ValidationError as error:
        raise FormatError(f"{path}: not a results file: {error}") from None
    except BROKEN as error:
        hint = " (Infinity is not a number that JSON has)" if b"Infinity" in text else ""
        raise FormatError(f"{path}: not valid JSON: {error}{hint}") from None


def _read(path: str | Path) -> bytes | bytearray:
    """Return the text of the file with NaN outside of strings replaced by null."""
    try:
        with open(path, "rb") as stream:
            text = stream.read()
            if b"NaN" not in text:
                return text
            del text  # a file can be large: hold its text only once
            stream.seek(0)
            return _replace_nan(stream)
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


def _replace_nan(file: BinaryIO) -> bytearray:
    """The text block by block; a NaN is inside of a string where an odd number of quotation marks goes before."""
    output = bytearray()
    counted_bytes, quotes = 0, 0  # quotation marks among the first `counted` bytes of out
    remainder = b""
    while True:
        chunk = file.read(BLOCK)
        block = remainder + chunk
        block_end = block.rfind(b",") + 1 if chunk else len(block)  # no comma is inside NaN
        block, remainder = block[:block_end], block[block_end:]
        head, *tails = block.split(b"NaN")
        output += head
        for tail in tails:
            quotes += _count_quotes(output[counted_bytes:])
            counted_bytes = len(output)
            output += (b"null" if quotes % 2 == 0 else b"NaN") + tail
        if not chunk:
            return output


def _count_quotes(text: bytearray) -> int:
    """Return the number of quotation marks that begin or end a string."""
    return (re.sub(rb"\\.", b"", text, flags=re.DOTALL) if b"\\" in text else text).count(b'"')


def _describe_path(error: Exception) -> str:
    """Return the message of a msgspec error with its path `$[3].size` in words."""
    message = str(error)
    location = re.search(r" - at `\$(?:\[(\d+|\.\.\.)\])?\.?(.*?)`$", message)
    if location is None:
        return message
    prefix = "".join(f"{step}: " for step in (f"box {location[1]}" if location[1] else "", location[2]) if step)
    return prefix + message[: location.start()]


def _unknown_sample_error(path: str | Path, token: str, boxes: Sequence[_Box]) -> FormatError:
    for number, box in enumerate(boxes):
        if box.detection_name not in _LABEL:
            problem = f"unknown detection_name '{box.detection_name}'; known: {', '.join(CLASSES)}"
            return FormatError(f"{path}: sample {token}: box {number}: {problem}")
        if box.attribute_name not in _ATTRIBUTE:
            problem = f"unknown attribute_name '{box.attribute_name}'; known: {', '.join(ATTRIBUTES)} or empty"
            return FormatError(f"{path}: sample {token}: box {number}: {problem}")
    raise AssertionError
