"""Safe reading of user files and atomic writing of SSAD's own.

Readers refuse hostile content (YAML bombs, XML entities, pickles, zip bombs) and name file and line. Writers are
atomic: a reader sees either the old file or the whole new one. Every error is an `ssad.core.errors.SSADError`.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.folders import check_links_above

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MIB = 1 << 20
MAX_DEPTH = 64
MAX_ALIASED_NODES = 10_000
MAX_JSON_DEPTH = 100
MAX_XML_DEPTH = 200
MAX_DIGITS = 300  # of a whole number, which must fit a float

Location = Sequence[str | int]


def home_folder() -> Path:
    """Return the folder of imported towns and scenarios: $SSAD_HOME, else ~/.local/share/ssad (it need not exist)."""
    configured = os.environ.get("SSAD_HOME")
    return Path(configured).expanduser() if configured else Path.home() / ".local" / "share" / "ssad"


def read_bytes(path: str | Path, *, limit: int = 64 * MIB) -> bytes:
    """Read a whole file.

    Raises:
        FormatError: The file cannot be read, or is larger than `limit` bytes.
    """
    try:
        with open(path, "rb") as file:
            # read() allocates its argument at once, so ask for the file's size only; a pipe is read in blocks
            content = file.read(min(os.fstat(file.fileno()).st_size, limit) + 1)
            while len(content) <= limit and (block := file.read(MIB)):
                content += block
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(content) > limit:
        raise FormatError(f"{path}: larger than the limit of {limit / MIB:g} MiB")
    return content


def read_text(path: str | Path, *, limit: int = 64 * MIB) -> str:
    """Read a whole file as UTF-8 text.

    Raises:
        FormatError: The file cannot be read, is larger than `limit` bytes, or is not UTF-8.
    """
    try:
        return read_bytes(path, limit=limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: not UTF-8 text (byte {error.start})") from None


# ---------------------------------------------------------------- YAML

# YAML 1.2 core: `1e-3` is a number, `no` and `on` are words, `1:30` is text (PyYAML's default is YAML 1.1)
_RESOLVERS: tuple[tuple[str, str, str], ...] = (
    ("tag:yaml.org,2002:null", r"^(?:~|null|Null|NULL|)$", "~nN"),
    ("tag:yaml.org,2002:bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("tag:yaml.org,2002:int", r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", "-+0123456789"),
    (
        "tag:yaml.org,2002:float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        "-+.0123456789",
    ),
    ("tag:yaml.org,2002:merge", r"^<<$", "<"),
)


def _with_resolvers(base: type) -> Any:
    """Return a loader or dumper class with YAML 1.2's resolution of plain scalars."""
    table: dict[str, list[tuple[str, re.Pattern[str]]]] = {}
    for tag, pattern, first_letters in _RESOLVERS:
        for letter in [*first_letters, *([""] if tag.endswith("null") else [])]:
            table.setdefault(letter, []).append((tag, re.compile(pattern)))
    return type(base.__name__, (base,), {"yaml_implicit_resolvers": table})


@dataclass(frozen=True)
class Document:
    """A parsed YAML text: plain data, and the line of every key and item."""

    name: str
    data: Any
    lines: Mapping[tuple[str | int, ...], int] = field(default_factory=dict)

    def line(self, location: Location = ()) -> int:
        """Return the line (from 1) of a key or item such as ("scenarios", 3, "town"), or of its nearest ancestor."""
        known_location = tuple(location)
        while known_location and known_location not in self.lines:
            known_location = known_location[:-1]
        return self.lines.get(known_location, 1)

    def error(self, location: Location, message: str) -> ConfigError:
        """Return a ConfigError that names file, line and key."""
        key = format_location(location)
        return ConfigError(f"{self.name}:{self.line(location)}: {f'{key}: ' if key else ''}{message}")


def format_location(location: Location) -> str:
    """Return ("a", 0, "b") as `a[0].b`."""
    dotted_path = ""
    for part in location:
        dotted_path += f"[{part}]" if isinstance(part, int) else f".{part}" if dotted_path else str(part)
    return dotted_path


class _Builder:
    """Converts YAML nodes to plain data; refuses duplicate keys, tags, loops and expansion bombs."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines: dict[tuple[str | int, ...], int] = {}
        self.visited_ids: set[int] = set()
        self.open_ids: set[int] = set()
        self.aliased = 0

    def error(self, node: Any, message: str) -> FormatError:
        return FormatError(f"{self.name}:{node.start_mark.line + 1}: {message}")

    def build(self, node: Any, location: tuple[str | int, ...], repeated: bool) -> Any:
        repeated = repeated or id(node) in self.visited_ids
        if repeated:
            # Nodes behind aliases are counted, because each use expands them again.
            self.aliased += 1
            if self.aliased > MAX_ALIASED_NODES:
                raise self.error(node, f"aliases expand to more than {MAX_ALIASED_NODES} values (a YAML bomb?)")
        if id(node) in self.open_ids:
            raise self.error(node, "an alias refers to the value that contains it")
        if len(location) > MAX_DEPTH:
            raise self.error(node, f"nested deeper than {MAX_DEPTH} levels")
        self.visited_ids.add(id(node))
        self.lines.setdefault(location, node.start_mark.line + 1)
        if node.id == "scalar":
            return self.scalar(node)
        self.open_ids.add(id(node))
        try:
            if node.id == "sequence":
                if node.tag != "tag:yaml.org,2002:seq":
                    raise self.error(node, f"tag {node.tag} is not allowed; use plain YAML")
                return [self.build(child, (*location, index), repeated) for index, child in enumerate(node.value)]
            return self.mapping(node, location, repeated)
        finally:
            self.open_ids.discard(id(node))

    def mapping(self, node: Any, location: tuple[str | int, ...], repeated: bool) -> dict[str, Any]:
        if node.tag != "tag:yaml.org,2002:map":
            raise self.error(node, f"tag {node.tag} is not allowed; use plain YAML")
        entries: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if key_node.id != "scalar":
                raise self.error(key_node, "a key must be a single word or text")
            if key_node.tag.endswith(":merge"):
                raise self.error(key_node, "merge keys (<<) are not supported; write the keys out")
            key = str(key_node.value)
            if key in entries:
                raise self.error(key_node, f"key '{key}' appears twice")
            self.lines.setdefault((*location, key), key_node.start_mark.line + 1)
            entries[key] = self.build(value_node, (*location, key), repeated)
        return entries

    def scalar(self, node: Any) -> Any:
        text: str = node.value
        scalar_type = node.tag.removeprefix("tag:yaml.org,2002:")
        try:
            if scalar_type == "null":
                return None
            if scalar_type == "bool" and text.lower() in ("true", "false"):
                return text.lower() == "true"
            if scalar_type == "int":
                if len(text) > MAX_DIGITS:
                    raise self.error(node, f"a number of {len(text)} digits")
                return int(text, 0 if text[:2] in ("0o", "0x") else 10)
            if scalar_type == "float":
                value = float(re.sub(r"\.(?=[in])", "", text.lower()))  # .inf and .nan have a leading dot
                if math.isnan(value):
                    raise self.error(node, "NaN is not a value")
                if math.isinf(value) and "inf" not in text.lower():
                    raise self.error(node, f"{text[:40]} is too large for a number")
                return value
        except ValueError:
            raise self.error(node, f"'{text[:40]}' is not a valid {scalar_type}") from None
        if scalar_type in ("str", "merge"):
            return text
        raise self.error(node, f"tag {node.tag} is not allowed; use plain YAML")


def parse_yaml_document(text: str, name: str = "<text>") -> Document:
    """Parse one YAML document; `name` is its name in errors.

    Raises:
        FormatError: It is not valid YAML, with the line.
    """
    import yaml

    loader = _with_resolvers(getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    depth = 0

    try:
        for event in yaml.parse(text, Loader=loader):  # before the composer, which recurses in C
            if isinstance(event, (yaml.SequenceStartEvent, yaml.MappingStartEvent)):
                depth += 1
                if depth > MAX_DEPTH:
                    line = getattr(event.start_mark, "line", 0) + 1
                    raise FormatError(f"{name}:{line}: nested deeper than {MAX_DEPTH} levels")
            elif isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
                depth -= 1
        node = yaml.compose(text, Loader=loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark if error.problem_mark is not None else error.context_mark
        line = None if mark is None else mark.line
        position = name if line is None else f"{name}:{line + 1}"
        raise FormatError(f"{position}: not valid YAML: {error.problem or error.context}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise FormatError(f"{name}: not valid YAML: {error}") from None
    if node is None:
        return Document(name, None)
    builder = _Builder(name)
    return Document(name, builder.build(node, (), False), builder.lines)


def parse_yaml(text: str, name: str = "<text>") -> Any:
    """Return the plain data of one YAML document.

    Raises:
        FormatError: It is not valid YAML, with the line.
    """
    return parse_yaml_document(text, name).data


def read_yaml_document(path: str | Path, *, limit: int = 16 * MIB) -> Document:
    """Parse a YAML file and keep line numbers for later errors (`Document.error`).

    Raises:
        FormatError: The file cannot be read, is larger than `limit` bytes, or is not valid YAML.
    """
    return parse_yaml_document(read_text(path, limit=limit), str(path))


def dump_yaml(data: Any) -> str:
    """Return YAML text that `parse_yaml` reads back to equal data; keys keep their order."""
    import yaml

    dumper = _with_resolvers(yaml.SafeDumper)
    dumper.ignore_aliases = lambda self, data: True
    return str(yaml.dump(data, Dumper=dumper, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None))


# ---------------------------------------------------------------- JSON, XML


def _refuse_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        visited_keys: set[str] = set()
        duplicate = next(key for key, _ in pairs if key in visited_keys or visited_keys.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"key '{duplicate}' appears twice")
    return mapping


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a JSON number")


_LONG_NUMBER = re.compile(r"[0-9]{300}|[eE]\+?[0-9]{3}")
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_JSON_STRING = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
_BRACKETS = np.zeros(256, np.int8)
_BRACKETS[list(b"[{")], _BRACKETS[list(b"]}")] = 1, -1


def _parse_finite_int(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _parse_finite_float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"{text[:40]} is too large for a number")
    return value


def _json_depth(text: str | bytes) -> int:
    """Return the number of nested lists and objects of a JSON text, at least where it is beyond the limit.

    Python's reader recurses in C, and what reads its result recurses in Python.
    """
    for without_strings in (False, True):  # brackets in strings are rare: look closer only if there are too many
        if without_strings:
            text = _JSON_STRING.sub("", text if isinstance(text, str) else text.decode(errors="replace"))
        if isinstance(text, str):
            brackets = np.frombuffer(text.encode(errors="replace"), np.uint8)
        else:
            brackets = np.frombuffer(text, np.uint8)
        depth, deepest = 0, 0
        for start in range(0, len(brackets), MIB):
            depths = depth + np.cumsum(_BRACKETS[brackets[start : start + MIB]], dtype=np.int32)
            depth, deepest = int(depths[-1]), max(deepest, int(depths.max()))
        if deepest <= MAX_JSON_DEPTH:
            break
    return deepest


def parse_json(text: str | bytes, name: str = "<text>") -> Any:
    """Return the plain data of a JSON text; duplicate keys and NaN are refused.

    Raises:
        FormatError: It is not valid JSON, with the line.
    """
    try:
        if _json_depth(text) > MAX_JSON_DEPTH:
            raise FormatError(f"{name}: nested deeper than {MAX_JSON_DEPTH} levels")
        hooks: dict[str, Any] = {}
        decoded_text = text if isinstance(text, str) else text.decode(json.detect_encoding(text))
        if _LONG_NUMBER.search(decoded_text):
            hooks = {"parse_int": _parse_finite_int, "parse_float": _parse_finite_float}  # slower than json's own
        data = json.loads(text, object_pairs_hook=_refuse_duplicate_keys, parse_constant=_refuse_constant, **hooks)
        if _SURROGATE.search(decoded_text):
            json.dumps(data, ensure_ascii=False).encode()  # half a character cannot be written again
        return data
    except json.JSONDecodeError as error:
        raise FormatError(f"{name}:{error.lineno}: not valid JSON: {error.msg}") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{name}: not valid JSON: {error}") from None


def read_json(path: str | Path, *, limit: int = 256 * MIB) -> Any:
    """Read plain data from a JSON file.

    Raises:
        FormatError: The file cannot be read, is larger than `limit` bytes, or is not valid JSON.
    """
    return parse_json(read_text(path, limit=limit), str(path))


def dump_json(data: Any, *, indent: int | None = None) -> str:
    """Return canonical JSON: sorted keys, no spaces (unless `indent`), no NaN.

    Raises:
        ValueError: A value cannot be written as JSON.
    """
    separators = (",", ":") if indent is None else (",", ": ")
    return json.dumps(data, sort_keys=True, ensure_ascii=False, allow_nan=False, indent=indent, separators=separators)


def to_plain_json(value: Any) -> Any:
    """Return plain JSON data; a number that is not finite (no such event) becomes None."""
    if isinstance(value, Mapping):
        return {str(key): to_plain_json(element) for key, element in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain_json(element) for element in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def parse_xml(
    text: str | bytes,
    name: str = "<text>",
    *,
    element_factory: Callable[[str, dict[str, str], int], Element] | None = None,
) -> Element:
    """Return the root of an XML text; DTDs, entities and external data are refused.

    Args:
        text: The text.
        name: Its name in messages.
        element_factory: Makes an element of its tag, its attributes and its line in the text; None: an `Element`.

    Raises:
        FormatError: It is refused, nested deeper than 200 levels, or not valid XML, with the line.
    """
    from xml.etree.ElementTree import ParseError, TreeBuilder

    import defusedxml
    import defusedxml.ElementTree as safe

    def element_at_line(tag: str, attributes: dict[str, str]) -> Element:
        assert element_factory is not None
        return element_factory(tag, attributes, parser.parser.CurrentLineNumber)

    builder = TreeBuilder() if element_factory is None else TreeBuilder(element_factory=element_at_line)
    parser = safe.DefusedXMLParser(target=builder, forbid_dtd=True)
    try:
        parser.feed(text)
        root: Element = parser.close()
    except defusedxml.DefusedXmlException as error:
        reason = type(error).__name__
        raise FormatError(f"{name}: refused: it declares a DTD, entities or external data ({reason})") from None
    except ParseError as error:
        line = error.position[0]
        raise FormatError(f"{name}:{line}: not valid XML: {error}") from None
    except (ValueError, LookupError, RecursionError) as error:
        raise FormatError(f"{name}: not valid XML: {error}") from None
    # Readers descend by recursion, which must not exhaust the stack.
    level = [root]
    for _ in range(MAX_XML_DEPTH):
        level = [child for element in level for child in element]
    if level:
        line_number: int | None = getattr(level[0], "line", None)
        place = name if line_number is None else f"{name}:{line_number}"
        raise FormatError(f"{place}: <{level[0].tag[:40]}> is nested deeper than {MAX_XML_DEPTH} levels")
    return root


def read_xml(
    path: str | Path,
    *,
    limit: int = 256 * MIB,
    element_factory: Callable[[str, dict[str, str], int], Element] | None = None,
) -> Element:
    """Read the root element of an XML file, safely; `element_factory` as in `parse_xml`.

    Raises:
        FormatError: The file cannot be read, is larger than `limit` bytes, nested deeper than 200 levels, or is not
            valid XML.
    """
    return parse_xml(read_bytes(path, limit=limit), str(path), element_factory=element_factory)


# ---------------------------------------------------------------- npz


def npz_bytes(arrays: Mapping[str, npt.ArrayLike]) -> bytes:
    """Return a compressed npz with the same bytes for the same arrays (fixed time stamps, given order)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, value in arrays.items():
            array = np.asarray(value)
            if array.dtype.hasobject:
                raise TypeError(f"array '{name}' holds Python objects")
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            # Unix on every platform, since the field is part of the bytes.
            info.create_system = 3
            info.external_attr = 0o644 << 16
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array).reshape(array.shape), allow_pickle=False)
            archive.writestr(info, member.getvalue())
    return buffer.getvalue()


def save_npz(path: str | Path, arrays: Mapping[str, npt.ArrayLike]) -> None:
    """Write a deterministic compressed npz, atomically.

    Raises:
        StoreError: The file cannot be written.
    """
    write_atomic(path, npz_bytes(arrays))


def load_npz(path: str | Path, *, limit: int = 2048 * MIB) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of an npz; pickles, and members larger than they claim to be, are refused.

    Raises:
        FormatError: The file cannot be read, is too large, or is not such an npz.
    """
    content = read_bytes(path, limit=limit)
    arrays: dict[str, npt.NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > limit:
                raise FormatError(f"{path}: unpacks to more than the limit of {limit / MIB:g} MiB")
            for member in members:
                arrays[member.filename.removesuffix(".npy")] = _read_npy(archive.read(member))
    except FormatError:
        raise
    except Exception as error:  # zipfile and numpy raise many kinds for broken bytes
        raise FormatError(f"{path}: not a readable npz file: {error}") from None
    return arrays


def _read_npy(data: bytes) -> npt.NDArray[Any]:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read_header(stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects (a pickle)")
    count = math.prod(shape)
    if count * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("an array is cut short")
    values = np.frombuffer(data, dtype=dtype, count=count, offset=stream.tell())
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)


# ---------------------------------------------------------------- writing


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents, and check that it is writable.

    Raises:
        StoreError: It cannot be created or written to, or a link below a results folder leads to it.
    """
    folder = Path(path)
    check_links_above(folder, itself=True)
    probe = _temporary(folder / "probe")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise StoreError(f"{folder}: cannot write there: {error.strerror or error}; choose another folder") from None
    return folder


_TEMPORARY = re.compile(r"\..+-\d+-[0-9a-f]{8}\.tmp(\.\w+)?")  # names from `_temporary`


def _temporary(path: Path) -> Path:
    """Return a path beside `path` that no other process or thread uses, and that `remove_unfinished` recognises."""
    return path.with_name(f".{path.stem}-{os.getpid()}-{os.urandom(4).hex()}.tmp{path.suffix}")


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix) that replaces it if the block succeeds.

    Raises:
        StoreError: The file cannot be written, or a link below a results folder leads to it.
    """
    target = Path(path)
    check_links_above(target)
    temporary = _temporary(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb+") as file:
            # Before the rename: else a power cut could leave an empty file under the final name.
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_unfinished(folder: Path) -> None:
    """Remove files that killed processes left of `atomic_path` and `make_folder` in a folder, not in subfolders."""
    for path in folder.glob(".*") if folder.is_dir() else ():
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def write_atomic(path: str | Path, data: str | bytes) -> None:
    """Write the whole file or nothing: temporary file in the same folder, fsync, rename.

    Raises:
        StoreError: The file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)
