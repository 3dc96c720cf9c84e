"""JSON lines: whole records, torn ends, broken middles."""

from pathlib import Path

import pytest

from ssad.core.errors import StoreError
from ssad.core.jsonl import JsonLines, read_lines, scan_lines

WHOLE = b'{"key": "a"}\n{"key": "b", "n": 1}\n'


@pytest.mark.parametrize(
    "torn", [b"", b'{"key": "c"', b'{"key": "c"}', b'{"ke\n', b"\x00\x00\x00\n", b'"text"\n', b"{}\n"]
)
def test_a_torn_last_line_is_left_out(tmp_path: Path, torn: bytes) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_bytes(WHOLE + torn)
    assert read_lines(path) == [{"key": "a"}, {"key": "b", "n": 1}]
    assert bool(scan_lines(path).tail) == bool(torn)


@pytest.mark.parametrize("broken", [b"nonsense\n", b"{}\n", b"\xff\xfe\n", b"\n"])
def test_a_broken_line_in_the_middle_is_named(tmp_path: Path, broken: bytes) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_bytes(b'{"key": "a"}\n' + broken + WHOLE)
    with pytest.raises(StoreError, match=r"lines\.jsonl:2: this line is broken"):
        read_lines(path)


def test_no_file_has_no_lines(tmp_path: Path) -> None:
    assert scan_lines(tmp_path / "absent") == JsonLines(tmp_path / "absent")
    assert read_lines(tmp_path / "absent") == []
