"""Look-up of nuScenes rows by token and by parent, for tables of any size.

A small version is held in memory. A large one is indexed once into an SQLite file,
$SSAD_HOME/cache/nuscenes/<digest>.sqlite, which every later process opens read-only; the digest covers the folder
and the size and modification time of all tables, so that a changed table is indexed anew.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import msgspec

from ssad.core.errors import FormatError, StoreError
from ssad.core.safeio import atomic_path, home_folder
from ssad.core.seeding import digest
from ssad.datasets.nuscenes.schema import TABLES, TableRecord
from ssad.datasets.nuscenes.tables import stream, table_path

MEMORY_LIMIT_BYTES = 32 << 20  # size of all tables, bytes; below it an index in memory is faster than a file
LAYOUT = 1
PARENT: Final = {"sample": "scene_token", "sample_data": "sample_token", "sample_annotation": "sample_token"}
_NAME: Final = {kind: name for name, kind in TABLES.items()}
_BATCH = 500

R = TypeVar("R", bound=TableRecord)


class Index(Protocol):
    """Index of a version; the rows of a table, or of one parent, come in table order."""

    def rows(self, kind: type[R]) -> list[R]:
        """Return all rows of a table."""

    def get(self, kind: type[R], tokens: Iterable[str]) -> dict[str, R]:
        """Return rows by token; absent tokens are left out."""

    def children(self, kind: type[R], parents: Sequence[str]) -> list[R]:
        """Rows whose parent (`PARENT`) is one of the given tokens."""

    def close(self) -> None:
        """Release open resources; a later call opens them again."""


def fingerprint(root: Path, version: str) -> tuple[tuple[str, int, int], ...]:
    """Return name, size and modification time (ns) of every table. FormatError if one is missing."""
    states = []
    for name in TABLES:
        path = table_path(root, version, name)
        try:
            stat = path.stat()
        except FileNotFoundError:
            raise FormatError(f"{path}: no such file; a nuScenes version has {len(TABLES)} tables") from None
        except OSError as error:
            raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
        states.append((name, stat.st_size, stat.st_mtime_ns))
    return tuple(states)


def open_index(root: Path, version: str, *, memory_limit_bytes: int | None = None) -> Index:
    """The index of a version folder, built where there is none yet.

    Args:
        root: The nuScenes root.
        version: Name of the version.
        memory_limit_bytes: Bytes of all tables below which the index is held in memory; None: `MEMORY_LIMIT_BYTES`.

    Raises:
        FormatError: The tables are broken, or changed while they were indexed.
        StoreError: The index cannot be written.
    """
    table_state = fingerprint(root, version)
    if sum(size for _, size, _ in table_state) < (
        MEMORY_LIMIT_BYTES if memory_limit_bytes is None else memory_limit_bytes
    ):
        return MemoryIndex(root, version)
    folder_digest = digest(str((root / version).resolve()))[:16]
    folder = home_folder() / "cache" / "nuscenes"
    path = folder / f"{folder_digest}{digest(LAYOUT, table_state)[:16]}.sqlite"
    if not path.exists():
        build(path, root, version)
        if fingerprint(root, version) != table_state:
            path.unlink(missing_ok=True)
            raise FormatError(f"{root / version}: a table changed while it was indexed; try again")
        for outdated in folder.glob(f"{folder_digest}*.sqlite"):  # indexes of the same folder before its tables changed
            if outdated != path:
                with contextlib.suppress(OSError):
                    outdated.unlink()
    return FileIndex(path)


def build(path: Path, root: Path, version: str) -> None:
    """Write the index file, atomically; only one block of a table is in memory at a time.

    Args:
        path: The index file.
        root: The nuScenes root.
        version: Name of the version.

    Raises:
        FormatError: The tables are broken.
        StoreError: The file cannot be written.
    """
    advice = "set SSAD_HOME to a folder that can be written and has room"
    try:
        with atomic_path(path) as temporary:
            connection = sqlite3.connect(temporary, isolation_level=None)
            try:
                _fill_index(connection, root, version)
            finally:
                connection.close()
    except StoreError as error:
        raise StoreError(f"{error}; {advice}") from None
    except sqlite3.Error as error:
        raise StoreError(f"{path}: the index cannot be written: {error}; {advice}") from None


def _fill_index(connection: sqlite3.Connection, root: Path, version: str) -> None:
    # No journal: the file is temporary until complete, so an interrupted one is simply discarded.
    for setting in ("journal_mode=OFF", "synchronous=OFF", "locking_mode=EXCLUSIVE", "page_size=8192"):
        connection.execute(f"PRAGMA {setting}")
    connection.execute("BEGIN")
    for name in TABLES:
        connection.execute(f"CREATE TABLE {name} (token, parent, body BLOB)")
        connection.executemany(f"INSERT INTO {name} VALUES (?, ?, ?)", _packed_rows(root, version, name))
        try:
            connection.execute(f"CREATE UNIQUE INDEX {name}_token ON {name} (token)")
        except sqlite3.IntegrityError:
            query = f"SELECT token FROM {name} GROUP BY token HAVING count(*) > 1 LIMIT 1"
            key = connection.execute(query).fetchone()[0]
            raise _duplicate_token_error(table_path(root, version, name), _unpack_key(key)) from None
        if name in PARENT:
            connection.execute(f"CREATE INDEX {name}_parent ON {name} (parent)")
    connection.execute(f"PRAGMA user_version={LAYOUT}")
    connection.execute("COMMIT")


def _packed_rows(root: Path, version: str, name: str) -> Iterator[tuple[bytes | str, bytes | str | None, bytes]]:
    encode = msgspec.msgpack.Encoder().encode
    parent_field = PARENT.get(name)
    for block in stream(table_path(root, version, name), TABLES[name]):
        for record in block:
            parent_key = None if parent_field is None else _key(getattr(record, parent_field))
            yield _key(record.token), parent_key, encode(msgspec.structs.astuple(record))


def _key(token: str) -> bytes | str:
    """Return a token as it is stored: 32 hexadecimal digits as 16 bytes, other text unchanged."""
    if len(token) == 32 and token.isascii() and token.isalnum() and token == token.lower():
        with contextlib.suppress(ValueError):
            return bytes.fromhex(token)
    return token


def _unpack_key(key: bytes | str) -> str:
    return key.hex() if isinstance(key, bytes) else key


def _duplicate_token_error(path: Path, token: str) -> FormatError:
    return FormatError(f"{path}: two records have the token '{token}'")


@cache
def _decoder(kind: type[TableRecord]) -> Any:
    """Return a typed decoder of a row as a list of its fields."""
    fields = tuple(field.type for field in msgspec.structs.fields(kind))
    # A row is stored as a tuple, which saves the names of its fields; the types restore it exactly.
    return msgspec.msgpack.Decoder(tuple.__class_getitem__(fields))


class MemoryIndex:
    """An index of dictionaries."""

    def __init__(self, root: Path, version: str) -> None:
        self._rows: dict[str, dict[str, TableRecord]] = {}
        self._children: dict[str, dict[str, list[TableRecord]]] = {name: {} for name in PARENT}
        for name, kind in TABLES.items():
            path = table_path(root, version, name)
            table: dict[str, TableRecord] = {}
            parent_field, rows_by_parent = PARENT.get(name), self._children.get(name, {})
            for block in stream(path, kind):
                for record in block:
                    if table.setdefault(record.token, record) is not record:
                        raise _duplicate_token_error(path, record.token)
                    if parent_field is not None:
                        rows_by_parent.setdefault(getattr(record, parent_field), []).append(record)
            self._rows[name] = table

    def rows(self, kind: type[R]) -> list[R]:
        """Return all rows of a table."""
        return list(self._table(kind).values())

    def get(self, kind: type[R], tokens: Iterable[str]) -> dict[str, R]:
        """Return rows by token; absent tokens are left out."""
        table = self._table(kind)
        return {token: table[token] for token in tokens if token in table}

    def children(self, kind: type[R], parents: Sequence[str]) -> list[R]:
        """Rows whose parent (`PARENT`) is one of the given tokens, parent by parent."""
        rows_by_parent: Any = self._children[_NAME[kind]]
        return [row for parent in dict.fromkeys(parents) for row in rows_by_parent.get(parent, ())]

    def close(self) -> None:
        """Do nothing: no resources are open."""

    def _table(self, kind: type[R]) -> dict[str, R]:
        table: Any = self._rows[_NAME[kind]]
        return table  # type: ignore[no-any-return]


class FileIndex:
    """An index in an SQLite file; each process and thread opens it for itself, so that it survives a fork."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._local = threading.local()

    def rows(self, kind: type[R]) -> list[R]:
        """Return all rows of a table. StoreError if the file cannot be read."""
        return [self._row(kind, body) for (body,) in self._query(f"SELECT body FROM {_NAME[kind]} ORDER BY rowid", ())]

    def get(self, kind: type[R], tokens: Iterable[str]) -> dict[str, R]:
        """Return rows by token; absent tokens are left out. StoreError if the file cannot be read."""
        rows = self._rows_where(kind, "token", list(dict.fromkeys(tokens)))
        return {row.token: row for row in rows}

    def children(self, kind: type[R], parents: Sequence[str]) -> list[R]:
        """Rows whose parent (`PARENT`) is one of the given tokens. Raises StoreError when the file cannot be read."""
        return self._rows_where(kind, "parent", list(dict.fromkeys(parents)))

    def close(self) -> None:
        """Close this thread's connection; the next query opens a new one."""
        connection = getattr(self._local, "connection", None)
        if connection is not None:
            connection.close()
            del self._local.connection

    def __del__(self) -> None:
        self.close()

    def _rows_where(self, kind: type[R], column: str, tokens: list[str]) -> list[R]:
        rows: list[tuple[int, bytes]] = []
        for start in range(0, len(tokens), _BATCH):
            keys = [_key(token) for token in tokens[start : start + _BATCH]]
            placeholders = ",".join("?" * len(keys))
            rows += self._query(f"SELECT rowid, body FROM {_NAME[kind]} WHERE {column} IN ({placeholders})", keys)
        # By row id, which is the table order.
        rows.sort()
        return [self._row(kind, body) for _, body in rows]

    def _row(self, kind: type[R], body: bytes) -> R:
        return kind(*_decoder(kind).decode(body))

    def _query(self, query: str, values: Sequence[bytes | str]) -> list[Any]:
        try:
            return self._connection().execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}: the index cannot be read: {error}; delete the file and try again") from None

    def _connection(self) -> sqlite3.Connection:
        # SQLite connections must not be carried across a fork.
        if getattr(self._local, "pid", None) != os.getpid():
            self.close()
            uri = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
            self._local.connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
            self._local.pid = os.getpid()
        connection: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if connection is None:
            self._local.pid = None
            return self._connection()
        return connection
