"""The first mutations of `benchmarks/fuzz_readers.py`: every reader refuses a broken file in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import fuzz_readers
from benchmarks.fuzz_readers import READERS, Reader, fuzz
from ssad.core.errors import FormatError
from ssad.core.safeio import parse_json, parse_yaml

ROOT = Path(__file__).parents[2]
SLOW_READERS = {
    "report": 6,
    "compare": 10,
    "light": 10,
    "onnx": 10,
    "shifted": 10,
    "texture": 10,
}  # reader -> mutations, where each takes long


@pytest.mark.parametrize("name", READERS)
def test_a_reader_returns_or_refuses_in_one_line(name: str) -> None:
    if not READERS[name].is_available:
        pytest.skip(f"the package {READERS[name].package} is not installed")
    count = SLOW_READERS.get(name, 30)
    tally = fuzz(name, range(count))
    assert tally.failures == {}
    assert tally.returned + tally.refused == count


def test_other_errors_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(folder: Path) -> list[Path]:
        (folder / "a.txt").write_text("abc")
        return [folder / "a.txt"]

    def read(folder: Path) -> object:
        content = (folder / "a.txt").read_bytes()
        return {"a": 1}["b"] if content != b"abc" else content

    monkeypatch.setitem(READERS, "broken", Reader(make, read))
    tally = fuzz("broken", range(5))
    assert len(tally.failures) + tally.returned == 5
    assert any("KeyError" in text for text in tally.failures.values())


BOUNDS = """
from benchmarks.fuzz_readers import TooLong, bounded
try:
    with bounded(seconds=0.05):
        while True:
            pass
except TooLong:
    print("too long")
try:
    with bounded(memory_bytes=1 << 24):
        bytearray(1 << 28)
except MemoryError:
    print("too large")
"""


def test_a_read_has_bounds_of_time_and_memory() -> None:
    """In a process of its own: alarms and limits of memory are the whole process's."""
    run = subprocess.run(
        [sys.executable, "-c", BOUNDS], cwd=ROOT, capture_output=True, text=True, timeout=120, check=True
    )
    assert run.stdout.split("\n")[:2] == ["too long", "too large"]


def test_equal_seeds_give_equal_mutations() -> None:
    draws = [
        fuzz_readers.mutate(fuzz_readers.random.Random(f"0 suite {k}"), Path("a.yaml"), b"a: [1, 2]\n")
        for k in (3, 3, 4)
    ]
    assert draws[0] == draws[1] != draws[2]


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (parse_yaml, "seed: 0x" + "f" * 100_000, "<text>:1: a number of 100002 digits"),
        (parse_yaml, "seed: 1e999", "<text>:1: 1e999 is too large for a number"),
        (parse_json, "9" * 400, "a number of 400 digits"),
        (parse_json, "[1e999]", "1e999 is too large for a number"),
        (parse_json, "[" * 200_000 + "]" * 200_000, "nested deeper than 100 levels"),
        (parse_json, '{"a":' * 101 + "1" + "}" * 101, "nested deeper than 100 levels"),
    ],
)
def test_numbers_and_depths_beyond_reason_are_one_line(read: object, text: str, words: str) -> None:
    with pytest.raises(FormatError, match=words) as caught:
        read(text)  # type: ignore[operator]
    assert len(str(caught.value)) < 200


def test_long_numbers_and_brackets_in_texts_are_read() -> None:
    assert parse_json("[" * 100 + "]" * 100) is not None
    assert parse_json(f'["{"[" * 500}\\"{"[" * 500}", "{"9" * 400}", 1e-400, 1e300, {10**200}]')[3:] == [1e300, 10**200]
