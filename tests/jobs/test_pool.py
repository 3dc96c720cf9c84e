"""Work shared out over processes."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path

import pytest

from ssad.core.errors import StoreError
from ssad.jobs.machine import visible_gpus
from ssad.jobs.pool import Crew, spread


def seen(number: int) -> tuple[int, str]:
    """The GPUs that the process which does this may use."""
    time.sleep(0.3)
    return os.getpid(), os.environ.get("CUDA_VISIBLE_DEVICES", "all")


def threads(number: int) -> str | None:
    """Of the linear algebra in the process which does this."""
    return os.environ.get("OPENBLAS_NUM_THREADS")


def touch(path: Path) -> None:
    """Leaves a trace."""
    time.sleep(0.05)
    path.touch()


def die(number: int) -> int:
    """Ends its process without a word."""
    os._exit(3)


def fail(number: int) -> int:
    """Raises for 1."""
    if number == 1:
        raise ValueError("one")
    return number


def test_each_process_sees_one_gpu_in_turn() -> None:
    by_process = dict(spread(seen, range(8), 4, gpus=["0", "3"]))
    assert len(by_process) > 1, "more than one process worked"
    assert set(by_process.values()) <= {"0", "3"}
    counts = Counter(by_process.values())
    assert abs(counts["0"] - counts["3"]) <= 4 - len(by_process) + 1, "shared out evenly"
    before = os.environ.get("CUDA_VISIBLE_DEVICES", "all")
    assert {gpus for _, gpus in spread(seen, range(2), 2)} == {before}, "left alone when none are named"


def test_processes_share_the_cores_in_linear_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert set(spread(threads, range(4), 2)) == {"3"}
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    assert set(spread(threads, range(4), 2)) == {"7"}, "what the user set is kept"


@pytest.mark.parametrize("workers", [1, 2])
def test_work_that_turns_up_while_results_are_read_is_done(workers: int) -> None:
    with Crew(workers) as crew:
        for number in (10, 20, 30, 40, 50, 60, 70, 80):
            crew.add(fail, number)
        found = []
        for number in crew.results():
            found.append(number)
            if not number % 10:
                crew.add(fail, number + 2, first=True)
    assert sorted(found) == sorted([n + k for n in range(10, 90, 10) for k in (0, 2)])
    if workers == 1:
        assert found[:6] == [10, 12, 20, 22, 30, 32], "what is to come first does not wait for the rest"


def test_what_is_left_when_the_reader_goes_is_not_begun(tmp_path: Path) -> None:
    with Crew(2) as crew:
        for number in range(20):
            crew.add(touch, tmp_path / str(number))
        next(iter(crew.results()))
    assert 1 <= len(list(tmp_path.iterdir())) < 20


def test_visible_gpus_follow_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-ab12")
    assert visible_gpus() == ["2", "GPU-ab12"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert not visible_gpus()


def test_errors_of_the_work_and_of_its_process() -> None:
    with pytest.raises(ValueError, match="one"):
        list(spread(fail, range(3), 2))
    with pytest.raises(StoreError, match="a worker died"):
        list(spread(die, range(2), 2))
