"""Attacked images of an unfinished scene, stored on disk so that a stopped run loses one at most."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core import safeio
from ssad.core.errors import SSADError
from ssad.core.types import U8

FOLDER = "unfinished"


@dataclass(frozen=True, slots=True)
class SavedImages:
    """Images of one scene under one attack, a file each.

    Attributes:
        folder: folder of the files.
    """

    folder: Path

    def read(self, token: str) -> tuple[U8, dict[str, Any]] | None:
        """Return an image [H, W, 3] and the cost of its attack; None if the file is missing or broken.

        Args:
            token: Token of the camera frame.
        """
        path = self._path(token)
        if not path.is_file():
            return None
        try:
            stored = safeio.load_npz(path)
            return np.asarray(stored["picture"], np.uint8), dict(safeio.parse_json(str(stored["notes"])))
        # A broken file costs one attack: the image is simply made again.
        except (SSADError, KeyError, ValueError):
            return None

    def write(self, token: str, image: U8, notes: Mapping[str, Any]) -> None:
        """Store an image.

        Args:
            token: Token of the camera frame.
            image: [H, W, 3].
            notes: Cost of its attack, plain data.
        """
        columns = {"picture": image, "notes": np.array(safeio.dump_json(dict(notes)))}
        safeio.write_atomic(self._path(token), safeio.npz_bytes(columns))

    def forget(self) -> None:
        """Remove all images, and the parent folders if they are empty then: the scene is finished."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):
            self.folder.parent.rmdir()
            self.folder.parent.parent.rmdir()

    def _path(self, token: str) -> Path:
        return self.folder / f"{token}.npz"
