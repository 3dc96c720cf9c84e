"""Work shared out over processes."""

from __future__ import annotations

import os
import time
from collections import Counter

import pytest

from ssad.bench.pool import spread, visible_gpus
from ssad.errors import StoreError


def seen(number: int) -> tuple[int, str]:
    """The GPUs that the process which does this may use."""
    time.sleep(0.3)
    return os.getpid(), os.environ.get("CUDA_VISIBLE_DEVICES", "all")


def threads(number: int) -> str | None:
    """Of the linear algebra in the process which does this."""
    return os.environ.get("OPENBLAS_NUM_THREADS")


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
