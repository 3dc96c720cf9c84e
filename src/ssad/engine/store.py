"""The results folder: append-only, safe against kill -9, without lost, duplicate or changed lines.

DIR/run.json describes the run; DIR/episodes.jsonl and DIR/results.jsonl get one line per cell, the latter last: a
cell is finished when its line in results.jsonl is complete. A truncated line is dropped on the next start; failed
cells are removed when they are retried. Each line has a seal, and DIR/seal.json counts the lines
(`ssad.core.run_records`).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ssad.core import safeio
from ssad.core.errors import StoreError
from ssad.core.folders import RUN_FILE, check_output_folder, check_tree, open_inside, path_inside
from ssad.core.run_records import COUNTS, EPISODES, RESULTS, counts_text, read_records
from ssad.core.seals import sealed

RUN, LOCK = RUN_FILE, ".lock"

Retry = bool | Collection[str]  # whether all failed cells are retried, or the keys of those that are


def read_run(folder: str | Path) -> dict[str, Any]:
    """Return run.json of a results folder. StoreError if the folder holds no run."""
    path = path_inside(folder, RUN)
    if not path.is_file():
        raise StoreError(f"{folder}: not a results folder (it has no {RUN}); make one with: ssad run SUITE --out DIR")
    content = safeio.read_json(path)
    if not isinstance(content, dict) or "identity" not in content:
        raise StoreError(f"{path}: not written by ssad run")
    return content


class Store:
    """A results folder, held by one process (`with Store.open(...) as store`)."""

    def __init__(self, folder: Path, lock: int) -> None:
        self.folder = folder
        self._lock = lock
        self._files: dict[str, int] = {}
        self._counts = {RESULTS: 0, EPISODES: 0}
        self._is_sealed = True
        self.results: dict[str, dict[str, Any]] = {}
        self.retried: frozenset[str] = frozenset()

    @classmethod
    def open(
        cls, folder: str | Path, run: Mapping[str, Any], *, retry: Retry = False, command: str = "ssad run"
    ) -> Self:
        """Take the folder for this run: a new one, or one of the same run that is resumed.

        Args:
            folder: The folder.
            run: What run.json shall say; its "identity" must equal that of a run already there.
            retry: Whether cells that failed, or those of these keys, are treated as if they had never run.
            command: The command, for messages.

        Raises:
            StoreError: The folder cannot be written, is in use, belongs to another run or holds something else, or a
                link in it leads out of it; nothing is changed then.
        """
        path = Path(folder)
        _check_content(path, run, command)
        safeio.make_folder(path)
        store = cls(path, _lock(path, command))
        try:
            _check_content(path, run, command)  # again: another process may have begun meanwhile
            store._begin(run, retry=retry)
        except BaseException:
            store.close()
            raise
        return store

    def _begin(self, run: Mapping[str, Any], *, retry: Retry) -> None:
        if not (self.folder / RUN).exists():
            content = safeio.dump_json({**run, "sealed": True}, indent=1)
            safeio.write_atomic(self.folder / RUN, content + "\n")
        records = read_records(self.folder, read_run(self.folder))
        failed = frozenset(record["key"] for record in records.results if _failed(record))
        self.retried = failed.intersection(failed if retry is True else retry or ())
        self.results = {record["key"]: record for record in records.results if record["key"] not in self.retried}
        episodes = {key: episode for key, episode in records.episodes.items() if key in self.results}
        # Folders from before there were seals stay without them: nobody knows what their lines were.
        self._is_sealed = records.sealed
        self._counts = {RESULTS: len(self.results), EPISODES: len(episodes)}
        if self._is_sealed:
            # Before the files get shorter: lines that are counted and not there would count as removed.
            safeio.write_atomic(self.folder / COUNTS, counts_text(self._counts))
            self._files[COUNTS] = open_inside(self.folder, COUNTS, os.O_RDWR)
        if self.retried or not records.whole:
            # A kill may leave half a line, and the next line would be appended to it.
            for name, kept_records in ((RESULTS, self.results), (EPISODES, episodes)):
                lines = [
                    self._line(record, number, episodes.get(record["key"]) if name == RESULTS else None)
                    for number, record in enumerate(kept_records.values(), 1)
                ]
                safeio.write_atomic(self.folder / name, "".join(lines))
        for name in (RESULTS, EPISODES):
            self._files[name] = open_inside(self.folder, name, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def append(self, result: Mapping[str, Any], episode: Mapping[str, Any] | None) -> None:
        """Add a finished cell; the record is durable when this returns.

        Args:
            result: The record.
            episode: Line for episodes.jsonl, if there is one.

        Raises:
            ValueError: The store already has a record with this key.
        """
        key = str(result["key"])
        if key in self.results:
            raise ValueError(f"cell {key} is already in the store")
        # The result goes last: it marks the cell as finished, so its episode must already be there.
        if episode is not None:
            self._write(EPISODES, episode)
        self._write(RESULTS, result, episode)
        if self._is_sealed:
            # In place and not flushed: a count that lags behind the lines is legal, and the next one mends it.
            os.pwrite(self._files[COUNTS], counts_text(self._counts).encode(), 0)
        self.results[key] = dict(result)

    def _line(self, record: Mapping[str, Any], number: int, episode: Mapping[str, Any] | None = None) -> str:
        """Return the line of a record, with its seal if the folder has seals."""
        line_content = sealed(record, number, episode=episode) if self._is_sealed else dict(record)
        return safeio.dump_json(line_content) + "\n"

    def _write(self, name: str, record: Mapping[str, Any], episode: Mapping[str, Any] | None = None) -> None:
        encoded = self._line(record, self._counts[name] + 1, episode).encode()
        try:
            written = os.write(self._files[name], encoded)
            while written < len(encoded):  # a full disk or a signal can cut a write short
                written += os.write(self._files[name], encoded[written:])
            os.fsync(self._files[name])
        except OSError as error:
            path = self.folder / name
            raise StoreError(f"{path}: cannot be written: {error.strerror}; make room and run again") from None
        self._counts[name] += 1

    def close(self) -> None:
        """Close the files and release the lock."""
        for descriptor in (*self._files.values(), self._lock):
            os.close(descriptor)
        self._files, self._lock = {}, -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _failed(record: Mapping[str, Any]) -> bool:
    return bool(record.get("status", "ok") != "ok")


def _check_content(folder: Path, run: Mapping[str, Any], command: str) -> None:
    """Refuse a folder that belongs to something else."""
    option = "--out" if command == "ssad run" else "OUT"
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder}: is a file; choose a folder with {option}")
    if not (folder / RUN).exists():
        if (folder / RESULTS).exists():
            raise StoreError(f"{folder}: has {RESULTS} but no {RUN}; choose another folder with --out")
        check_output_folder(folder, (), option=option)
        return
    if command == "ssad run":  # shifted folders have links to the data that they are made of
        check_tree(folder)
    existing = read_run(folder)
    if existing["identity"] == run["identity"]:
        return
    old_suite, new_suite = existing.get("suite", {}), run.get("suite", {})
    changed_keys = sorted(key for key in {*old_suite, *new_suite} if old_suite.get(key) != new_suite.get(key)) or [
        "the code, a system or a town"
    ]
    raise StoreError(
        f"{folder}: holds another run (suite {old_suite.get('name')}; differs in {', '.join(changed_keys)}); "
        f"choose another folder{' with --out' if command == 'ssad run' else ''} or remove this one"
    )


def _lock(folder: Path, command: str = "ssad run") -> int:
    """The descriptor of a lock file that only one process may hold. StoreError: another one does."""
    path = folder / LOCK
    descriptor = open_inside(folder, LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise StoreError(
            f"{folder}: another {command} is writing there; wait for its end or choose another folder"
        ) from None
    except OSError as error:
        os.close(descriptor)
        raise StoreError(f"{path}: cannot be locked: {error.strerror or error}") from None
    return descriptor


@contextlib.contextmanager
def locked(folder: Path, command: str) -> Iterator[None]:
    """The folder, made if need be, for this process alone while the block lasts.

    Args:
        folder: to be written.
        command: the command, for the message.

    Raises:
        StoreError: another process has it.
    """
    descriptor = _lock(safeio.make_folder(folder), command)
    try:
        yield
    finally:
        os.close(descriptor)
