"""What a machine has: devices, cores, GPUs, versions; and Warp started without a word."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from helpers.descriptors import open_files

from ssad.core import machine
from ssad.core.errors import ConfigError
from ssad.core.machine import (
    cuda_driver,
    default_workers,
    gpu_workers,
    pick_device,
    retain_freed_memory,
    start_warp_quietly,
    versions,
    visible_gpus,
)

GIB = 1 << 30


class FakeWarp:
    """The part of Warp that is asked for; `init` warns on the descriptor of standard error, as its native part does."""

    LOG_ERROR = 40

    def __init__(self, cuda: bool = False) -> None:
        self.config = SimpleNamespace(log_level=0)
        self.started = 0
        self.cuda = cuda

    def init(self) -> None:
        assert self.config.log_level == self.LOG_ERROR
        self.started += 1
        os.write(2, b"no driver\n")

    def is_cuda_available(self) -> bool:
        assert self.started
        return self.cuda


@pytest.fixture
def warp(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeWarp]:
    fake = FakeWarp()
    monkeypatch.setitem(sys.modules, "warp", fake)
    start_warp_quietly.cache_clear()  # Warp is started once a process; here another test may have started the real one
    yield fake
    start_warp_quietly.cache_clear()


def has_driver(monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    monkeypatch.setattr(machine, "cuda_driver", lambda: there)


def test_the_driver_is_asked_for_by_its_library(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr("ctypes.CDLL", asked.append)
    assert cuda_driver() is True
    assert asked == ["libcuda.so.1"]

    def absent(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr("ctypes.CDLL", absent)
    assert cuda_driver() is False


def test_without_a_driver_warp_starts_without_a_word(
    warp: FakeWarp, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    has_driver(monkeypatch, False)
    before = open_files()
    start_warp_quietly()
    assert warp.started == 1
    assert open_files() == before, "nothing is left open"
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "afterwards\n"


def test_with_a_driver_what_warp_says_is_shown(
    warp: FakeWarp, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    has_driver(monkeypatch, True)
    start_warp_quietly()
    assert warp.started == 1
    assert capfd.readouterr().err == "no driver\n"


@pytest.mark.parametrize(
    ("wanted", "driver", "cuda", "found"),
    [
        ("cpu", True, True, "cpu"),
        ("auto", True, True, "cuda"),
        ("cuda", True, True, "cuda"),
        ("auto", False, True, "cpu"),
        ("auto", True, False, "cpu"),
    ],
)
def test_the_device_that_is_there_is_picked(
    warp: FakeWarp, monkeypatch: pytest.MonkeyPatch, wanted: str, driver: bool, cuda: bool, found: str
) -> None:
    has_driver(monkeypatch, driver)
    warp.cuda = cuda
    assert pick_device(wanted) == found
    assert warp.started == (wanted != "cpu" and driver), "Warp is not loaded for nothing"


def test_a_device_that_cannot_be_had_is_one_line(warp: FakeWarp, monkeypatch: pytest.MonkeyPatch) -> None:
    for driver in (False, True):
        has_driver(monkeypatch, driver)
        with pytest.raises(ConfigError, match="--device cuda: no CUDA device is usable"):
            pick_device("cuda")
    with pytest.raises(ConfigError, match="--device tpu: expected auto, cpu or cuda"):
        pick_device("tpu")


def test_one_worker_a_core_that_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0: {0, 2, 5}}[process], raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert default_workers() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert default_workers() == 8
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert default_workers() == 1


def test_versions_of_what_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "torch":
            raise machine.PackageNotFoundError
        return f"{name} 1"

    monkeypatch.setattr(machine, "version", version)
    found = versions("cuda")
    assert set(found) == {"ssad", "python", "device", "numpy", "warp-lang"}
    assert (found["device"], found["warp-lang"]) == ("cuda", "warp-lang 1")
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))


def test_visible_gpus_follow_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-ab12")
    assert visible_gpus() == ["2", "GPU-ab12"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert visible_gpus() == []
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr("warp.get_cuda_device_count", lambda: 3)
    assert visible_gpus() == ["0", "1", "2"]


@pytest.mark.parametrize(
    ("memory", "workers"),
    [((), 0), ((80,), 14), ((60,), 14), ((55,), 13), ((9,), 2), ((2,), 1), ((24, 80), 6 + 14), ((24, 80, 9), 22)],
)
def test_gpus_are_shared_by_as_many_as_their_memory_takes(
    monkeypatch: pytest.MonkeyPatch, memory: tuple[int, ...], workers: int
) -> None:
    devices = [SimpleNamespace(total_memory=size * GIB) for size in memory]
    monkeypatch.setattr("warp.get_cuda_devices", lambda: devices)
    assert gpu_workers(len(memory)) == workers


HELD = """
import ctypes
import numpy as np
from ssad.core.machine import retain_freed_memory

class Mallinfo(ctypes.Structure):  # struct mallinfo2 of <malloc.h>
    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")]

library = ctypes.CDLL(None)
library.mallinfo2.restype = Mallinfo


def hold():
    tensor = np.empty(10 << 20, np.float32)  # 40 MiB, from the allocator that tensors on the CPU are from
    lent = library.mallinfo2().hblkhd
    del tensor
    print(lent, library.mallinfo2().fordblks)


hold()
retain_freed_memory()
hold()
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="only glibc from 2.33 on tells what it holds")
def test_memory_is_kept_for_the_next_tensor() -> None:
    """What the C library itself says: what a kernel counts as page faults differs from machine to machine."""
    told = subprocess.run([sys.executable, "-c", HELD], capture_output=True, check=True, text=True).stdout
    for line, kept in zip(told.splitlines(), (False, True), strict=True):
        lent, free = (int(word) for word in line.split())
        assert (lent < 40 << 20) == kept  # taken from the system for this tensor alone, to be handed back with it
        assert (free >= 40 << 20) == kept


def test_other_libraries_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(machine.ctypes, "CDLL", lambda name: pytest.fail("there is no glibc to be told"))
    retain_freed_memory()
