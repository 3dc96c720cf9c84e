"""Names: tables, the user's own module:object, and what goes wrong with them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.registry import describe, names, resolve

TABLE = {"loads": "json:loads", "dumps": "json:dumps"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def test_table_and_own_module(folder: Path) -> None:
    import json

    assert resolve("thing", TABLE, "loads") is json.loads
    (folder / "own_module_a.py").write_text("class Outer:\n    class Inner: pass\n")
    assert resolve("thing", TABLE, "own_module_a:Outer.Inner").__name__ == "Inner"
    assert names("thing", TABLE) == TABLE


@pytest.mark.parametrize(
    ("source", "name", "message"),
    [
        (None, "load", "closest: loads"),
        (None, "not_there_at_all:X", "No module named"),
        ("raise RuntimeError('boom')", "own:X", "RuntimeError: boom"),
        ("x = (", "own:X", "SyntaxError"),
        ("import not_there_either", "own:X", "not_there_either"),
        ("class Driver: pass", "own:Diver", "closest: Driver"),
        ("", "own:", "module:object"),
        ("", "../own:X", "module:object"),
    ],
)
def test_errors_are_one_line(folder: Path, source: str | None, name: str, message: str) -> None:
    if source is not None:
        (folder / "own.py").write_text(source)
        sys.modules.pop("own", None)
    with pytest.raises(ConfigError, match="thing") as caught:
        resolve("thing", TABLE, name)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert ("looked in" in str(caught.value)) == (name == "not_there_at_all:X"), "not of what another module lacks"
    assert isinstance(caught.value, UnknownNameError) == (source is None and ":" not in name)


def test_an_error_says_where_the_user_can_mend_it(folder: Path) -> None:
    (folder / "deep_a.py").write_text("import deep_b\n")
    (folder / "deep_b.py").write_text("\n\nvalue = {}['key']\n")
    with pytest.raises(ConfigError) as caught:
        resolve("thing", TABLE, "deep_a:X")
    assert str(caught.value) == f"thing 'deep_a:X': importing deep_a failed: KeyError: 'key' ({folder}/deep_b.py:3)"
    assert describe(ValueError("two\n  lines")) == "ValueError: two lines"
    assert describe(StopIteration()) == "StopIteration"


def test_the_working_folder_is_looked_in_first_and_once(folder: Path) -> None:
    (folder / "json_like.py").write_text("class A:\n    _hidden = 1\n    shown = 2\n")
    for _ in range(2):
        assert resolve("thing", TABLE, "json_like:A.shown") == 2
    assert sys.path[0] == str(folder)
    assert sys.path.count(str(folder)) == 1
    with pytest.raises(ConfigError, match=r"json_like has no 'hidden'; closest: shown$"):
        resolve("thing", TABLE, "json_like:A.hidden")
    with pytest.raises(ConfigError, match=r"json_like has no 'zzz'$"):
        resolve("thing", TABLE, "json_like:A.zzz")


def test_what_is_installed_after_a_look_is_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.utime(tmp_path, (0, 0))  # what changes within a tick of the file system's clock has the same time
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "late" not in names("system", {})
    info = tmp_path / "late-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[ssad.systems]\nlate = late.driver:Late\n")
    assert names("system", {})["late"] == "late.driver:Late"
