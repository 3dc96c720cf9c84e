"""`ssad doctor`: working and missing parts of this machine, and how to install the missing ones."""

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
from ssad.core.safeio import home_folder


@dataclass(frozen=True)
class Finding:
    """One check.

    Attributes:
        name: Name of the check.
        state: ok, missing (some commands need it) or broken (no suite runs without it).
        detail: Result in words.
    """

    name: str
    state: str
    detail: str


def examine() -> Iterator[Finding]:
    """Run the checks one by one."""
    is_supported = (3, 11) <= sys.version_info < (3, 14)
    python = f"{platform.python_version()} on {platform.platform(terse=True)}"
    yield Finding(
        "python", "ok" if is_supported else "broken", python if is_supported else f"{python}; SSAD needs 3.11 to 3.13"
    )
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

    core_count, memory = default_workers(), "memory unknown"
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB memory"
    free_disk = shutil.disk_usage(os.getcwd()).free / 2**30
    return Finding("machine", "ok", f"{core_count} cores, {memory}, {free_disk:.1f} GiB free here")


def _warp() -> Iterator[Finding]:
    try:
        import warp

        from ssad.core.machine import start_warp_quietly

        start_warp_quietly()
        devices = ", ".join(f"{device.alias} ({device.name})" for device in warp.get_devices())
        yield Finding("warp", "ok", f"{version('warp-lang')}: {devices}")
        has_cuda = warp.is_cuda_available()
        yield Finding(
            "cuda",
            "ok" if has_cuda else "missing",
            "usable" if has_cuda else "no CUDA device found; everything runs on the CPU",
        )
    # Whatever an import of a broken installation raises is a finding, not a crash of the doctor.
    except Exception as error:
        yield Finding("warp", "broken", f"{type(error).__name__}: {error}; reinstall the package warp-lang")


def _torch() -> Finding:
    try:
        import torch
        import torchvision
    except Exception as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name in EXTRA_OF
        problem = "not installed" if missing else f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Finding(
            "perception",
            "missing",
            f"{problem}; detectors, attacks and learned drivers need torch and torchvision; "
            f"{install_extra('perception')}",
        )
    processor = "with CUDA" if torch.cuda.is_available() else "on the CPU"
    return Finding("perception", "ok", f"torch {torch.__version__} {processor}, torchvision {torchvision.__version__}")


def _carla() -> Finding:
    if importlib.util.find_spec("carla") is None:
        problem = f"CARLA as the simulator needs it, and Python 3.11 or 3.12; {install_extra('carla')}"
        return Finding("carla", "missing", problem)
    try:
        return Finding("carla", "ok", f"{version('carla')}: CARLA can be the simulator")
    except PackageNotFoundError:
        return Finding("carla", "ok", "CARLA can be the simulator")


def _home() -> Finding:
    folder = home_folder()
    existing_folder = folder
    # The folder is created on first use: the nearest existing parent decides whether it can be.
    while not existing_folder.exists() and existing_folder != existing_folder.parent:
        existing_folder = existing_folder.parent
    if not os.access(existing_folder, os.W_OK):
        return Finding(
            "SSAD_HOME",
            "missing",
            f"{folder}: not writable, so nothing can be imported; set SSAD_HOME to another folder",
        )
    return Finding("SSAD_HOME", "ok", f"{folder}{'' if folder.exists() else ' (created when first needed)'}")


def _towns() -> Iterator[Finding]:
    from ssad.world.roads import load_town, town_names

    readable, problems = [], []
    for name, origin in town_names().items():
        try:
            load_town(name)
            readable.append(name)
        except (SSADError, OSError) as error:
            built_in = origin == "built-in"
            problems.append(Finding(f"town {name}", "broken" if built_in else "missing", str(error)))
    yield Finding("towns", "ok" if readable else "broken", ", ".join(readable) or "no town can be read; reinstall SSAD")
    yield from problems


def _suites() -> Finding:
    from ssad.experiments.suites import suite_files

    suite_names = ", ".join(suite_files())
    return Finding("suites", "ok" if suite_names else "broken", suite_names or "no suite found; reinstall SSAD")
