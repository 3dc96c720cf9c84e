"""Point files: each encoding of PCD and PLY, and both .bin, give the same points and are written as they were."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import FormatError
from ssad.datasets.point_files import encode_points_like, read_point_file, read_points

# what python-lzf 0.2.6, a binding of liblzf, made of the columns of `columns_of_repeats`
LZF = bytes.fromhex(
    "010000e00b0001803fe00903010040e0090300402013e00703010080e009030180bfe009030100c0e0090300402013e007030000208be0"
    "430305204100004843e03d07014843"
)


def cloud(count: int = 40) -> Any:
    """Points [count, 5] whose coordinates and intensities are exact in text and in float32."""
    draws = np.random.default_rng(3)
    coordinates = draws.integers(-400, 400, (count, 3)) / 8
    return np.column_stack([coordinates, draws.integers(2, 255, count), draws.integers(0, 32, count)]).astype("f4")


def columns_of_repeats() -> list[Any]:
    x = np.repeat(np.arange(4, dtype="<f4"), 5)
    return [x, -x, np.full(20, 0.5, "<f4"), np.tile(np.array([10, 200], "<f4"), 10)]


RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("time", "<f8"), ("ring", "<u2")])


def records() -> Any:
    result = np.zeros(40, RECORD)
    for column, name in enumerate(("x", "y", "z", "intensity", "ring")):
        result[name] = cloud()[:, column]
    result["time"] = np.arange(40) / 4
    return result


def as_text(rows: Any) -> bytes:
    return "".join(" ".join(map(str, row.tolist())) + "\n" for row in rows).encode()


def pcd(data: str, body: bytes, *, fields: str = "x y z intensity time ring", count: int = 40) -> bytes:
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4 4 8 2\nTYPE F F F F F U\n"
        f"COUNT 1 1 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    ).encode() + body


def literal_lzf(content: bytes) -> bytes:
    """LZF of literal runs alone."""
    return b"".join(
        bytes([len(content[start : start + 32]) - 1]) + content[start : start + 32]
        for start in range(0, len(content), 32)
    )


def compressed(content: bytes, packed: bytes) -> bytes:
    return np.array([len(packed), len(content)], "<u4").tobytes() + packed


def by_column(rows: Any) -> bytes:
    return b"".join(rows[name].tobytes() for name in rows.dtype.names)


def ply(encoding: str, body: bytes, *, before: str = "", after: str = "", count: int = 40) -> bytes:
    properties = "".join(
        f"property {kind} {name}\n"
        for name, kind in zip(RECORD.names or (), ("float", "float", "float", "float", "double", "ushort"), strict=True)
    )
    vertices = f"element vertex {count}\n{properties}"
    return f"ply\nformat {encoding} 1.0\ncomment made here\n{before}{vertices}{after}end_header\n".encode() + body


FACES = "element face 1\nproperty list uchar int vertex_indices\n"
FILES = {
    "ascii.pcd": pcd("ascii", as_text(records())),
    "binary.pcd": pcd("binary", records().tobytes()),
    "compressed.pcd": pcd("binary_compressed", compressed(by_column(records()), literal_lzf(by_column(records())))),
    "ascii.ply": ply("ascii", as_text(records()) + b"3 0 1 2\n", after=FACES),
    "little.ply": ply("binary_little_endian", records().tobytes() + b"\x03" + bytes(12), after=FACES),
    "big.ply": ply("binary_big_endian", records().astype(RECORD.newbyteorder(">")).tobytes()),
    "before.ply": ply(
        "binary_little_endian",
        bytes(6) + records().tobytes(),
        before="element pose 2\nproperty uchar a\nproperty short b\n",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_every_encoding_holds_the_same_points_and_is_written_anew(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(FILES[name])
    point_file = read_point_file(tmp_path / name)
    np.testing.assert_array_equal(point_file.points, cloud())
    assert point_file.dropped_fields == ("time",)
    moved = point_file.points[::3] + np.float32([1, 2, 3, 0, 0])
    (tmp_path / f"new-{name}").write_bytes(encode_points_like(point_file, moved))
    again = read_point_file(tmp_path / f"new-{name}")
    np.testing.assert_array_equal(again.points, moved)
    assert (again.format, again.text, again.viewpoint) == (point_file.format, point_file.text, point_file.viewpoint)
    assert [(column, kind.newbyteorder("<")) for column, kind in point_file.columns] == list(again.columns)
    if name.endswith("pcd"):
        assert again.viewpoint == "1 2 3 1 0 0 0"


def test_references_of_lzf_are_followed_as_liblzf_writes_them(tmp_path: Path) -> None:
    content = b"".join(column.tobytes() for column in columns_of_repeats())
    header = (
        b"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 20\nHEIGHT 1\nDATA binary_compressed\n"
    )
    (tmp_path / "a.pcd").write_bytes(header + compressed(content, LZF))
    np.testing.assert_array_equal(read_points(tmp_path / "a.pcd")[:, :4], np.column_stack(columns_of_repeats()))
    assert not read_points(tmp_path / "a.pcd")[:, 4].any()


@pytest.mark.parametrize("columns", [4, 5])
def test_rows_of_floats_are_kittis_or_nuscenes(columns: int, tmp_path: Path) -> None:
    rows = cloud()[:, :columns].copy()
    if columns == 4:
        rows[:, 3] /= 255
    (tmp_path / "a.bin").write_bytes(rows.astype("<f4").tobytes())
    point_file = read_point_file(tmp_path / "a.bin", columns=columns)
    np.testing.assert_allclose(point_file.points[:, :columns], cloud()[:, :columns], rtol=1e-6)
    assert point_file.points.shape == (40, 5)
    written = np.frombuffer(encode_points_like(point_file, point_file.points), "<f4").reshape(-1, columns)
    np.testing.assert_allclose(written, rows, rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "size", "stored", "expected"),
    [
        ("F", 4, [0.0, 0.5, 1.0], [0, 127.5, 255]),
        ("F", 4, [0, 2, 200], [0, 2, 200]),
        ("U", 1, [0, 9, 255], [0, 9, 255]),
        ("U", 2, [0, 257, 65535], [0, 1, 255]),
    ],
)
def test_intensities_are_from_0_to_255_and_written_in_their_unit(
    kind: str, size: int, stored: list[float], expected: list[float], tmp_path: Path
) -> None:
    rows = np.zeros(4, np.dtype([("x", "<f4"), ("Y", "<f4"), ("z", "<f4"), ("i", f"<{kind.lower()}{size}")]))
    rows["x"], rows["i"] = [1, 2, 3, np.nan], [*stored, 0]
    header = (
        f"# .PCD\nVERSION .7\nFIELDS x Y z Intensity\nSIZE 4 4 4 {size}\nTYPE F F F {kind}\nCOUNT 1 1 1 1\n"
        "WIDTH 2\nHEIGHT 2\nPOINTS 4\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(header.encode() + rows.tobytes())
    point_file = read_point_file(tmp_path / "a.pcd")
    np.testing.assert_allclose(point_file.points[:, 3], expected, rtol=1e-6)
    assert point_file.dropped_points == 1
    assert encode_points_like(point_file, point_file.points).endswith(rows[:3].tobytes())


def test_a_cloud_without_intensity_is_written_without(tmp_path: Path) -> None:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n1 2 3\n")
    point_file = read_point_file(tmp_path / "a.ply")
    assert point_file.points.tolist() == [[1, 2, 3, 0, 0]]
    assert encode_points_like(point_file, point_file.points + 1).endswith(b"end_header\n2.0 3.0 4.0\n")


BROKEN = {
    "short text.pcd": (FILES["ascii.pcd"][:-20], "the header says 240"),
    "short.pcd": (FILES["binary.pcd"][:-1], "the header says 1040"),
    "long.pcd": (FILES["binary.pcd"] + b"more", "the header says 1040"),
    "packed.pcd": (FILES["compressed.pcd"][:-9], "truncated"),
    "lengths.pcd": (pcd("binary_compressed", b"abc"), "lengths"),
    "lzf.pcd": (pcd("binary_compressed", compressed(bytes(1040), b"\xff" * 90)), "are broken"),
    "bomb.pcd": (pcd("binary", b"", count=999_999_999), "more than the limit"),
    "header.pcd": (FILES["binary.pcd"][:90], "no header of a PCD file"),
    "words.pcd": (pcd("ascii", as_text(records()).replace(b"0.25", b"abcd")), "could not convert"),
    "other.pcd": (pcd("binary", records().tobytes(), fields="a b c d e f"), "no x, y and z"),
    "twice.pcd": (pcd("binary", records().tobytes(), fields="x y z z e f"), "two fields of one name"),
    "type.pcd": (FILES["binary.pcd"].replace(b"SIZE 4", b"SIZE 3"), "is not known"),
    "count.pcd": (FILES["binary.pcd"].replace(b"POINTS 40", b"POINTS 41"), "is not WIDTH x HEIGHT"),
    "fields.pcd": (FILES["binary.pcd"].replace(b"COUNT 1", b"COUNT"), "of different lengths"),
    "number.pcd": (FILES["binary.pcd"].replace(b"WIDTH 40", b"WIDTH -4"), "no whole number"),
    "data.pcd": (FILES["binary.pcd"].replace(b"DATA binary", b"DATA squeezed"), "DATA squeezed"),
    "short.ply": (FILES["big.ply"][:-1], "cut short"),
    "end.ply": (FILES["big.ply"][:60], "does not end"),
    "list.ply": (FILES["ascii.ply"].replace(b"property float x", b"property list uchar int x"), "plain numbers"),
    "format.ply": (FILES["ascii.ply"].replace(b"format ascii", b"format squeezed"), "format 'squeezed'"),
    "faces.ply": (ply("binary_little_endian", bytes(13), before=FACES), "before the vertices"),
    "none.ply": (b"ply\nformat ascii 1.0\nend_header\n", "no element vertex"),
    "empty.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "a point of 0 numbers"),
    "line.ply": (b"ply\nformat ascii 1.0\nhello there\nend_header\n", "a line 'hello there'"),
    "text.ply": (b"hello", "no header of a PLY file"),
    "rows.bin": (bytes(21), "no whole number of 20-byte points"),
    "nan.bin": (np.full((2, 5), np.nan, "<f4").tobytes(), "point 0 is not finite"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_line(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(BROKEN[name][0])
    with pytest.raises(FormatError) as caught:
        read_points(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert BROKEN[name][1] in str(caught.value)
    assert "\n" not in str(caught.value)


def test_changed_bytes_give_points_or_one_line(tmp_path: Path) -> None:
    """Bytes of the header and of the packed points are replaced at random."""
    draws, path = np.random.default_rng(0), tmp_path / "a.pcd"
    for name in ("ascii.pcd", "compressed.pcd", "ascii.ply", "big.ply"):
        for _ in range(60):
            content = bytearray(FILES[name])
            for place in draws.integers(0, len(content), 3):
                content[place] = draws.integers(256)
            path.write_bytes(bytes(content))
            with contextlib.suppress(FormatError):
                points = read_points(path)
                assert points.shape[1] == 5
                assert np.isfinite(points).all()
