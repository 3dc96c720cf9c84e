"""The store: torn lines, locks, folders of other runs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import StoreError
from ssad.core.jsonl import read_lines
from ssad.jobs.store import Store, read_run

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
    assert [r["key"] for r in read_lines(tmp_path / "episodes.jsonl")] == ["a", "b"]


def test_every_cut_of_the_files_is_mended(tmp_path: Path) -> None:
    fill(tmp_path / "whole", "a", "b", "c")
    results = (tmp_path / "whole" / "results.jsonl").read_bytes()
    episodes = (tmp_path / "whole" / "episodes.jsonl").read_bytes()
    line = len(results) // 3
    for cut in range(len(results)):
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
    with Store.open(tmp_path, RUN), pytest.raises(StoreError, match="another ssad run"):
        Store.open(tmp_path, RUN)
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
