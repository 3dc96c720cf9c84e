"""What tests share: folders that are made once a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

Shared = Callable[[str, Callable[[Path], object]], Path]
