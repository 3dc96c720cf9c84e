"""The only door for weights: files in, files out, and into a detector; each error is one line.

Nothing in a file is ever executed: safetensors holds numbers alone, and PyTorch's pickles are read by
`ssad.core.pickled`, which builds tensors and nothing else.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_safetensors
from safetensors.torch import save as dump_safetensors
from torch import Tensor, nn

from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.pickled import MAX_BYTES, read_pickled
from ssad.core.safeio import dump_json, make_folder, read_bytes, read_json, write_atomic
from ssad.core.version import __version__

PICKLED = (".pth", ".pt", ".ckpt", ".bin", ".tar")
SHARD = re.compile(r"(?P<stem>.+)-(?P<number>\d{5})-of-(?P<count>\d{5})\.safetensors")
HALF_MAX = 65504.0
COUNTER = "num_batches_tracked"  # of BatchNorm; it counts steps of training, and old files and frozen norms lack it


@dataclass(frozen=True, slots=True)
class Card:
    """What weights are and where they come from.

    Attributes:
        data: What they were trained on.
        command: Command that reproduces them.
        seed: Seed of the training.
        classes: In the order of the logits.
        metrics: Measured on the data named in `data`.
        config: Options of the builder.
        hash: SHA-256 of the tensors as stored (`hash_state`); `save_weights` fills it in.
        version: Version of SSAD; `save_weights` fills it in.
    """

    data: str
    command: str
    seed: int
    classes: tuple[str, ...]
    metrics: Mapping[str, float] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    hash: str = ""
    version: str = ""


def hash_state(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes of the tensors, in the order of their names."""
    total = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().cpu().contiguous()
        total.update(f"{name}\x1f{value.dtype}\x1f{tuple(value.shape)}\x1e".encode())
        total.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def state_hash(detector: Any) -> str:
    """12 hex digits over the weights of a detector; "" for one that is no module."""
    return hash_state(detector.state_dict())[:12] if hasattr(detector, "state_dict") else ""


# ---------------------------------------------------------------- reading


def load_weights(path: str | Path) -> dict[str, Tensor]:
    """Tensors by name from a file or folder, on the CPU, in the types in which they are stored.

    Args:
        path: .safetensors: one file, or shards (any one of them, NAME.safetensors for NAME-00001-of-00003.safetensors,
            an index NAME.safetensors.index.json, or the folder). .pth, .pt, .ckpt, .bin: the state dict in a PyTorch
            checkpoint, also inside "state_dict", "model" or "ema" (averaged weights win), or of a pickled module.

    Raises:
        FormatError: The file cannot be read, or holds no such tensors.
    """
    place = Path(path).expanduser()
    if place.suffix in PICKLED and place.is_file():
        return _unwrapped(read_pickled(place))
    files = _parts(place)
    state: dict[str, Tensor] = {}
    for file in files:
        part = _read_safetensors(file)
        twice = next((name for name in part if name in state), None)
        if twice is not None:
            raise FormatError(f"{file}: '{twice}' is in another part as well; the parts are of different weights")
        state |= part
    if not state:
        raise FormatError(f"{place}: holds no tensors")
    return _unwrapped(state)


def _unwrapped(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Names without what parallel training puts before all of them."""
    while state and all(name.startswith("module.") for name in state):
        state = {name.removeprefix("module."): value for name, value in state.items()}
    return state


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    data = read_bytes(path, limit=MAX_BYTES)
    if data[:2] == b"PK" or data[:1] == b"\x80":
        raise FormatError(f"{path}: a pickle under the name of weights; it was not opened (rename it to .pth)")
    try:
        return dict(parse_safetensors(data))
    except (SafetensorError, ValueError, KeyError, RuntimeError, OverflowError) as error:
        raise FormatError(f"{path}: not a readable safetensors file: {' '.join(str(error).split())[:120]}") from None


def _parts(place: Path) -> list[Path]:
    """The files that make up weights."""
    if place.is_dir():
        indices = sorted(place.glob("*.index.json"))
        wholes = sorted(p for p in place.glob("*.safetensors") if SHARD.fullmatch(p.name) is None)
        stems = sorted({m["stem"] for p in place.glob("*.safetensors") if (m := SHARD.fullmatch(p.name))})
        if len(indices) == 1 and not wholes:
            return _indexed(indices[0])
        if len(wholes) + len(stems) == 1 and not indices:
            return wholes or _shards(place, stems[0])
        pickles = sorted(p for p in place.iterdir() if p.suffix in PICKLED)
        if len(pickles) == 1 and not wholes and not stems:
            raise FormatError(f"{place}: no safetensors there; name the file: {pickles[0]}")
        raise FormatError(f"{place}: {len(wholes) + len(stems) or 'no'} sets of weights there; name one file")
    if place.name.endswith(".index.json"):
        return _indexed(place)
    shard = SHARD.fullmatch(place.name)
    if shard:
        return _shards(place.parent, shard["stem"])
    if place.suffix == ".safetensors":
        if place.is_file():
            return [place]
        if any(SHARD.fullmatch(p.name) for p in place.parent.glob(f"{place.stem}-*.safetensors")):
            return _shards(place.parent, place.stem)
    if not place.exists():
        close = difflib.get_close_matches(place.name, _names(place.parent), n=3, cutoff=0.4)
        raise FormatError(f"{place}: no such file{f'; closest: {chr(44).join(close)}' if close else ''}")
    raise FormatError(f"{place}: weights are .safetensors or {', '.join(PICKLED)} files")


def _names(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir()] if folder.is_dir() else []


def _indexed(index: Path) -> list[Path]:
    """The files that an index (as other tools write it: weight_map) names."""
    held = read_json(index)
    table = held.get("weight_map") if isinstance(held, dict) else None
    if not isinstance(table, dict) or not all(isinstance(name, str) for name in table.values()):
        raise FormatError(f"{index}: not an index of safetensors: it needs weight_map, names to files")
    names = sorted(set(table.values()))
    if any(Path(name).name != name for name in names):
        raise FormatError(f"{index}: names files outside its own folder")
    return [index.parent / name for name in names]


def _shards(folder: Path, stem: str) -> list[Path]:
    """All parts of sharded weights. FormatError: some are missing, or sets of two sizes lie there."""
    found = {p.name: m for p in folder.glob("*.safetensors") if (m := SHARD.fullmatch(p.name)) and m["stem"] == stem}
    counts = {m["count"] for m in found.values()}
    if len(counts) != 1:
        raise FormatError(f"{folder / stem}: parts of {len(counts) or 'no'} sets there; remove those of older weights")
    count = int(counts.pop())
    wanted = _shard_names(stem, count) if count <= 10_000 else []
    missing = [name for name in wanted if name not in found]
    if missing or not wanted:
        raise FormatError(f"{folder / stem}: {len(missing)} of {count} parts are missing: {', '.join(missing[:3])}")
    return [folder / name for name in wanted]


def _shard_names(stem: str, count: int) -> list[str]:
    return [f"{stem}-{number:05d}-of-{count:05d}.safetensors" for number in range(1, count + 1)]


def read_card(path: str | Path) -> Card:
    """The card of weights.

    Args:
        path: NAME.json, NAME.safetensors or another file beside it.

    Raises:
        FormatError: The card is missing or broken.
    """
    place = Path(path).expanduser()
    shard = SHARD.fullmatch(place.name)
    file = place if place.suffix == ".json" else place.with_name(f"{shard['stem'] if shard else place.stem}.json")
    if not file.is_file():
        why = f"no card {file.name} beside it, which says what the weights are" if place.is_file() else "no such file"
        raise FormatError(f"{place}: {why}")
    data = read_json(file)
    known = {f.name for f in fields(Card)}
    kinds = {"data": str, "command": str, "seed": int, "classes": list, "metrics": dict, "config": dict, "hash": str}
    if not isinstance(data, dict) or not known - {"version"} <= data.keys():
        raise FormatError(f"{file}: not the card of weights: it needs {', '.join(sorted(known))}")
    wrong = [name for name, kind in kinds.items() if not isinstance(data[name], kind)]
    if wrong or not all(isinstance(name, str) for name in data["classes"]):
        raise FormatError(f"{file}: '{(wrong or ['classes'])[0]}' is of the wrong type")
    metrics = {name: float("nan") if value is None else value for name, value in data["metrics"].items()}
    if not all(isinstance(value, int | float) for value in metrics.values()):
        raise FormatError(f"{file}: a metric is no number")
    changed = {"classes": tuple(data["classes"]), "metrics": metrics}
    return Card(**{name: data[name] for name in known & data.keys()} | changed)


def load_card(path: str | Path) -> tuple[Card, dict[str, Tensor]]:
    """A card and the weights beside it, whose hash must be the card's.

    Raises:
        FormatError: The card or the weights are missing, broken, or do not belong together.
    """
    card = read_card(path)
    place = Path(path).expanduser()
    whole = place.with_suffix(".safetensors") if place.suffix == ".json" else place
    state = load_weights(whole)
    if hash_state(state) != card.hash:
        raise FormatError(f"{whole}: not the weights that their card describes (another hash); fetch both again")
    return card, state


# ---------------------------------------------------------------- writing


def save_weights(
    path: str | Path, state: Mapping[str, Tensor], *, card: Card, half: bool = False, shard_mb: float = 15.0
) -> Card:
    """Write NAME.safetensors (or its shards) and the card NAME.json; the same bytes for the same tensors.

    Every file is written whole or not at all, the card last; shards of older weights of this name are removed.

    Args:
        path: NAME.safetensors.
        state: Tensors by name.
        card: What the weights are; hash and version are filled in.
        half: Whether to store matrices and kernels as float16 where they fit; vectors (biases, norms) and integers stay
            as they are.
        shard_mb: Largest file in 10^6 bytes; a single tensor that is larger gets a file of its own.

    Returns:
        The card as written.

    Raises:
        ConfigError: There are no tensors, or some are NaN or infinite.
        StoreError: A file cannot be written.
    """
    target = Path(path).expanduser()
    if target.suffix != ".safetensors" or SHARD.fullmatch(target.name):
        raise ConfigError(f"{target}: name the file NAME.safetensors")
    if not state:
        raise ConfigError(f"{target}: no tensors to write")
    check_finite(state, str(target))
    stored = {name: _stored(value, half=half) for name, value in sorted(state.items())}
    card = replace(card, hash=hash_state(stored), version=card.version or __version__)
    text = _card_text(card, str(target))
    groups = _groups(stored, limit=int(shard_mb * 1e6))
    names = [target.name] if len(groups) == 1 else _shard_names(target.stem, len(groups))
    folder = make_folder(target.parent)
    for name, group in zip(names, groups, strict=True):
        write_atomic(folder / name, dump_safetensors(group, metadata={"ssad": card.hash}))
    for old in folder.glob(f"{target.stem}*.safetensors"):
        shard = SHARD.fullmatch(old.name)
        if (old == target or (shard and shard["stem"] == target.stem)) and old.name not in names:
            with contextlib.suppress(FileNotFoundError):
                try:
                    old.unlink()
                except PermissionError as error:
                    raise StoreError(f"{old}: cannot be removed: {error.strerror}") from None
    write_atomic(target.with_suffix(".json"), text + "\n")
    return card


def _card_text(card: Card, where: str) -> str:
    """The card as JSON; a metric that is no number (a class that the data lack) becomes null."""
    try:
        metrics = {name: float(v) if math.isfinite(v) else None for name, v in card.metrics.items()}
        return dump_json(asdict(card) | {"metrics": metrics}, indent=1)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: the card holds what JSON cannot: {error}") from None


def _stored(value: Tensor, *, half: bool) -> Tensor:
    value = value.detach().cpu().contiguous()
    if half and value.is_floating_point() and value.ndim > 1 and float(value.abs().max()) <= HALF_MAX:
        return value.half()
    return value.clone()  # tensors that share memory are refused by safetensors


def _groups(state: Mapping[str, Tensor], *, limit: int) -> list[dict[str, Tensor]]:
    """Tensors in the order of their names, cut where a file would become larger than `limit` bytes."""
    groups: list[dict[str, Tensor]] = [{}]
    size = 0
    for name, value in state.items():
        own = value.numel() * value.element_size() + len(name) + 120  # and its line in the header
        if groups[-1] and size + own > limit:
            groups.append({})
            size = 0
        groups[-1][name] = value
        size += own
    return groups


# ---------------------------------------------------------------- into a detector


def read_state(path: str | Path, key: str) -> dict[str, Any] | None:
    """The state of an interrupted training, whose own check is under `key`; None if there is none.

    Raises:
        FormatError: The file is broken or something else.
    """
    path = Path(path)
    if not path.is_file():
        return None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise FormatError(f"{path}: not a checkpoint of a training ({type(error).__name__}); delete it") from None
    if not isinstance(state, dict) or key not in state:
        raise FormatError(f"{path}: not a checkpoint of a training; delete it")
    return state


def check_finite(state: Mapping[str, Tensor], where: str) -> None:
    """Check that no tensor holds NaN or infinite values.

    Raises:
        FormatError: One does; `where` names the weights in the message.
    """
    for name, value in state.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            wrong = int((~value.isfinite()).sum())
            raise FormatError(f"{where}: '{name}' holds {wrong} NaN or infinite values of {value.numel()}")


def fit_state(module: nn.Module, state: Mapping[str, Tensor], where: str | Path) -> None:
    """Copy weights into a module whose names and shapes they must match; on an error the module stays as it was.

    Values are cast to the module's types. Missing counters of BatchNorm's steps are accepted.

    Args:
        module: The module.
        state: Tensors by name.
        where: Where they come from, for messages.

    Raises:
        FormatError: Names are missing or unknown, shapes differ, values are NaN or infinite, or weights are integers.
    """
    own = module.state_dict(keep_vars=True)
    name = str(getattr(module, "name", type(module).__name__))
    missing = [key for key in own if key not in state and not key.endswith(COUNTER)]
    foreign = [key for key in state if key not in own]
    if missing or foreign:
        parts = [_listed("missing", missing, foreign), _listed("foreign", foreign, missing)]
        raise FormatError(
            f"{where}: these are not the weights of {name}: {'; '.join(part for part in parts if part)} "
            f"(of {len(own)} names {sum(key in state for key in own)} fit)"
        )
    differ = {key: (tuple(v.shape), tuple(own[key].shape)) for key, v in state.items() if v.shape != own[key].shape}
    for key, (given, taken) in differ.items():
        why = _other_shapes(module, differ.values())
        raise FormatError(f"{where}: '{key}' has the shape {list(given)}, {name} takes {list(taken)}: {why}")
    for key, value in state.items():
        if own[key].is_floating_point() and not value.is_floating_point():
            kind = str(value.dtype).removeprefix("torch.")
            raise FormatError(f"{where}: '{key}' holds {kind} numbers, {name} takes floats (quantised weights?)")
    check_finite(state, str(where))
    with torch.no_grad():
        for key, value in state.items():
            own[key].copy_(value)


def start_from(module: nn.Module, state: Mapping[str, Tensor], where: str | Path) -> list[str]:
    """Copy the weights that fit into a module, to train it on; layers of another shape or name stay fresh.

    Args:
        module: The module, with fresh weights.
        state: Tensors by name.
        where: Where they come from, for messages.

    Returns:
        Names of the weights that stay fresh.

    Raises:
        FormatError: Fewer than four fifths of the module's weights are there, or values are NaN or infinite.
    """
    own = module.state_dict()
    shared = {key: value for key, value in state.items() if key in own and own[key].shape == value.shape}
    if len(shared) < 0.8 * len(own):
        fit_state(module, state, where)  # says what differs
    else:
        fit_state(module, {**own, **shared}, where)
    return [key for key in own if key not in shared and not key.endswith(COUNTER)]


def _listed(what: str, keys: list[str], others: Iterable[str]) -> str:
    if not keys:
        return ""
    close = difflib.get_close_matches(keys[0], list(others)[:2000], n=1, cutoff=0.5)
    hint = f" (closest: {close[0]})" if close else ""
    more = ", ..." if len(keys) > 3 else ""
    return f"{len(keys)} {what}: {', '.join(keys[:3])}{more}{hint}"


Shape = tuple[int, ...]


def _other_shapes(module: nn.Module, differ: Iterable[tuple[Shape, Shape]]) -> str:
    """A guess at why shapes (given, taken) differ: another number of classes if that explains all, or another width."""
    classes = len(getattr(module, "classes", ()))
    guesses: set[int] | None = None
    for given, taken in differ:
        axes = [axis for axis, (a, b) in enumerate(zip(given, taken, strict=False)) if a != b]
        here: set[int] = set()
        if len(given) == len(taken) and axes == [0] and classes:
            has, needs = given[0], taken[0]
            for extra in (0, 1, 4, 5):  # rows of a class head: anchors * (extra + classes)
                anchors, rest = divmod(needs, classes + extra)
                if anchors and not rest and has % anchors == 0 and has // anchors > extra:
                    here.add(has // anchors - extra)
        guesses = here if guesses is None else guesses & here
    if guesses:
        return f"made for {' or '.join(map(str, sorted(guesses)))} classes, this detector has {classes}"
    return "another width or variant of the detector"
