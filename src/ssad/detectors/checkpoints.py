"""The only door for weights: read without executing anything, checked against a model, written with a card."""

from __future__ import annotations

import difflib
import hashlib
import pickle
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

import ssad
from ssad import safeio
from ssad.errors import ConfigError, FormatError

MIB = 2**20
NESTS = ("state_dict", "model_state_dict", "model", "ema")
_KNOWN = {
    ("collections", "OrderedDict"), ("torch._utils", "_rebuild_tensor_v2"), ("torch._utils", "_rebuild_parameter"),
    ("torch", "Size"), ("torch", "float32"), ("torch", "float16"), ("torch", "bfloat16"), ("torch", "int64"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Card:
    """What is to be known of weights: the data they were trained on, the command that trains them anew, seed, metrics,
    classes, the values of the recipe, hash (SHA-256 of names and tensors as stored), version of SSAD."""

    data: str
    command: str
    seed: int
    metrics: Mapping[str, float]
    classes: tuple[str, ...] = ()
    config: Mapping[str, Any] = field(default_factory=dict)
    hash: str = ""
    version: str = ssad.__version__


class _Inert:
    """Stands for every object of a checkpoint that is no tensor or plain container; does nothing."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> _Inert:
        return self

    def __setstate__(self, _: Any) -> None:
        pass

    def __setitem__(self, _: Any, __: Any) -> None:
        pass

    def __hash__(self) -> int:
        return id(self)

    def append(self, _: Any) -> None:
        """Nothing."""

    def extend(self, _: Any) -> None:
        """Nothing."""

    def add(self, _: Any) -> None:
        """Nothing."""


class _Unpickler(pickle.Unpickler):
    """Builds tensors and plain containers; anything else that a file names becomes inert and is never called."""

    def find_class(self, module: str, name: str) -> Any:
        """What a name of the file stands for."""
        return super().find_class(module, name) if (module, name) in _KNOWN else _Inert


def load_weights(path: str | Path) -> dict[str, Tensor]:
    """Tensors by name from .safetensors (NAME-00001-of-00003.safetensors with its siblings, or a folder of them) or
    from a torch checkpoint (.pth, .pt, .ckpt; what it nests under state_dict, model or ema). On the CPU.

    Nothing in a file is executed: objects that are no tensors are left out. FormatError: missing, broken, no weights.
    """
    path = Path(path)
    if path.is_dir():
        return _together(path, sorted(path.glob("*.safetensors")))
    if not path.is_file():
        raise FormatError(f"{path}: no such file of weights")
    if path.suffix == ".safetensors":
        stem, _, rest = path.stem.rpartition("-of-")
        shards = sorted(path.parent.glob(f"{stem[:-5]}*-of-{rest}.safetensors")) if rest.isdigit() else [path]
        if rest.isdigit() and len(shards) != int(rest):
            raise FormatError(f"{path}: {len(shards)} of {int(rest)} parts are there; put them into one folder")
        return _together(path, shards)
    return _torch_file(path)


def _together(path: Path, files: Iterable[Path]) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for file in files:
        try:
            found |= load_file(file)
        except (SafetensorError, OSError) as error:
            raise FormatError(f"{file}: not a safetensors file, or cut short ({error})") from None
    if not found:
        raise FormatError(f"{path}: holds no weights (*.safetensors)")
    return {name: value.float() if value.dtype == torch.float16 else value for name, value in found.items()}


def _torch_file(path: Path) -> dict[str, Tensor]:
    if not zipfile.is_zipfile(path):
        raise FormatError(
            f"{path}: not a checkpoint of torch 1.6 or later; load it where it was made and save its state_dict "
            "with safetensors.torch.save_file"
        )
    safe: Any = SimpleNamespace(
        Unpickler=_Unpickler, load=pickle.load, __name__="ssad", UnpicklingError=pickle.UnpicklingError
    )
    try:
        content = torch.load(path, map_location="cpu", weights_only=False, pickle_module=safe)
    except Exception as error:
        raise FormatError(f"{path}: broken or foreign checkpoint ({type(error).__name__}); try safetensors") from None
    for _ in range(3):
        nest = next((k for k in NESTS if isinstance(content, Mapping) and isinstance(content.get(k), Mapping)), None)
        if nest is None:
            break
        content = content[nest]
    rows = content.items() if isinstance(content, Mapping) else ()
    found = {str(k).removeprefix("module."): v for k, v in rows if isinstance(v, Tensor)}
    if not found:
        raise FormatError(f"{path}: holds no weights by name (a state_dict); save model.state_dict() as safetensors")
    return {name: value.detach().clone() for name, value in found.items()}


def fit_state(module: nn.Module, state: Mapping[str, Tensor], where: str) -> None:
    """Loads weights into a module, all of them and nothing else. FormatError (one line): names or shapes that do not
    fit, values that are no numbers; the module is then as it was."""
    own = module.state_dict()
    optional = {name for name in own if name.endswith("num_batches_tracked")}
    missing = sorted(set(own) - set(state) - optional)
    foreign = sorted(set(state) - set(own) - {n for n in state if n.endswith("num_batches_tracked")})
    if missing or foreign:
        parts = []
        for what, names in (("missing", missing), ("foreign", foreign)):
            if names:
                parts.append(f"{len(names)} {what} ({', '.join(names[:3])}{' ...' if len(names) > 3 else ''})")
        close = difflib.get_close_matches(foreign[0], missing, n=1) if missing and foreign else []
        hint = f"; is '{foreign[0]}' meant to be '{close[0]}'?" if close else "; these are weights of another detector"
        raise FormatError(f"{where}: weights do not fit: {'; '.join(parts)}{hint}")
    for name, value in own.items():
        given = state.get(name)
        if given is None:
            continue
        if given.shape != value.shape:
            hint = ""
            if "head" in name or "cls" in name:
                hint = "; are they for another number of classes?"
            raise FormatError(
                f"{where}: '{name}' has the shape {list(given.shape)}, this detector needs {list(value.shape)}{hint}"
            )
        if given.is_floating_point() and not bool(torch.isfinite(given).all()):
            raise FormatError(
                f"{where}: '{name}' holds values that are NaN or infinite; the file is of a failed training"
            )
    module.load_state_dict({name: state.get(name, own[name]) for name in own})


def tensor_hash(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes, in the order of the names."""
    found = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().cpu().contiguous()
        found.update(f"{name} {value.dtype} {list(value.shape)}\n".encode())
        found.update(value.reshape(-1).view(torch.uint8).numpy().tobytes() if value.numel() else b"")
    return found.hexdigest()


def save_weights(
    path: Path, state: Mapping[str, Tensor], *, card: Card, half: bool = False, shard_mb: float = 15.0
) -> list[Path]:
    """Writes weights as safetensors, in parts of at most shard_mb MiB, and the card as NAME.json; the files.

    half: floating point numbers as float16. ConfigError: a tensor that does not fit into a part.
    """
    stored = {
        name: (value.detach().cpu().half() if half and value.is_floating_point() else value.detach().cpu()).contiguous()
        for name, value in state.items()
        if not name.endswith("num_batches_tracked")
    }
    parts: list[dict[str, Tensor]] = [{}]
    room = shard_mb * MIB * 0.995
    size = 0.0
    for name, value in stored.items():
        need = value.numel() * value.element_size() + 256
        if need > room:
            raise ConfigError(f"'{name}' has {need / MIB:.1f} MiB, more than a file may have")
        if size + need > room:
            parts.append({})
            size = 0.0
        parts[-1][name] = value
        size += need
    stem = path.name.removesuffix(".safetensors")
    names = [path.name] if len(parts) == 1 else [
        f"{stem}-{k:05d}-of-{len(parts):05d}.safetensors" for k in range(1, len(parts) + 1)
    ]  # fmt: skip
    safeio.make_folder(path.parent)
    for name, part in zip(names, parts, strict=True):
        with safeio.atomic_path(path.parent / name) as target:
            save_file(part, target, metadata={"format": "pt"})
    page = asdict(card) | {"hash": tensor_hash(stored), "files": names}
    safeio.write_atomic(path.parent / f"{stem}.json", safeio.dump_json(page, indent=1) + "\n")
    return [path.parent / name for name in names]


def read_card(path: Path) -> tuple[Card, tuple[str, ...]]:
    """A card and the names of its files. FormatError."""
    data = safeio.read_json(path)
    try:
        files = tuple(str(name) for name in data.pop("files"))
        return Card(**{**data, "classes": tuple(data["classes"])}), files
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{path}: not a card of weights ({type(error).__name__}: {error})") from None


def load_card(path: Path) -> tuple[Card, dict[str, Tensor]]:
    """The card NAME.json and the weights that it names, whose hash must be the card's. FormatError."""
    card, files = read_card(path)
    stored: dict[str, Tensor] = {}
    for name in files:
        try:
            stored |= load_file(path.parent / name)
        except (SafetensorError, OSError) as error:
            raise FormatError(f"{path.parent / name}: missing or broken ({error})") from None
    if tensor_hash(stored) != card.hash:
        raise FormatError(f"{path}: the weights beside it are not those that it describes (another hash)")
    return card, {k: v.float() if v.dtype == torch.float16 else v for k, v in stored.items()}
