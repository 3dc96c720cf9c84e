"""A JSON table as a stream of typed records: memory is that of a block, whatever the size of the file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import msgspec

from ssad.core.errors import FormatError

BLOCK = 4 << 20
LIMIT = 16 * BLOCK  # no record is longer
_SPACE = b" \t\r\n"

T = TypeVar("T")


def stream(path: Path, kind: type[T], *, block: int = BLOCK) -> Iterator[list[T]]:
    """The elements of a JSON array of objects, some at a time, in order.

    A block is cut after its last complete element. A cut inside a string would leave it open, which does not decode,
    so that a wrong cut cannot pass. FormatError names file and line.
    """
    decoder = msgspec.json.Decoder(list[kind])  # type: ignore[valid-type]
    line, opened = 1, False
    rest = b""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    with file:
        while True:
            data = file.read(block)
            text = rest + data
            if not opened:
                if not text.lstrip(_SPACE) and data:
                    rest = text
                    continue
                if text.lstrip(_SPACE)[:1] != b"[":
                    raise FormatError(f"{path}:1: expected a JSON list of records")
                start = text.index(b"[") + 1
                line += text.count(b"\n", 0, start)
                text, opened = text[start:], True
            if not data:
                yield _last(path, decoder, text, line)
                return
            cut = text.rfind(b"}") + 1
            if cut == 0:
                rest = text
                continue
            body = text[:cut].lstrip(_SPACE + b",") if text.lstrip(_SPACE)[:1] == b"," else text[:cut]
            try:
                found = decoder.decode(b"[" + body + b"]")
            except msgspec.MsgspecError:
                # cut inside a string or an inner object, or broken: more text decides, the end at the latest
                if len(text) > LIMIT:
                    raise _error(path, decoder, text, line) from None
                rest = text
                continue
            line += text.count(b"\n", 0, cut)
            rest = text[cut:]
            yield found


def _last(path: Path, decoder: msgspec.json.Decoder[list[T]], text: bytes, line: int) -> list[T]:
    """What stands between the last cut and the end of the list."""
    body = text.lstrip(_SPACE)
    if body[:1] == b",":
        body = body[1:]
        if not body.lstrip(_SPACE).startswith(b"{"):
            raise FormatError(f"{path}:{line}: not valid JSON: a record is missing after the comma")
    try:
        return decoder.decode(b"[" + body)
    except msgspec.MsgspecError:
        raise _error(path, decoder, text, line) from None


def _error(path: Path, decoder: msgspec.json.Decoder[list[T]], text: bytes, line: int) -> FormatError:
    """Which record is wrong, and how: the elements are decoded one by one."""
    raws: list[msgspec.Raw]
    body = text.lstrip(_SPACE).removeprefix(b",")
    try:
        raws = msgspec.json.decode(b"[" + body, type=list[msgspec.Raw])
    except msgspec.MsgspecError as error:
        why = str(error)
        where = line
        if "byte " in why:
            position = int("".join(c for c in why.rsplit("byte ", 1)[1] if c.isdigit()) or 0)
            where += (text[: len(text) - len(body)] + body[:position]).count(b"\n")
        truncated = "truncated" in why
        return FormatError(f"{path}:{where}: not valid JSON: {'the file ends too early' if truncated else why}")
    place = 0
    for raw in raws:
        piece = bytes(raw)
        place = text.find(piece, place)
        try:
            decoder.decode(b"[" + piece + b"]")
        except msgspec.MsgspecError as error:
            where = line + text.count(b"\n", 0, place)
            return FormatError(f"{path}:{where}: {str(error).replace('$[...]', 'record')}")
        place += len(piece)
    return FormatError(f"{path}:{line}: not a list of records")


def table_path(root: Path, version: str, name: str) -> Path:
    """File of a table, such as ROOT/v1.0-mini/sample.json."""
    return root / version / f"{name}.json"
