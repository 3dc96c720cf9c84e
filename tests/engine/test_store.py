"""The store: torn lines, locks, folders of other runs."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

import pytest
from helpers.descriptors import open_files

from ssad.core.errors import StoreError
from ssad.core.jsonl import read_lines
from ssad.core.run_records import counts_text
from ssad.engine import store as stores
from ssad.engine.store import Store, locked, read_run

RUN: dict[str, Any] = {"identity": "a", "suite": {"name": "s", "seed": 0}}


def result(key: str) -> dict[str, Any]:
    return {"key": key, "status": "ok", "metrics": {"x": 1.5}}


def fill(folder: Path, *keys: str) -> None:
    with Store.open(folder, RUN) as store:
        for key in keys:
            store.append(result(key), {"key": key, "raw": key})


def test_append_and_reopen(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    with Store.open(tmp_path, RUN) as store:
        assert list(store.results) == ["a", "b"]
        with pytest.raises(ValueError, match="already"):
            store.append(result("a"), None)
    assert read_run(tmp_path)["identity"] == "a"
    assert '\n "identity": "a"' in (tmp_path / "run.json").read_text(), "people read it"
    assert [r["key"] for r in read_lines(tmp_path / "episodes.jsonl")] == ["a", "b"]


def test_every_cut_of_the_files_is_mended(tmp_path: Path) -> None:
    """At each byte of the second of three lines, and at the ends of the others."""
    fill(tmp_path / "whole", "a", "b", "c")
    results = (tmp_path / "whole" / "results.jsonl").read_bytes()
    episodes = (tmp_path / "whole" / "episodes.jsonl").read_bytes()
    line = len(results) // 3
    for cut in (0, 1, line - 1, *range(line, 2 * line + 2), 3 * line - 1):
        folder = tmp_path / str(cut)
        fill(folder)
        done = cut // line
        # the episode line of a cell is written before its result
        written = min(3, done + 1) * (len(episodes) // 3)
        (folder / "results.jsonl").write_bytes(results[:cut])
        (folder / "episodes.jsonl").write_bytes(episodes[:written])
        with Store.open(folder, RUN) as store:
            assert len(store.results) == done
            for key in "abc":
                if key not in store.results:
                    store.append(result(key), {"key": key, "raw": key})
        assert (folder / "results.jsonl").read_bytes() == results
        assert (folder / "episodes.jsonl").read_bytes() == episodes


@pytest.mark.parametrize("name", ["results.jsonl", "episodes.jsonl"])
def test_a_torn_last_line_of_a_finished_run_is_mended_and_a_removed_one_is_not(tmp_path: Path, name: str) -> None:
    """A power cut may tear a line that was counted; one that ends where a line ends was not torn."""
    fill(tmp_path / "whole", "a", "b", "c")
    files = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    line = len(files[name]) // 3
    for cut in range(2 * line, 3 * line):
        folder = tmp_path / f"cut{cut}"
        folder.mkdir()
        for other_name, content in files.items():
            (folder / other_name).write_bytes(content[:cut] if other_name == name else content)
        if cut == 2 * line:
            with pytest.raises(StoreError, match=rf"{name}:3: this line is missing: the run wrote 3 lines; restore"):
                fill(folder)
            continue
        fill(folder, "c")
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == files


def test_a_kill_between_any_two_writes_leaves_a_folder_to_go_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also while failed cells are taken out: files that get shorter are counted first."""

    class Killed(BaseException):
        pass

    def killed_at(number: int, call: Any) -> Any:
        calls = iter(range(1000))

        def wrapped(*arguments: Any) -> Any:
            if next(calls) == number:
                raise Killed
            return call(*arguments)

        return wrapped

    fill(tmp_path / "whole", "a", "c", "d", "b")
    files = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    for function in ("os.replace", "os.write", "os.pwrite"):
        for number in range(6):
            folder = tmp_path / f"{function}{number}"
            fill(folder, "a")
            with Store.open(folder, RUN) as store:
                store.append({"key": "b", "status": "failed"}, {"key": "b", "raw": "early"})
            fill(folder, "c")
            with monkeypatch.context() as patch, contextlib.suppress(Killed):
                patch.setattr(function, killed_at(number, getattr(os, function.removeprefix("os."))))
                with Store.open(folder, RUN, retry=True) as store:
                    store.append(result("d"), {"key": "d", "raw": "d"})
            with Store.open(folder, RUN, retry=True) as store:
                for key in "db":
                    if key not in store.results:
                        store.append(result(key), {"key": key, "raw": key})
            assert {path.name: path.read_bytes() for path in folder.iterdir()} == files, (function, number)


def test_a_folder_from_before_there_were_seals_goes_on_without(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps(RUN))
    for name in ("results.jsonl", "episodes.jsonl"):
        (tmp_path / name).write_text(json.dumps(result("a")) + "\n")
    fill(tmp_path, "b")
    assert sorted(os.listdir(tmp_path)) == [".lock", "episodes.jsonl", "results.jsonl", "run.json"]
    assert "seal" not in (tmp_path / "results.jsonl").read_text()
    assert [r["key"] for r in read_lines(tmp_path / "results.jsonl")] == ["a", "b"]


def test_what_failed_goes_when_it_is_to_be_tried_again(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    with Store.open(tmp_path, RUN) as store:
        store.append({"key": "b", "status": "failed"}, None)
    fill(tmp_path, "c")
    before = (tmp_path / "results.jsonl").read_bytes()
    with Store.open(tmp_path, RUN) as store:
        assert list(store.results) == ["a", "b", "c"]
    assert (tmp_path / "results.jsonl").read_bytes() == before
    with Store.open(tmp_path, RUN, retry=True) as store:
        assert list(store.results) == ["a", "c"]
        store.append(result("b"), {"key": "b", "raw": "b"})
    fill(tmp_path / "never", "a", "c", "b")
    for name in ("results.jsonl", "episodes.jsonl"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "never" / name).read_bytes()


def test_only_what_is_named_is_tried_again(tmp_path: Path) -> None:
    with Store.open(tmp_path, RUN) as store:
        for key in ("a", "b"):
            store.append({"key": key, "status": "failed"}, None)
    with Store.open(tmp_path, RUN, retry=["b", "c"]) as store:
        assert (list(store.results), store.retried) == (["a"], {"b"})
    with Store.open(tmp_path, RUN, retry=[]) as store:
        assert (list(store.results), store.retried) == (["a"], frozenset())


def test_a_last_line_of_zeros_is_cut(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    with open(tmp_path / "results.jsonl", "ab") as file:
        file.write(b"\0" * 20 + b"\n")
    assert len(read_lines(tmp_path / "results.jsonl")) == 2
    fill(tmp_path, "c")
    assert [r["key"] for r in read_lines(tmp_path / "results.jsonl")] == ["a", "b", "c"]


def test_a_broken_line_in_the_middle_is_reported(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    data = (tmp_path / "results.jsonl").read_bytes()
    (tmp_path / "results.jsonl").write_bytes(b"{broken}\n" + data)
    with pytest.raises(StoreError, match=r"results\.jsonl:1: this line is broken"):
        Store.open(tmp_path, RUN)


def test_a_doubled_key_is_reported(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    data = (tmp_path / "results.jsonl").read_bytes()
    (tmp_path / "results.jsonl").write_bytes(data + data)
    with pytest.raises(StoreError, match="twice"):
        Store.open(tmp_path, RUN)


def test_two_runs_cannot_share_a_folder(tmp_path: Path) -> None:
    with Store.open(tmp_path, RUN):
        before = open_files()
        with pytest.raises(StoreError, match="another ssad run"):
            Store.open(tmp_path, RUN)
        assert open_files() == before
    Store.open(tmp_path, RUN).close()


def test_a_folder_of_another_run_is_left_alone(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    before = {name: (tmp_path / name).read_bytes() for name in ("run.json", "results.jsonl")}
    with pytest.raises(StoreError, match=r"suite s; differs in seed"):
        Store.open(tmp_path, {"identity": "b", "suite": {"name": "s", "seed": 1}})
    assert before == {name: (tmp_path / name).read_bytes() for name in before}


def test_unwritable_folder_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "sub", Path("/proc/ssad-run")):
        with pytest.raises(StoreError, match="folder"):
            Store.open(folder, RUN)
    assert os.listdir(tmp_path) == ["file"]


def test_results_without_run_json(tmp_path: Path) -> None:
    (tmp_path / "results.jsonl").write_text(json.dumps(result("a")) + "\n")
    with pytest.raises(StoreError, match=r"no run\.json"):
        Store.open(tmp_path, RUN)
    with pytest.raises(StoreError, match="not a results folder"):
        read_run(tmp_path)


def test_nothing_is_left_open(tmp_path: Path) -> None:
    before = open_files()
    fill(tmp_path, "a")
    with locked(tmp_path / "other", "ssad toolbox"):
        pass
    with open(tmp_path / "results.jsonl", "a") as file:
        file.write(json.dumps(result("a")) + "\n")
    with pytest.raises(StoreError, match="twice"):
        Store.open(tmp_path, RUN)
    assert open_files() == before


def test_what_an_episode_lacks_is_not_written(tmp_path: Path) -> None:
    with Store.open(tmp_path, RUN) as store:
        store.append(result("a"), None)
        store.append(result("b"), {"key": "b"})
        assert list(store.results) == ["a", "b"]
    assert [r["key"] for r in read_lines(tmp_path / "episodes.jsonl")] == ["b"]


def test_a_write_that_is_cut_short_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path / "whole", "a", "b")
    write, synced = os.write, []
    with Store.open(tmp_path / "cut", RUN) as store, monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:7]))
        patch.setattr(os, "fsync", synced.append)
        for key in "ab":
            store.append(result(key), {"key": key, "raw": key})
    for name in ("results.jsonl", "episodes.jsonl"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert len(synced) == 4, "a line is on disk before the next is written"


def test_a_full_disk_is_one_line_and_the_cell_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    with Store.open(tmp_path, RUN) as store:
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            with pytest.raises(
                StoreError, match=r"episodes\.jsonl: cannot be written: No space left on device; make room"
            ):
                store.append(result("a"), {"key": "a"})
        assert not store.results
        store.append(result("a"), {"key": "a"})


def test_a_folder_that_cannot_be_locked_or_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = open_files()

    def refused(name: str, *, word: str = "") -> Any:
        real = os.open

        def call(*arguments: Any, **options: Any) -> Any:
            if str(arguments[0]).endswith(word) or not word:
                raise OSError(13, f"{name} is refused")
            return real(*arguments, **options)

        return call

    for place, name, words in (
        ("fcntl.flock", "", r"\.lock: cannot be locked: fcntl\.flock is refused"),
        ("os.open", ".lock", r"\.lock: cannot be written: os\.open is refused"),
        ("os.open", "results.jsonl", r"results\.jsonl: cannot be written: os\.open is refused"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(place, refused(place, word=name))
            with pytest.raises(StoreError, match=words):
                Store.open(tmp_path, RUN)
    assert open_files() == before
    fill(tmp_path, "a")


def test_files_can_be_read_by_others_and_not_written(tmp_path: Path) -> None:
    mask = os.umask(0)
    try:
        fill(tmp_path, "a")
    finally:
        os.umask(mask)
    for name in (".lock", "results.jsonl", "episodes.jsonl"):
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o644, name


def test_a_run_that_began_meanwhile_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = stores._lock

    def lock(folder: Path, what: str) -> int:
        (folder / "run.json").write_text(json.dumps({"identity": "b", "suite": {"name": "other"}}))
        return real(folder, what)

    monkeypatch.setattr(stores, "_lock", lock)
    with pytest.raises(StoreError, match="holds another run"):
        Store.open(tmp_path, RUN)


@pytest.mark.parametrize("text", ["[]", "{}", '["identity"]'])
def test_a_run_json_of_somebody_else(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(StoreError, match=r"run\.json: not written by ssad run"):
        read_run(tmp_path)


def test_what_differs_is_told(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    for suite, words in (
        ({"name": "s", "seed": 0}, "differs in the code, a system or a town"),
        ({"name": "s", "kind": "x"}, "differs in kind, seed"),
    ):
        with pytest.raises(StoreError, match=words):
            Store.open(tmp_path, {"identity": "b", "suite": suite})
    with pytest.raises(StoreError, match="differs in name, seed"):
        Store.open(tmp_path, {"identity": "b"})


def test_a_file_in_the_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StoreError, match="file: is a file; choose a folder with --out"):
        Store.open(tmp_path / "file", RUN)


def test_a_folder_is_for_one_command_at_a_time(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    with (
        locked(folder, "ssad record"),
        pytest.raises(StoreError, match="another ssad record is writing there"),
        locked(folder, "ssad record"),
    ):
        pytest.fail("twice")
    with locked(folder, "ssad record"), pytest.raises(StoreError, match="another ssad run is writing there"):
        Store.open(folder, RUN)
    assert os.listdir(folder) == [".lock"]


def test_episodes_without_a_result_go_and_no_others(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    whole = (tmp_path / "episodes.jsonl").read_bytes()
    counts = (tmp_path / "seal.json").read_bytes()
    results = (tmp_path / "results.jsonl").read_bytes()
    fill(tmp_path, "c", "d")
    with open(tmp_path / "episodes.jsonl", "a") as file:
        file.write('{"ke')
    (tmp_path / "results.jsonl").write_bytes(results)
    (tmp_path / "seal.json").write_bytes(counts)
    fill(tmp_path)
    assert (tmp_path / "episodes.jsonl").read_bytes() == whole
    (tmp_path / "results.jsonl").write_bytes(b"")
    (tmp_path / "seal.json").unlink()
    with pytest.raises(StoreError, match=r"seal\.json: is missing, though the run has lines"):
        Store.open(tmp_path, RUN)
    (tmp_path / "seal.json").write_text(counts_text({"results.jsonl": 0, "episodes.jsonl": 0}))
    fill(tmp_path)
    assert (tmp_path / "episodes.jsonl").read_bytes() == b""
