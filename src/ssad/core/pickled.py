"""PyTorch checkpoint files (.pth, .pt, .ckpt) read without running anything that they hold.

`torch.save` writes a pickle, and a pickle can call any function. Here the pickle is walked with a table of the few
names that describe tensors and plain containers; every other class becomes an inert record of its arguments and state.
So weights can be taken out of a checkpoint that holds a training's configuration, or a whole model of a class that is
not installed, and a hostile file does nothing. Before it is built, a pickle is read step by step: one that would take
memory or time out of proportion to its size is refused. Formats: the zip archive of PyTorch 1.6 and later, and the
older stream.
"""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sized
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ssad.core.errors import FormatError
from ssad.core.pickle_walk import RefusedError, StepBudget, walk
from ssad.core.safeio import MIB, read_bytes

MAX_BYTES = 4096 * MIB
MAX_PICKLE = 256 * MIB
MAGIC = 0x1950A86A20F9469CFC6C  # the first number of the older stream
STREAM = 1001
DEEPEST = 60
MAX_STATE_ENTRIES = 200_000
MAX_EXPANSION = 16  # limit of the tensors' total size, in sizes of the file; tensors may share storage
CONVERT = "convert it where it was made: safetensors.torch.save_file(model.state_dict(), 'weights.safetensors')"
# Entries that hold weights, averaged over the training (Ultralytics, RT-DETR, torchvision, timm, BasicSR, ...) or not
AVERAGES = (
    "ema",
    "ema_model",
    "model_ema",
    "ema_state_dict",
    "state_dict_ema",
    "model_ema_state_dict",
    "ema_net",
    "params_ema",
    "average",
)
COPIES = ("state_dict", "model_state_dict", "model", "module", "net", "network", "weights", "params")
NESTS = (*AVERAGES, *COPIES)
SWAPPED = "ema_state_dict"  # mmengine exchanges its values with those of state_dict, which then are the averages
COUNTERS = frozenset({"n_averaged", "steps", "step", "updates", "num_updates", "decay", "initted", "warmups"})

_KINDS = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
    "UntypedStorage": torch.uint8,
}
_ATTACKS = frozenset({"os", "posix", "nt", "subprocess", "sys", "shutil", "socket", "runpy", "importlib", "ctypes"})
_ATTACK_CALLS = frozenset({"eval", "exec", "compile", "__import__", "open", "input", "breakpoint"})


@dataclass(frozen=True, slots=True, eq=False)
class _Storage:
    """A block of numbers in the file."""

    kind: Any
    key: Any
    count: Any


@dataclass(frozen=True, slots=True, eq=False)
class _StridedTensor:
    """A tensor to be: a window of a storage. Nothing in it is trusted before `_TensorReader.tensor`."""

    storage: Any
    offset: Any
    size: Any
    stride: Any
    kind: Any = None


class _InertObject:
    """Placeholder of an object whose class is not built: its arguments, state and items."""

    def __new__(cls, *args: Any, **options: Any) -> _InertObject:
        self = super().__new__(cls)
        self.args, self.state, self.entries, self.list = args, None, {}, []
        return self

    args: tuple[Any, ...]
    state: Any
    entries: dict[Any, Any]
    list: list[Any]

    def __init__(self, *args: Any, **options: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None:
        self.entries[key] = value

    def append(self, value: Any) -> None:
        """Append an item of a list."""
        self.list.append(value)

    def extend(self, values: Any) -> None:
        """Append items of a list."""
        self.list.extend(values)


class _InertDict(dict[Any, Any]):
    """An OrderedDict of the file, without further attributes."""

    def __setstate__(self, state: Any) -> None:
        pass


class _Maker:
    """A function that the file may call but not change; the items it copies count as steps."""

    __slots__ = ("_factory", "_steps")

    def __init__(self, factory: Callable[..., Any], steps: StepBudget) -> None:
        self._factory, self._steps = factory, steps

    def __call__(self, *args: Any) -> Any:
        self._steps.take(sum(len(value) for value in args if isinstance(value, Sized)))
        return self._factory(*args)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("it changes a function")


def _ordered_dict(items: Any = ()) -> _InertDict:
    """Return an OrderedDict from its items (as written by Python 2), without names that are not text."""
    return _InertDict((name, value) for name, value in items if isinstance(name, str))


def _size(lengths: Any = ()) -> tuple[int, ...]:
    if not isinstance(lengths, (list, tuple)) or not all(type(length) is int for length in lengths):
        raise pickle.UnpicklingError("a size that is not whole numbers")
    return tuple(lengths)


_MAKERS: dict[str, Callable[..., Any]] = {
    "collections.OrderedDict": _ordered_dict,
    "torch.Size": _size,
    "torch._utils._rebuild_tensor": _StridedTensor,
    "torch._utils._rebuild_tensor_v2": lambda storage, offset, size, stride, *_: _StridedTensor(
        storage, offset, size, stride
    ),
    "torch._utils._rebuild_tensor_v3": lambda storage, offset, size, stride, grad, hooks, kind, *_: _StridedTensor(
        storage, offset, size, stride, kind
    ),
    "torch._utils._rebuild_parameter": lambda data, *_: data,
    "torch._utils._rebuild_parameter_with_state": lambda data, *_: data,
    "torch._tensor._rebuild_from_type_v2": lambda function, kind, args, state: function(*args),
}


class _Reader(pickle.Unpickler):
    """An unpickler that builds only tensor specifications, plain containers and inert records."""

    def __init__(self, file: io.BytesIO, file_name: str = "the file") -> None:
        self.steps = StepBudget()
        walk(file, file_name, self.steps)
        super().__init__(file, encoding="utf-8")
        self.names: set[str] = set()
        self.classes: dict[str, type] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Return a safe stand-in for a class, never an object of the running program."""
        full_name = f"{module}.{name}"
        self.names.add(full_name)
        if module.split(".", maxsplit=1)[0] in _ATTACKS or (
            module in {"builtins", "__builtin__"} and name in _ATTACK_CALLS
        ):
            raise RefusedError(f"it would call {full_name}, which no weights need")
        if module in {"torch", "torch.storage"} and name in _KINDS:
            return _KINDS[name]
        if module == "torch" and isinstance(getattr(torch, name, None), torch.dtype):
            return getattr(torch, name)
        if full_name in _MAKERS:
            return _Maker(_MAKERS[full_name], self.steps)
        # One class for each name, so that a file cannot create them without limit.
        if full_name not in self.classes:
            self.steps.take(500)  # a class is far larger than its name
            self.classes[full_name] = type(name, (_InertObject,), {"__module__": module})
        return self.classes[full_name]

    def persistent_load(self, pid: Any) -> Any:
        """Return the description of a storage; for a class stored with its source, the class."""
        if isinstance(pid, tuple) and len(pid) == 4 and pid[0] == "module":
            return pid[1]
        if not isinstance(pid, tuple) or len(pid) not in (5, 6) or pid[0] != "storage":
            raise pickle.UnpicklingError("a reference that is no storage")
        if len(pid) == 6 and pid[5] is not None:
            raise pickle.UnpicklingError("a view of a storage, as PyTorch before 0.4 wrote")
        if not isinstance(pid[2], (str, int)):
            raise pickle.UnpicklingError("a storage without a name")
        return _Storage(pid[1], str(pid[2]), pid[4])


@dataclass(frozen=True, slots=True)
class PickledState:
    """The state dict of a checkpoint.

    Attributes:
        tensors: Tensors by name.
        entry: Names of the nested entries that lead to it; empty: the file is the state dict.
        is_average: Whether the names of the entries, or who wrote them, say that these are averaged weights.
        rest: Entries beside it that are not read: other copies of the weights, and states of optimisers.
    """

    tensors: dict[str, Tensor]
    entry: tuple[str, ...] = ()
    is_average: bool = False
    rest: tuple[str, ...] = ()


class _TensorReader:
    """Reads tensors once the pickle is loaded."""

    def __init__(self, read_storage: Callable[[str], bytes], size: int) -> None:
        self.read_storage = read_storage
        self.storages: dict[str, Tensor] = {}
        self.remaining_bytes = min(MAX_EXPANSION * size, MAX_BYTES)

    def tensor(self, view: _StridedTensor) -> Tensor:
        """The tensor, with storage of its own. ValueError: it does not lie within its storage."""
        storage = view.storage
        if not isinstance(storage, _Storage) or not isinstance(storage.kind, torch.dtype):
            raise ValueError("a tensor without storage")
        kind = view.kind if isinstance(view.kind, torch.dtype) else storage.kind
        if storage.key not in self.storages:
            self.storages[storage.key] = torch.frombuffer(
                bytearray(self.read_storage(storage.key) or b"\0"), dtype=torch.uint8
            )
        storage_bytes = self.storages[storage.key]
        size, stride, offset = view.size, view.stride, view.offset
        is_whole = all(type(number) is int and number >= 0 for number in (offset, *size, *stride))
        if not is_whole or len(size) != len(stride) or len(size) > 16:
            raise ValueError("a tensor of no shape")
        element_count = 1
        for length in size:
            element_count *= length
        if element_count == 0:
            return torch.empty(size, dtype=kind)
        last_index = offset + sum((length - 1) * step for length, step in zip(size, stride, strict=True))
        element_limit = len(storage_bytes) // kind.itemsize
        if last_index >= element_limit or element_count > element_limit:
            raise ValueError("a tensor larger than its storage")
        self.remaining_bytes -= element_count * kind.itemsize
        if self.remaining_bytes < 0:
            raise RefusedError(f"its tensors take more than {MAX_EXPANSION} times its size or {MAX_BYTES // MIB} MiB")
        # A clone: tensors of the file may overlap, and safetensors refuses shared memory.
        return storage_bytes[: element_limit * kind.itemsize].view(kind).as_strided(size, stride, offset).clone()


def read_pickled(path: str | Path) -> PickledState:
    """Return the state dict in a checkpoint file: alone, nested (`NESTS`, averaged weights first), or of a module.

    Raises:
        FormatError: The file is truncated, not a checkpoint, hostile, or holds no tensors by name.
    """
    try:
        with open(path, "rb") as file:
            signature = file.read(4)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        with ExitStack() as files:
            tree, numbers, names = _read_zip(path, files) if signature[:2] == b"PK" else _read_stream(path)
            choice = _state(tree, 0)
            if choice is None:
                other_names = ", ".join(
                    sorted(
                        global_name
                        for global_name in names
                        if global_name not in _MAKERS and not global_name.startswith("torch.")
                    )[:3]
                )
                entries = ", ".join(key for key in (_as_mapping(tree) or {}) if isinstance(key, str))[:100]
                raise FormatError(
                    f"{path}: holds no state dict (tensors by name){f', but {other_names}' if other_names else ''}"
                    f"{f'; entries: {entries}' if entries else ''}; {CONVERT}"
                )
            tensors = {name: numbers.tensor(value) for name, value in choice.tensors}
            return PickledState(tensors, choice.entry, choice.is_average, choice.rest)
    except FormatError:
        raise
    except RefusedError as error:
        raise FormatError(f"{path}: refused: {error}; nothing was run") from None
    except Exception as error:  # broken bytes may raise any exception
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise FormatError(f"{path}: not a readable PyTorch checkpoint: {reason}; {CONVERT}") from None


def _read_zip(path: str | Path, files: ExitStack) -> tuple[Any, _TensorReader, set[str]]:
    archive = files.enter_context(zipfile.ZipFile(path))
    members = {member.filename: member for member in archive.infolist()}
    if any(name.endswith("/constants.pkl") for name in members):
        raise FormatError(f"{path}: a TorchScript program, not weights; {CONVERT}")
    pickle_names = [name for name in members if name.endswith("/data.pkl") and name.count("/") == 1]
    if len(pickle_names) != 1:
        raise FormatError(f"{path}: a zip file, but not one that PyTorch wrote")
    root = pickle_names[0].removesuffix("data.pkl")
    if any(member.compress_type != zipfile.ZIP_STORED for member in members.values()):
        raise FormatError(f"{path}: its parts are compressed, which PyTorch never does")
    size = Path(path).stat().st_size
    # Overlapping members are how a small zip file expands without compression.
    if sum(member.file_size for member in members.values()) > size:
        raise FormatError(f"{path}: its parts overlap, which PyTorch never does")
    if members[pickle_names[0]].file_size > MAX_PICKLE:
        raise FormatError(f"{path}: its description alone is larger than {MAX_PICKLE // MIB} MiB")
    if f"{root}byteorder" in members and archive.read(f"{root}byteorder") != b"little":
        raise FormatError(f"{path}: written by a big-endian machine; {CONVERT}")
    reader = _Reader(io.BytesIO(archive.read(pickle_names[0])), pickle_names[0])
    return reader.load(), _TensorReader(lambda key: archive.read(f"{root}data/{key}"), size), reader.names


def _read_stream(path: str | Path) -> tuple[Any, _TensorReader, set[str]]:
    content = read_bytes(path, limit=MAX_BYTES)
    if content[:1] != b"\x80":
        raise FormatError(f"{path}: no PyTorch checkpoint; {CONVERT}")
    file = io.BytesIO(content)
    if _Reader(file).load() != MAGIC:
        raise FormatError(f"{path}: a Python pickle, not a PyTorch checkpoint; {CONVERT}")
    if _Reader(file).load() != STREAM or not dict(_Reader(file).load()).get("little_endian", True):
        raise FormatError(f"{path}: a PyTorch stream of another version or byte order; {CONVERT}")
    reader = _Reader(file)
    tree = reader.load()
    keys = _Reader(file).load()
    storage_by_key = {storage.key: storage for storage in _storages(tree)}
    spans: dict[str, tuple[int, int]] = {}
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        kind = storage_by_key[key].kind if key in storage_by_key else None
        if not isinstance(kind, torch.dtype) or count < 0 or file.tell() + count * kind.itemsize > len(content):
            raise ValueError(f"storage {key} is cut short or unknown")
        spans[str(key)] = (file.tell(), file.tell() + count * kind.itemsize)
        file.seek(spans[str(key)][1])
    return tree, _TensorReader(lambda key: content[slice(*spans[key])], len(content)), reader.names


def _storages(tree: Any) -> Iterator[_Storage]:
    """Yield all storages that a tree refers to."""
    stack, visited_ids = [tree], set()
    while stack:
        value = stack.pop()
        # A pickle can contain cycles.
        if id(value) in visited_ids or isinstance(value, (str, bytes, int, float)):
            continue
        visited_ids.add(id(value))
        if isinstance(value, _Storage):
            yield value
        elif isinstance(value, _StridedTensor):
            stack.append(value.storage)
        elif isinstance(value, dict):
            stack += [*value.keys(), *value.values()]
        elif isinstance(value, (list, tuple, set)):
            stack += value
        elif isinstance(value, _InertObject):
            stack += [value.args, value.state, value.entries, value.list]


def _as_mapping(value: Any) -> Mapping[Any, Any] | None:
    if isinstance(value, dict):
        return value
    if isinstance(value, _InertObject) and value.entries:
        return value.entries
    return None


@dataclass(frozen=True, slots=True)
class _Choice:
    """A state dict that is not built yet; see `PickledState`."""

    tensors: list[tuple[str, _StridedTensor]]
    entry: tuple[str, ...] = ()
    is_average: bool = False
    rest: tuple[str, ...] = ()


def _state(tree: Any, depth: int) -> _Choice | None:
    """Return names and tensors of the first state dict in a tree, None if there is none."""
    if depth > 4:
        return None
    if (
        isinstance(tree, _InertObject)
        and isinstance(tree.state, dict)
        and _as_mapping(tree.state.get("_modules")) is not None
    ):
        return _Choice(_module(tree))
    mapping = _as_mapping(tree)
    if mapping is None:
        inner_state = (
            tree.state if isinstance(tree, _InertObject) else None
        )  # an object that keeps a model, such as an average
        return _state(inner_state, depth + 1) if isinstance(inner_state, dict) else None
    named_tensors = [
        (key, value) for key, value in mapping.items() if isinstance(key, str) and isinstance(value, _StridedTensor)
    ]
    # An average may keep its counters beside the entry that holds its weights.
    if any(name not in COUNTERS for name, _ in named_tensors):
        return _Choice(named_tensors)
    is_swapped = "state_dict" in mapping and "steps" in (_as_mapping(mapping.get(SWAPPED)) or {})
    for nest in NESTS:
        if mapping.get(nest) is None or (is_swapped and nest == SWAPPED):
            continue
        choice = _state(mapping[nest], depth + 1)
        if choice and choice.tensors:
            is_average = nest in AVERAGES or is_swapped or choice.is_average
            return _Choice(choice.tensors, (nest, *choice.entry), is_average, _others(mapping, nest) + choice.rest)
    return _Choice(named_tensors) if named_tensors else None


def _others(mapping: Mapping[Any, Any], nest: str) -> tuple[str, ...]:
    """Return the names of other copies and of states of optimisers in a mapping."""
    return tuple(
        key
        for key, value in mapping.items()
        if isinstance(key, str) and key != nest and value is not None and (key in NESTS or "optim" in key)
    )


def _module(root: _InertObject) -> list[tuple[str, _StridedTensor]]:
    """Return parameters and buffers of a pickled module and its submodules, by the names of its state dict."""
    named_tensors: list[tuple[str, _StridedTensor]] = []
    stack: list[tuple[str, Any, int]] = [("", root, 0)]
    module_count = 0
    while stack:
        prefix, module, depth = stack.pop()
        module_count += 1
        if depth > DEEPEST or module_count > MAX_STATE_ENTRIES:
            raise ValueError("a module nested without end")
        state = module.state if isinstance(module, _InertObject) and isinstance(module.state, dict) else {}
        for attribute in ("_parameters", "_buffers"):
            for name, value in (_as_mapping(state.get(attribute)) or {}).items():
                if isinstance(value, _StridedTensor):
                    named_tensors.append((f"{prefix}{name}", value))
        children = [
            (f"{prefix}{child_name}.", child, depth + 1)
            for child_name, child in (_as_mapping(state.get("_modules")) or {}).items()
        ]
        stack += reversed(children)
    return named_tensors
