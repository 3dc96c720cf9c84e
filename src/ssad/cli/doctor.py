"""`ssad doctor`: what works on this machine, what is missing, and how to get it."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import ssad
from ssad.core.errors import EXTRA_OF, SSADError, install_extra
from ssad.core.safeio import home


@dataclass(frozen=True)
class Finding:
    """One check.

    Attributes:
        what: What is checked.
        state: ok, missing (some commands need it) or broken (no suite runs without it).
        detail: What was found.
    """

    what: str
    state: str
    detail: str


def examine() -> Iterator[Finding]:
    """Run the checks one by one."""
    ok = (3, 11) <= sys.version_info < (3, 14)
    python = f"{platform.python_version()} on {platform.platform(terse=True)}"
    yield Finding("python", "ok" if ok else "broken", python if ok else f"{python}; SSAD needs 3.11 to 3.13")
    yield Finding("ssad", "ok", ssad.__version__)
    yield _machine()
    yield from _warp()
    yield _torch()
    yield _carla()
    yield _home()
    yield from _towns()
    yield _suites()


def _machine() -> Finding:
    from ssad.core.machine import default_workers

    cores, memory = default_workers(), "memory unknown"
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB memory"
    disk = shutil.disk_usage(os.getcwd()).free / 2**30
    return Finding("machine", "ok", f"{cores} cores, {memory}, {disk:.1f} GiB free here")


def _warp() -> Iterator[Finding]:
    try:
        import warp

        from ssad.core.machine import quiet_warp

        quiet_warp()
        devices = ", ".join(f"{d.alias} ({d.name})" for d in warp.get_devices())
        yield Finding("warp", "ok", f"{version('warp-lang')}: {devices}")
        gpu = warp.is_cuda_available()
        yield Finding(
            "cuda", "ok" if gpu else "missing", "usable" if gpu else "no CUDA device found; everything runs on the CPU"
        )
    except Exception as error:
        yield Finding("warp", "broken", f"{type(error).__name__}: {error}; reinstall the package warp-lang")


def _torch() -> Finding:
    try:
        import torch
        import torchvision
    except Exception as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name in EXTRA_OF
        why = "not installed" if missing else f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Finding(
            "perception",
            "missing",
            f"{why}; detectors, attacks and learned drivers need torch and torchvision; {install_extra('perception')}",
        )
    gpu = "with CUDA" if torch.cuda.is_available() else "on the CPU"
    return Finding("perception", "ok", f"torch {torch.__version__} {gpu}, torchvision {torchvision.__version__}")


def _carla() -> Finding:
    if importlib.util.find_spec("carla") is None:
        why = f"`ssad import map` needs it, and Python 3.11 or 3.12; {install_extra('carla')}"
        return Finding("carla", "missing", why)
    try:
        return Finding("carla", "ok", f"{version('carla')}: `ssad import map` works")
    except PackageNotFoundError:
        return Finding("carla", "ok", "`ssad import map` works")


def _home() -> Finding:
    folder = home()
    near = folder
    while not near.exists() and near != near.parent:
        near = near.parent
    if not os.access(near, os.W_OK):
        return Finding(
            "SSAD_HOME",
            "missing",
            f"{folder}: not writable, so nothing can be imported; set SSAD_HOME to another folder",
        )
    return Finding("SSAD_HOME", "ok", f"{folder}{'' if folder.exists() else ' (created when first needed)'}")


def _towns() -> Iterator[Finding]:
    from ssad.world.roads import load_town, town_names

    good, bad = [], []
    for name, where in town_names().items():
        try:
            load_town(name)
            good.append(name)
        except (SSADError, OSError) as error:
            built_in = where == "built-in"
            bad.append(Finding(f"town {name}", "broken" if built_in else "missing", str(error)))
    yield Finding("towns", "ok" if good else "broken", ", ".join(good) or "no town can be read; reinstall SSAD")
    yield from bad


def _suites() -> Finding:
    from ssad.experiments.suites import suite_files

    found = ", ".join(suite_files())
    return Finding("suites", "ok" if found else "broken", found or "no suite found; reinstall SSAD")
