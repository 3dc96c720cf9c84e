"""LiDAR point clouds in files: nuScenes' and KITTI's .bin, PCD and PLY, read with checks and written in their format.

Points are float32 [N, 5]: x, y, z in metres in the sensor's frame, intensity from 0 to 255, ring.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ssad.core.errors import FormatError
from ssad.core.safeio import read_bytes
from ssad.core.types import F32

MAX_BYTES: Final = 1 << 28  # of a file, and of what it unpacks to
NUSCENES_COLUMNS, KITTI_COLUMNS = 5, 4
_MAX_HEADER: Final = 1 << 14  # bytes
_INTENSITY: Final = ("intensity", "i", "reflectance", "reflectivity", "remission", "scalar_intensity")
_RING: Final = ("ring", "channel", "laser_id", "laserid", "scalar_ring")
_PLY_TYPES: Final = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_PLY_NAMES: Final = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


@dataclass(frozen=True, slots=True)
class PointFile:
    """The content of a point file.

    Attributes:
        points: float32 [N, 5]; a column that the file lacks is 0.
        format: "bin", "pcd" or "ply".
        text: Whether the numbers are written as text.
        columns: Names and types of the columns that `points` holds, as in the file.
        intensity_scale: Intensity of `points` divided by that of the file.
        dropped_fields: Fields of the file that `points` does not hold.
        dropped_points: Number of points without a place (NaN), which PCD stores for beams that do not return.
        viewpoint: The line VIEWPOINT of a PCD.
    """

    points: F32
    format: str
    text: bool
    columns: tuple[tuple[str, np.dtype[Any]], ...]
    intensity_scale: float = 1.0
    dropped_fields: tuple[str, ...] = ()
    dropped_points: int = 0
    viewpoint: str = "0 0 0 1 0 0 0"


def read_points(path: str | Path, *, columns: int = NUSCENES_COLUMNS) -> F32:
    """Read the points [N, 5] of a file; see `read_point_file`."""
    return read_point_file(path, columns=columns).points


def read_point_file(path: str | Path, *, columns: int = NUSCENES_COLUMNS) -> PointFile:
    """Read a point file. PCD and PLY are told by their first bytes; all else is rows of float32.

    Args:
        path: The file.
        columns: Numbers of a point in a .bin file: 5 in nuScenes, 4 in KITTI, whose intensities are 0 to 1.

    Raises:
        FormatError: The file is missing, truncated, too large or broken, or holds values that are not finite.
    """
    content = read_bytes(path, limit=MAX_BYTES)
    name = str(path)
    if content[:4] in (b"ply\n", b"ply\r"):
        return _read_ply(content, name)
    if content.startswith((b"# .PCD", b"VERSION", b"#")) and b"\nDATA " in content[:_MAX_HEADER]:
        return _read_pcd(content, name)
    if name.lower().endswith((".pcd", ".ply")):
        raise FormatError(f"{name}: no header of a {name[-3:].upper()} file")
    return _read_rows(content, name, columns)


def _read_rows(content: bytes, name: str, columns: int) -> PointFile:
    point_bytes = 4 * columns
    if len(content) % point_bytes:
        raise FormatError(f"{name}: {len(content)} bytes are no whole number of {point_bytes}-byte points (cut short?)")
    rows = np.frombuffer(content, "<f4").reshape(-1, columns).astype(np.float32)
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise FormatError(f"{name}: point {int(np.argmin(finite))} is not finite")
    field_names = ("x", "y", "z", "intensity", "ring")[:columns]
    points = np.zeros((len(rows), 5), np.float32)
    scale = 255.0 if columns == KITTI_COLUMNS else 1.0
    points[:, :columns] = rows
    points[:, 3] *= np.float32(scale)
    return PointFile(points, "bin", False, tuple((field, np.dtype("<f4")) for field in field_names), scale)


def _header_lines(content: bytes, name: str, end: bytes) -> tuple[list[list[str]], int]:
    """Return the words of the header's lines up to the one that begins with `end`, and the offset behind it."""
    lines, position = [], 0
    while True:
        line_end = content.find(b"\n", position, _MAX_HEADER)
        if line_end < 0:
            raise FormatError(f"{name}: its header does not end ({end.decode()} is missing)")
        try:
            words = content[position:line_end].decode("ascii").split()
        except UnicodeDecodeError:
            words = ["#"]  # comments may hold anything
        position = line_end + 1
        if words and not words[0].startswith("#"):
            lines.append(words)
            if words[0].encode() == end:
                return lines, position


def _whole_number(text: str, name: str, label: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 12:
        raise FormatError(f"{name}: {label}: '{text[:20]}' is no whole number")
    return int(text)


def _read_pcd(content: bytes, name: str) -> PointFile:
    """Read a PCD of version 0.6 or 0.7: ascii, binary or binary_compressed.

    Source: the description of the format, https://pointclouds.org/documentation/tutorials/pcd_file_format.html
    """
    lines, offset = _header_lines(content, name, b"DATA")
    header = {line[0].upper(): line[1:] for line in lines}
    for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT"):
        if not header.get(key):
            raise FormatError(f"{name}: its header has no line {key}")
    fields = header["FIELDS"]
    counts = [_whole_number(word, name, "COUNT") for word in header.get("COUNT", ["1"] * len(fields))]
    if not len(fields) == len(header["SIZE"]) == len(header["TYPE"]) == len(counts):
        raise FormatError(f"{name}: FIELDS, SIZE, TYPE and COUNT are of different lengths")
    types = []
    for field, size, kind in zip(fields, header["SIZE"], header["TYPE"], strict=True):
        code = f"{kind.lower()}{size}"
        if code not in _PLY_NAMES and code not in ("i8", "u8"):
            raise FormatError(f"{name}: field {field}: type {kind} of {size} bytes is not known")
        types.append(np.dtype(f"<{code}"))
    point_count = _whole_number(header["WIDTH"][0], name, "WIDTH") * _whole_number(header["HEIGHT"][0], name, "HEIGHT")
    stated_count = header.get("POINTS", [str(point_count)])
    if stated_count != [str(point_count)]:
        raise FormatError(f"{name}: POINTS {' '.join(stated_count)} is not WIDTH x HEIGHT, {point_count}")
    dtype = _record_type(name, fields, types, counts)
    if point_count * dtype.itemsize > MAX_BYTES:
        raise FormatError(f"{name}: {point_count} points are more than the limit of {MAX_BYTES} bytes")
    encoding = " ".join(header["DATA"])
    body = content[offset:]
    if encoding == "ascii":
        values = _numbers(body, name, point_count * sum(counts)).reshape(point_count, sum(counts))
        records = _records_of(values, dtype)
    elif encoding == "binary":
        records = _packed_records(body, name, point_count, dtype)
    elif encoding == "binary_compressed":
        records = _unpack_columns(body, name, point_count, dtype)
    else:
        raise FormatError(f"{name}: DATA {encoding}: expected ascii, binary or binary_compressed")
    viewpoint = " ".join(header.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"]))
    return _from_records(records, name, "pcd", is_text=encoding == "ascii", viewpoint=viewpoint)


def _read_ply(content: bytes, name: str) -> PointFile:
    """Read the element `vertex` of a PLY of version 1.0: ascii or binary of either byte order.

    Source: G. Turk, The PLY Polygon File Format, 1994.
    """
    lines, offset = _header_lines(content, name, b"end_header")
    encoding, elements = "", []
    for words in lines:
        if words[0] == "format" and len(words) == 3:
            encoding = words[1]
        elif words[0] == "element" and len(words) == 3:
            elements.append((words[1], _whole_number(words[2], name, "element"), list[tuple[str, str]]()))
        elif words[0] == "property" and elements:
            elements[-1][2].append((words[-1], " ".join(words[1:-1])))
        elif words[0] not in ("ply", "comment", "obj_info", "end_header"):
            raise FormatError(f"{name}: its header has a line '{' '.join(words)[:40]}'")
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}.get(encoding)
    if order is None:
        raise FormatError(f"{name}: format '{encoding}': expected ascii, binary_little_endian or binary_big_endian")
    body, skipped_lines = content[offset:], 0
    for element, count, properties in elements:
        fields, kinds = [field for field, _ in properties], [kind for _, kind in properties]
        unusable = next((kind for kind in kinds if kind not in _PLY_TYPES), None)
        if unusable is None:
            dtype = _record_type(name, fields, [np.dtype(order + _PLY_TYPES[kind]) for kind in kinds], [1] * len(kinds))
        if element == "vertex" and unusable is not None:
            raise FormatError(f"{name}: a vertex has a property of type '{unusable}'; points have plain numbers")
        if element == "vertex" and count * dtype.itemsize > MAX_BYTES:
            raise FormatError(f"{name}: {count} points are more than the limit of {MAX_BYTES} bytes")
        if element == "vertex" and encoding == "ascii":
            rows = b"\n".join(body.split(b"\n")[skipped_lines : skipped_lines + count])
            records = _records_of(_numbers(rows, name, count * len(fields)).reshape(count, len(fields)), dtype)
            return _from_records(records, name, "ply", is_text=True)
        if element == "vertex":
            is_last = elements[-1][0] == "vertex"
            records = _packed_records(body, name, count, dtype, may_go_on=not is_last)
            return _from_records(records, name, "ply", is_text=False)
        if encoding != "ascii" and unusable is not None:
            raise FormatError(f"{name}: lists stand before the vertices; write the vertices first")
        skipped_lines += count
        body = body if encoding == "ascii" else body[count * dtype.itemsize :]
    raise FormatError(f"{name}: it has no element vertex")


def _record_type(
    name: str, fields: Sequence[str], types: Sequence[np.dtype[Any]], counts: Sequence[int]
) -> np.dtype[Any]:
    """Return the type of a point. Padding, which PCD calls "_", gets names of its own."""
    names = [field if field != "_" else f"_{index}" for index, field in enumerate(fields)]
    if len(set(names)) < len(names):
        raise FormatError(f"{name}: two fields of one name ({', '.join(fields)})")
    if not 0 < sum(counts) <= 1024:
        raise FormatError(f"{name}: a point of {sum(counts)} numbers")
    return np.dtype(
        [
            (field, dtype) if count == 1 else (field, dtype, (count,))
            for field, dtype, count in zip(names, types, counts, strict=True)
        ]
    )


def _numbers(text: bytes, name: str, count: int) -> npt.NDArray[np.float64]:
    words = text.split()
    if len(words) != count:
        raise FormatError(f"{name}: {len(words)} numbers, and the header says {count} (cut short?)")
    try:
        return np.array(words, np.float64)
    except ValueError as error:
        raise FormatError(f"{name}: {error}") from None


def _records_of(values: npt.NDArray[np.float64], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return numbers [N, columns] as records."""
    records = np.zeros(len(values), dtype)
    column = 0
    for field in dtype.names or ():
        width = int(np.prod(dtype[field].shape, dtype=int))
        with np.errstate(invalid="ignore"):
            records[field] = values[:, column] if dtype[field].shape == () else values[:, column : column + width]
        column += width
    return records


def _packed_records(
    body: bytes, name: str, count: int, dtype: np.dtype[Any], *, may_go_on: bool = False
) -> npt.NDArray[Any]:
    expected = count * dtype.itemsize
    if len(body) < expected or (not may_go_on and body[expected:].strip(b"\0\n\r")):
        raise FormatError(f"{name}: {len(body)} bytes of points, and the header says {expected} (cut short?)")
    return np.frombuffer(body, dtype, count)


def _unpack_columns(body: bytes, name: str, count: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return the points of a compressed PCD: two lengths, then all values of the first field, of the second, ..."""
    if len(body) < 8:
        raise FormatError(f"{name}: truncated: the lengths of its compressed points are missing")
    packed_size, size = (int(number) for number in np.frombuffer(body, "<u4", 2))
    packed = body[8 : 8 + packed_size]
    if size != count * dtype.itemsize or len(packed) < packed_size:
        raise FormatError(f"{name}: its compressed points are truncated, or not those of its header")
    values = _decompress_lzf(packed, size, name)
    records, position = np.zeros(count, dtype), 0
    for field in dtype.names or ():
        column = np.frombuffer(values, dtype[field].base, count * int(np.prod(dtype[field].shape, dtype=int)), position)
        records[field] = column.reshape(count, *dtype[field].shape)
        position += column.nbytes
    return records


def _decompress_lzf(packed: bytes, size: int, name: str) -> bytes:
    """Decompress LZF, a stream of literal runs and of references to the last 8 KiB.

    Source: the format of liblzf 3.6 (M. Lehmann), as PCL writes it.
    """
    result, position = bytearray(), 0
    try:
        while position < len(packed):
            control = packed[position]
            position += 1
            if control < 32:
                result += packed[position : position + control + 1]
                position += control + 1
            else:
                length = control >> 5
                if length == 7:
                    length += packed[position]
                    position += 1
                distance = ((control & 31) << 8) + packed[position] + 1
                position += 1
                start, length = len(result) - distance, length + 2
                if start < 0:
                    raise IndexError
                # A reference may overlap what it writes: it then repeats.
                piece = bytes(result[start : start + length])
                result += (piece * (length // len(piece) + 1))[:length]
            if len(result) > size:
                raise IndexError
    except IndexError:
        result.clear()
    if len(result) != size:
        raise FormatError(f"{name}: its compressed points are broken")
    return bytes(result)


def _from_records(
    records: npt.NDArray[Any], name: str, file_format: str, *, is_text: bool, viewpoint: str = "0 0 0 1 0 0 0"
) -> PointFile:
    """Return the points of records, whatever the case and the synonym of their fields."""
    by_name = {field.lower(): field for field in records.dtype.names or () if records.dtype[field].shape == ()}
    selected = [by_name.get(axis) for axis in "xyz"]
    for synonyms in (_INTENSITY, _RING):
        selected.append(next((by_name[synonym] for synonym in synonyms if synonym in by_name), None))
    if None in selected[:3]:
        raise FormatError(f"{name}: its points have no x, y and z, but {', '.join(by_name) or 'nothing'}")
    points = np.zeros((len(records), 5), np.float32)
    with np.errstate(over="ignore"):
        for column, field in enumerate(selected):
            if field is not None:
                points[:, column] = records[field]
    has_place = np.isfinite(points[:, :3]).all(axis=1)
    points = points[has_place]
    if not np.isfinite(points).all():
        raise FormatError(f"{name}: an intensity or ring is not finite")
    scale = 1.0
    if selected[3] is not None and len(points):
        scale = _intensity_scale(records.dtype[selected[3]], float(points[:, 3].max()))
        points[:, 3] *= np.float32(scale)
    columns = tuple((field, records.dtype[field]) for field in selected if field is not None)
    dropped_fields = tuple(
        field for field in records.dtype.names or () if field not in selected and not field.startswith("_")
    )
    dropped_points = int((~has_place).sum())
    return PointFile(points, file_format, is_text, columns, scale, dropped_fields, dropped_points, viewpoint)


def _intensity_scale(dtype: np.dtype[Any], maximum: float) -> float:
    """Return the factor to intensities of 0 to 255: files hold shares (0 to 1), bytes, or 16 bits."""
    if dtype.kind == "f":
        return 255.0 if 0 < maximum <= 1 else 1.0
    return 255 / 65535 if dtype.itemsize == 2 and maximum > 255 else 1.0


def encode_points_like(original: PointFile, points: npt.ArrayLike) -> bytes:
    """Return the bytes of a file with other points: of the format, columns, types and unit of the original.

    Compressed PCD and big-endian PLY become binary and little-endian.

    Args:
        original: What the points came from.
        points: [N, 5].
    """
    array = np.asarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] != 5:
        raise ValueError(f"points have shape {array.shape}, not [N, 5]")
    array = array.copy()
    array[:, 3] /= original.intensity_scale
    names = {column for column, _ in original.columns[3:]}
    indices = [0, 1, 2, *([3] if any(name.lower() in _INTENSITY for name in names) else [])]
    indices += [4] if any(name.lower() in _RING for name in names) else []
    records = np.zeros(len(array), np.dtype([(name, dtype.newbyteorder("<")) for name, dtype in original.columns]))
    for (name, dtype), index in zip(original.columns, indices, strict=True):
        values = array[:, index]
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            values = np.round(values).clip(float(limits.min), float(limits.max))
        records[name] = values
    write_header = {"pcd": _pcd_header, "ply": _ply_header}.get(original.format)
    header = "" if write_header is None else write_header(original, len(records))
    if not original.text:
        return header.encode() + records.tobytes()
    return (header + "".join(" ".join(map(str, row.tolist())) + "\n" for row in records)).encode()


def _pcd_header(original: PointFile, count: int) -> str:
    lines: Mapping[str, str] = {
        "VERSION": "0.7",
        "FIELDS": " ".join(name for name, _ in original.columns),
        "SIZE": " ".join(str(dtype.itemsize) for _, dtype in original.columns),
        "TYPE": " ".join(dtype.kind.upper() for _, dtype in original.columns),
        "COUNT": " ".join("1" for _ in original.columns),
        "WIDTH": str(count),
        "HEIGHT": "1",
        "VIEWPOINT": original.viewpoint,
        "POINTS": str(count),
        "DATA": "ascii" if original.text else "binary",
    }
    return "# .PCD v0.7 - Point Cloud Data file format\n" + "".join(f"{key} {text}\n" for key, text in lines.items())


def _ply_header(original: PointFile, count: int) -> str:
    properties = "".join(
        f"property {_PLY_NAMES[f'{dtype.kind}{dtype.itemsize}']} {name}\n" for name, dtype in original.columns
    )
    encoding = "ascii" if original.text else "binary_little_endian"
    return f"ply\nformat {encoding} 1.0\nelement vertex {count}\n{properties}end_header\n"
