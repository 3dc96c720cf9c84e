"""Packages that some tests compare SSAD with, and that continuous integration must have."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

import pytest


def import_or_skip(name: str, how: str) -> ModuleType:
    """Import a module. Absent: skip, or fail under SSAD_CI=1 so that nothing skips unseen; `how` says how to get it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        reason = f"no module {name}: {how}"
        if os.environ.get("SSAD_CI") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
