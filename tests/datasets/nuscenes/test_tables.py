"""The table stream: equal to a whole-file parse at any block size; errors name file and line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import FormatError
from ssad.datasets.nuscenes.schema import EgoPose, Scene, Visibility
from ssad.datasets.nuscenes.tables import stream, table_path

text = st.text(st.characters(codec="utf-8"), max_size=30) | st.sampled_from(['},{"token":', '"}]', "\\", "}}", "[{"])
records = st.lists(st.fixed_dictionaries({"token": text, "level": text, "description": text}), max_size=12)


def flat(path: Path, kind: Any, **options: Any) -> list[Any]:
    return [record for block in stream(path, kind, **options) for record in block]


@settings(max_examples=60, deadline=None)
@given(rows=records, block=st.integers(1, 80), indent=st.sampled_from([None, 0, 1]), ascii_only=st.booleans())
def test_equal_to_a_whole_parse(tmp_path: Path, rows: Any, block: int, indent: int | None, ascii_only: bool) -> None:
    path = tmp_path / "visibility.json"
    path.write_text(json.dumps(rows, indent=indent, ensure_ascii=ascii_only), encoding="utf-8")
    found = flat(path, Visibility, block=block)
    assert [(row.token, row.level, row.description) for row in found] == [
        (row["token"], row["level"], row["description"]) for row in rows
    ]


def test_unknown_keys_are_ignored_and_defaults_used(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text('[{"token": "a", "name": "scene-1", "colour": {"deep": [1, {"x": "}"}]}}]')
    assert flat(path, Scene) == [Scene("a", "scene-1")]


def test_blocks_bound_the_records_held(tmp_path: Path) -> None:
    path = tmp_path / "visibility.json"
    path.write_text(json.dumps([{"token": str(i), "level": "x" * 50} for i in range(1000)], indent=0))
    sizes = [len(block) for block in stream(path, Visibility, block=4096)]
    assert sum(sizes) == 1000
    assert max(sizes) < 100


@pytest.mark.parametrize(
    ("content", "where", "what"),
    [
        ('[{"token": "a", "level": "x"},\n{"token": "b"', ":", "too early"),
        ('[{"token": "a", "level": "x"},\n{"token": "b"}]', ":2:", "level"),
        ('[{"token": "a", "level": "x"},\n{"token": 3, "level": ""}]', ":2:", "str"),
        ('{"token": "a"}', ":1:", "list of records"),
        ("", ":1:", "list of records"),
        ('[{"token": "a", "level": "x"},]', ":1:", "not valid JSON"),
        ('[{"token": "a", "level": "x"} {"token": "b", "level": "x"}]', ":1:", "not valid JSON"),
        ('[{"token": "a", "level": "x"}] trailing', ":1:", "not valid JSON"),
        ("[1, 2]", ":1:", "object"),
    ],
)
def test_broken_tables_name_file_and_line(tmp_path: Path, content: str, where: str, what: str) -> None:
    path = tmp_path / "visibility.json"
    path.write_text(content)
    with pytest.raises(FormatError) as caught:
        flat(path, Visibility)
    assert str(caught.value).startswith(f"{path}{where}")
    assert what in str(caught.value)


def test_wrong_vector_length(tmp_path: Path) -> None:
    path = tmp_path / "ego_pose.json"
    path.write_text('[\n{"token": "a", "translation": [1, 2], "rotation": [1, 0, 0, 0], "timestamp": 5}\n]')
    with pytest.raises(FormatError, match=r"ego_pose\.json:2: .*translation"):
        flat(path, EgoPose)


def test_missing_table(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        flat(tmp_path / "scene.json", Scene)
    assert table_path(tmp_path, "v1.0-mini", "scene") == tmp_path / "v1.0-mini" / "scene.json"
