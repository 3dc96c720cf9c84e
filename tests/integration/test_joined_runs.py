"""Runs of one suite are shown as one: what failed in one may have run in another, and what is still missing is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import write_run

from benchmarks.joined_runs import joined, summary_of
from ssad.core.errors import ConfigError


def cell(name: str, device: str) -> dict[str, Any]:
    return {"key": f"{name}-{device}", "name": name, "detector": name}


def line(name: str, device: str, status: str = "ok", **more: Any) -> dict[str, Any]:
    return {
        **cell(name, device),
        "status": status,
        "reason": "",
        "versions": {"device": device, "torch": f"2.{len(device)}"},
        **more,
    }


def a_run(folder: Path, device: str, lines: list[dict[str, Any]], **about: Any) -> Path:
    header = {
        "suite": {"name": "digital"},
        "kind": "digital",
        "command": f"ssad run digital --device {device}",
        "versions": {"device": device},
        "weights": {"one": "a"},
        "cells": [cell(name, device) for name in "abcd"],
        **about,
    }
    write_run(folder, header, lines)
    return folder


def test_what_failed_in_one_run_is_taken_from_the_other(tmp_path: Path) -> None:
    here = a_run(tmp_path / "a", "cuda", [line("b", "cuda", "failed", reason="memory"), line("a", "cuda")])
    rest = [line("a", "cpu"), line("b", "cpu"), line("c", "cpu", "failed", reason="time")]
    there = a_run(tmp_path / "b", "cpu", rest, weights={"one": "a", "two": "b"})
    run = joined([here, there])
    assert [(one["detector"], one["versions"]["device"]) for one in run.lines] == [
        ("a", "cuda"),
        ("b", "cpu"),
        ("c", "cpu"),
    ]
    told = summary_of(run)
    assert "cells" not in told
    assert told["command"] == ["ssad run digital --device cuda", "ssad run digital --device cpu"]
    assert told["torch"] == ["2.3", "2.4"]
    assert told["weights"] == {"one": "a", "two": "b"}
    assert (told["planned"], told["ran"], told["missing"], told["failed"]) == (
        4,
        {"cuda": 1, "cpu": 1},
        ["d"],
        {"c": "time"},
    )


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"suite": {"name": "shifts"}}, "of the suite shifts, not of digital"),
        ({"weights": {"one": "b"}}, "one has another version"),
    ],
)
def test_runs_that_do_not_belong_together_are_refused(tmp_path: Path, other: dict[str, Any], message: str) -> None:
    one = a_run(tmp_path / "a", "cuda", [line("a", "cuda")])
    two = a_run(tmp_path / "b", "cuda", [line("b", "cuda")], **other)
    with pytest.raises(ConfigError, match=message):
        joined([one, two])
