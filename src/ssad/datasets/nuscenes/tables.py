"""A JSON table as a stream of typed records: memory is that of one block, whatever the size of the file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import msgspec

from ssad.core.errors import FormatError, StoreError
from ssad.core.folders import data_path
from ssad.core.safeio import read_json

SHIFT_IDENTITY = "manifest/identity.json"  # of a shifted root
BLOCK = 4 << 20
LIMIT = 16 * BLOCK  # largest undecoded text, bytes: no record is longer
_SPACE = b" \t\r\n"
BROKEN = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)  # what msgspec raises for a broken text

T = TypeVar("T")


def stream(path: Path, kind: type[T], *, block: int = BLOCK) -> Iterator[list[T]]:
    """Yield the elements of a JSON array of objects, in order, a list of them per block.

    A block is cut after its last complete element. A cut inside a string would leave it open, which does not
    decode, so that a wrong cut cannot pass. FormatError names file and line.
    """
    decoder = msgspec.json.Decoder(list[kind])  # type: ignore[valid-type]
    line_number, opened = 1, False
    remainder = b""
    try:
        source = path.open("rb")
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    with source:
        while True:
            chunk = source.read(block)
            text = remainder + chunk
            if not opened:
                if not text.lstrip(_SPACE) and chunk:
                    remainder = text
                    continue
                if text.lstrip(_SPACE)[:1] != b"[":
                    raise FormatError(f"{path}:1: expected a JSON list of records")
                list_start = text.index(b"[") + 1
                line_number += text.count(b"\n", 0, list_start)
                text, opened = text[list_start:], True
            if not chunk:
                yield _decode_rest(path, decoder, text, line_number)
                return
            # A closing brace may end a record: decoding decides.
            block_end = text.rfind(b"}") + 1
            if block_end == 0:
                remainder = text
                continue
            elements = text[:block_end].lstrip(_SPACE + b",") if text.lstrip(_SPACE)[:1] == b"," else text[:block_end]
            try:
                records = decoder.decode(b"[" + elements + b"]")
            except BROKEN:
                # cut inside a string or an inner object, or broken: more text decides, the end at the latest
                if len(text) > LIMIT:
                    raise _error(path, decoder, text, line_number) from None
                remainder = text
                continue
            line_number += text.count(b"\n", 0, block_end)
            remainder = text[block_end:]
            yield records


def _decode_rest(path: Path, decoder: msgspec.json.Decoder[list[T]], text: bytes, line: int) -> list[T]:
    """Decode the records between the last cut and the end of the list."""
    elements = text.lstrip(_SPACE)
    if elements[:1] == b",":
        elements = elements[1:]
        if not elements.lstrip(_SPACE).startswith(b"{"):
            raise FormatError(f"{path}:{line}: not valid JSON: a record is missing after the comma")
    try:
        return decoder.decode(b"[" + elements)
    except BROKEN:
        raise _error(path, decoder, text, line) from None


def _error(path: Path, decoder: msgspec.json.Decoder[list[T]], text: bytes, line: int) -> FormatError:
    """Make the error that names the wrong record, by decoding the elements one by one."""
    elements: list[msgspec.Raw]
    list_text = text.lstrip(_SPACE).removeprefix(b",")
    try:
        elements = msgspec.json.decode(b"[" + list_text, type=list[msgspec.Raw])
    except BROKEN as error:
        message = str(error)
        error_line = line
        if "byte " in message:
            byte_offset = int(
                "".join(character for character in message.rsplit("byte ", 1)[1] if character.isdigit()) or 0
            )
            error_line += (text[: len(text) - len(list_text)] + list_text[:byte_offset]).count(b"\n")
        truncated = "truncated" in message
        return FormatError(
            f"{path}:{error_line}: not valid JSON: {'the file ends too early' if truncated else message}"
        )
    offset = 0
    for element in elements:
        element_text = bytes(element)
        offset = text.find(element_text, offset)
        try:
            decoder.decode(b"[" + element_text + b"]")
        except BROKEN as error:
            error_line = line + text.count(b"\n", 0, offset)
            return FormatError(f"{path}:{error_line}: {str(error).replace('$[...]', 'record')}")
        offset += len(element_text)
    return FormatError(f"{path}:{line}: not a list of records")


def table_path(root: Path, version: str, name: str) -> Path:
    """Return the file of a table, such as ROOT/v1.0-mini/sample.json. StoreError if it leads out of the root."""
    return nuscenes_path(root, f"{version}/{name}.json")


def nuscenes_path(root: Path, relative: str) -> Path:
    """Return the path of a file or folder of a nuScenes root.

    Links of a shifted root (nuScenes-N) may lead to the file of the same name of the dataset that it names as its
    source, but to nothing else there.

    Raises:
        StoreError: The path leads out of the root, by its name or by a symbolic link (`ssad.core.folders.data_path`).
    """
    try:
        return data_path(root, relative)
    except StoreError:
        source = _source_root(root)
        if source is None:
            raise
        return data_path(root, relative, source=source)


def _source_root(root: Path) -> Path | None:
    """Return the dataset that a shifted root was made of; None for any other folder."""
    path = root / SHIFT_IDENTITY
    if path.is_symlink() or not path.is_file():
        return None
    identity = read_json(path)
    source = identity.get("source") if isinstance(identity, dict) else None
    text = source.get("root") if isinstance(source, dict) else None
    return Path(text) if isinstance(text, str) and Path(text).is_absolute() and "\0" not in text else None
