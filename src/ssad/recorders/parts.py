"""Resumable folder of the parts of a recording.

A recording consists of parts, which any number of processes make. OUT/.parts/recording.json is the request: the
settings that decide the bytes of the recording. OUT/.parts/NAME belongs to one part; its page, part.json, is
written last, so a part with a page is finished and a part without one was interrupted and is made again. The
recorder builds the files for users from the pages when all parts are finished.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError
from ssad.core.folders import check_links_above
from ssad.engine.store import locked

FOLDER: Final = ".parts"
REQUEST: Final = "recording.json"
PAGE: Final = "part.json"
TIME_LIMIT: Final = 7200.0  # s for a part


@dataclass(frozen=True, slots=True)
class PartsFolder:
    """Parts of one recording.

    Attributes:
        out: Folder of the recording.
        request: Settings that decide its bytes, as plain data.
    """

    out: Path
    request: Mapping[str, Any]

    @property
    def is_claimed(self) -> bool:
        """True if the folder holds a request."""
        return (self.out / FOLDER / REQUEST).is_file()

    def claim(self) -> None:
        """Write the request, or compare it with that of the folder.

        Raises:
            StoreError: The folder holds another recording, or cannot be written.
        """
        claim(self.out / FOLDER / REQUEST, self.request, f"{self.out}: holds another recording; choose another folder")

    @contextlib.contextmanager
    def lock(self, command: str) -> Iterator[None]:
        """Hold the claimed folder for this process.

        Args:
            command: The command that writes, for messages.

        Raises:
            StoreError: Another process holds it; see also `claim`.
        """
        with locked(self.out, command):
            self.claim()
            yield

    def is_finished(self, name: str) -> bool:
        """Return whether a part has its page."""
        return (self.part(name) / PAGE).is_file()

    def part(self, name: str) -> Path:
        """Return the folder of a part."""
        return self.out / FOLDER / name

    def begin(self, name: str) -> Path:
        """Remove what an interrupted run left of a part, and return its folder."""
        folder = self.part(name)
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    def finish(self, name: str, page: Mapping[str, Any]) -> None:
        """Write the page of a part, all of whose files are there.

        Raises:
            StoreError: The page cannot be written.
        """
        safeio.write_atomic(self.part(name) / PAGE, safeio.dump_json(dict(page)) + "\n")

    def page(self, name: str) -> dict[str, Any]:
        """Read the page of a finished part.

        Raises:
            FormatError: There is none, or it is damaged.
        """
        path = self.part(name) / PAGE
        content = safeio.read_json(path)
        if not isinstance(content, dict):
            raise FormatError(f"{path}: not the page of a part; remove its folder and record again")
        return content


def claim(path: Path, request: Mapping[str, Any], refusal: str) -> None:
    """Write a request to a file, or compare it with that in the file.

    Args:
        path: The file.
        request: Plain data.
        refusal: Message of the error.

    Raises:
        StoreError: The file holds another request or is damaged, it cannot be written, or its folder is a link.
    """
    check_links_above(path, root=path.parent.parent)
    safeio.make_folder(path.parent)
    if not path.exists():
        safeio.write_atomic(path, safeio.dump_json(dict(request), indent=1) + "\n")
        return
    try:
        content = safeio.read_json(path)
    except FormatError:
        raise StoreError(refusal) from None
    if not is_same_request(content, request):
        raise StoreError(refusal)


def is_same_request(content: Any, request: Mapping[str, Any]) -> bool:
    """Return whether the content of a file is a request, which may hold tuples in place of lists."""
    return bool(content == safeio.parse_json(safeio.dump_json(dict(request))))
