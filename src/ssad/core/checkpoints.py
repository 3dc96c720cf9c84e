"""Reading, writing and fitting of weights; each error is one line.

Nothing in a file is ever executed: safetensors holds numbers alone, and PyTorch's pickles are read by
`ssad.core.pickled`, which builds only tensors.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_safetensors
from safetensors.torch import save as dump_safetensors
from torch import Tensor, nn

from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.pickled import COUNTERS, MAX_BYTES, NESTS, read_pickled
from ssad.core.safeio import dump_json, make_folder, read_bytes, read_json, write_atomic
from ssad.core.version import __version__

PICKLED = (".pth", ".pt", ".ckpt", ".bin", ".tar")
SHARD = re.compile(r"(?P<stem>.+)-(?P<number>\d{5})-of-(?P<count>\d{5})\.safetensors")
HALF_MAX = 65504.0
WRAPPERS = ("module.", "_orig_mod.")
AVERAGE_PREFIXES = ("ema_model.", "model_ema.", "ema.", "ema_net.")
# What other frameworks keep beside the weights: the means that images are normalised with, anchors, and profiles
PREPROCESSOR = re.compile(
    r"(?:.*\.)?(?:pixel_mean|pixel_std|anchor_grid|anchors|total_ops|total_params)|data_preprocessor\..+"
)
COUNTER = "num_batches_tracked"  # BatchNorm's counter of training steps, which old files and frozen norms lack


@dataclass(frozen=True, slots=True)
class WeightsCard:
    """Description and origin of weights.

    Attributes:
        data: Training data.
        command: Command that reproduces the weights.
        seed: Seed of the training.
        classes: In the order of the logits.
        metrics: Measured on the data named in `data`.
        config: Options of the builder.
        hash: SHA-256 of the tensors as stored (`hash_state`); `save_weights` fills it in.
        version: Version of SSAD; `save_weights` fills it in.
        learned_from: Kind of images that the weights learned from, in words; "": not stated.
        photographs: Scores on photographs (docs/results/reality.md), by name; empty: not measured.
    """

    data: str
    command: str
    seed: int
    classes: tuple[str, ...]
    metrics: Mapping[str, float] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    hash: str = ""
    version: str = ""
    learned_from: str = ""
    photographs: Mapping[str, float] = field(default_factory=dict)


LATER_FIELDS = frozenset({"version", "learned_from", "photographs"})
"""Fields that older cards do not have."""


def hash_state(state: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 over names, types, shapes and bytes of the tensors, in the order of their names."""
    hasher = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().cpu().contiguous()
        hasher.update(f"{name}\x1f{value.dtype}\x1f{tuple(value.shape)}\x1e".encode())
        hasher.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return hasher.hexdigest()


def state_hash(detector: Any) -> str:
    """Return 12 hex digits over the weights of a detector; "" if it is no module."""
    return hash_state(detector.state_dict())[:12] if hasattr(detector, "state_dict") else ""


# ---------------------------------------------------------------- reading


def load_weights(path: str | Path) -> dict[str, Tensor]:
    """Return tensors by name from a file or folder, on the CPU, in the types in which they are stored.

    Args:
        path: .safetensors: one file, or shards (any one of them, NAME.safetensors for
            NAME-00001-of-00003.safetensors, an index NAME.safetensors.index.json, or the folder). .pth, .pt,
            .ckpt, .bin: the state dict in a PyTorch checkpoint, also inside "state_dict", "model" or "ema"
                (`ssad.core.pickled.NESTS`), or of a pickled module.

    Of several copies of the weights, in entries of a checkpoint or under prefixes of the names, the averaged one is
    loaded, and a line on standard error says which. Prefixes of parallel training are removed.

    Raises:
        FormatError: The file cannot be read, or holds no such tensors.
    """
    source = Path(path).expanduser()
    if source.suffix in PICKLED and source.is_file():
        pickled = read_pickled(source)
        copies = set(pickled.rest) & set(NESTS)
        if copies:
            kind = "averaged weights" if pickled.is_average else "weights"
            _say(f"{source}: loads the {kind} of '{'.'.join(pickled.entry)}'; not loaded: {', '.join(pickled.rest)}")
        return _select_copy(pickled.tensors, source)
    weights_files = _parts(source)
    state: dict[str, Tensor] = {}
    for weights_file in weights_files:
        tensors = _read_safetensors(weights_file)
        duplicate = next((name for name in tensors if name in state), None)
        if duplicate is not None:
            raise FormatError(
                f"{weights_file}: '{duplicate}' is in another part as well; the parts are of different weights"
            )
        state |= tensors
    if not state:
        raise FormatError(f"{source}: holds no tensors")
    return _select_copy(state, source)


def _say(message: str) -> None:
    """Print a line for the user, beside results on the standard output."""
    print(message, file=sys.stderr)


def _select_copy(state: dict[str, Tensor], source: Path) -> dict[str, Tensor]:
    """Return one copy of the weights, without prefixes and counters: of several the averaged one, which is printed."""
    state = _strip_prefixes(state)
    averages = {
        prefix: {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
        for prefix in AVERAGE_PREFIXES
    }
    for prefix, prefixed in averages.items():
        average = _strip_prefixes(prefixed)
        other_names = [name for name in state if not name.startswith(prefix)]
        if not average or not other_names:
            continue
        # Some frameworks take the dots out of the names of an average; its layers cannot be told then.
        if any("." in name for name in other_names) and not any("." in name for name in average):
            _say(f"{source}: the names of the averaged weights ({prefix}*) tell no layers; loads those beside them")
            return _strip_prefixes({name: state[name] for name in other_names})
        _say(f"{source}: loads the averaged weights '{prefix}*'; not loaded: {_examples(other_names)}")
        return average
    # mmcv exchanges averages and weights before it saves, so the names of the layers hold the averages.
    stored_names = {f"ema_{name.replace('.', '_')}" for name in state}
    exchanged_names = [name for name in state if name in stored_names]
    if exchanged_names:
        _say(
            f"{source}: loads what mmcv has averaged, by the names of layers; not loaded: {_examples(exchanged_names)}"
        )
    return {name: value for name, value in state.items() if name not in stored_names}


def _examples(names: Sequence[str]) -> str:
    """Return up to three names, and how many there are."""
    return ", ".join(names[:3]) + (f", ... ({len(names)} in all)" if len(names) > 3 else "")


def _strip_prefixes(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Remove the prefixes that parallel training, compiling and averaging add to all names but those of counters."""
    while True:
        names = [name for name in state if name not in COUNTERS]
        prefix = next((prefix for prefix in WRAPPERS if all(name.startswith(prefix) for name in names)), None)
        if prefix is None or not names:
            return state
        state = {name.removeprefix(prefix): state[name] for name in names}


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    content = read_bytes(path, limit=MAX_BYTES)
    if content[:2] == b"PK" or content[:1] == b"\x80":
        raise FormatError(f"{path}: a pickle under the name of weights; it was not opened (rename it to .pth)")
    try:
        return dict(parse_safetensors(content))
    except (SafetensorError, ValueError, KeyError, RuntimeError, OverflowError) as error:
        raise FormatError(f"{path}: not a readable safetensors file: {' '.join(str(error).split())[:120]}") from None


def _parts(path: Path) -> list[Path]:
    """The files that make up weights."""
    if path.is_dir():
        indices = sorted(path.glob("*.index.json"))
        single_files = sorted(
            candidate for candidate in path.glob("*.safetensors") if SHARD.fullmatch(candidate.name) is None
        )
        shard_stems = sorted(
            {
                shard_match["stem"]
                for candidate in path.glob("*.safetensors")
                if (shard_match := SHARD.fullmatch(candidate.name))
            }
        )
        if len(indices) == 1 and not single_files:
            return _read_shard_index(indices[0])
        if len(single_files) + len(shard_stems) == 1 and not indices:
            return single_files or _shards(path, shard_stems[0])
        pickle_files = sorted(candidate for candidate in path.iterdir() if candidate.suffix in PICKLED)
        if len(pickle_files) == 1 and not single_files and not shard_stems:
            raise FormatError(f"{path}: no safetensors there; name the file: {pickle_files[0]}")
        raise FormatError(
            f"{path}: {len(single_files) + len(shard_stems) or 'no'} sets of weights there; name one file"
        )
    if path.name.endswith(".index.json"):
        return _read_shard_index(path)
    shard = SHARD.fullmatch(path.name)
    if shard:
        return _shards(path.parent, shard["stem"])
    if path.suffix == ".safetensors":
        if path.is_file():
            return [path]
        if any(SHARD.fullmatch(candidate.name) for candidate in path.parent.glob(f"{path.stem}-*.safetensors")):
            return _shards(path.parent, path.stem)
    if not path.exists():
        close_matches = difflib.get_close_matches(path.name, _names(path.parent), n=3, cutoff=0.4)
        raise FormatError(f"{path}: no such file{f'; closest: {chr(44).join(close_matches)}' if close_matches else ''}")
    raise FormatError(f"{path}: weights are .safetensors or {', '.join(PICKLED)} files")


def _names(folder: Path) -> list[str]:
    return [entry.name for entry in folder.iterdir()] if folder.is_dir() else []


def _read_shard_index(index: Path) -> list[Path]:
    """Return the files named by an index of other tools (weight_map)."""
    content = read_json(index)
    weight_map = content.get("weight_map") if isinstance(content, dict) else None
    if not isinstance(weight_map, dict) or not all(isinstance(name, str) for name in weight_map.values()):
        raise FormatError(f"{index}: not an index of safetensors: it needs weight_map, names to files")
    names = sorted(set(weight_map.values()))
    # An index from elsewhere must not reach other folders.
    if any(Path(name).name != name for name in names):
        raise FormatError(f"{index}: names files outside its own folder")
    return [index.parent / name for name in names]


def _shards(folder: Path, stem: str) -> list[Path]:
    """Return all parts of sharded weights; raise FormatError if parts are missing or sets of two sizes exist."""
    shard_matches = {
        candidate.name: shard_match
        for candidate in folder.glob("*.safetensors")
        if (shard_match := SHARD.fullmatch(candidate.name)) and shard_match["stem"] == stem
    }
    counts = {shard_match["count"] for shard_match in shard_matches.values()}
    if len(counts) != 1:
        raise FormatError(f"{folder / stem}: parts of {len(counts) or 'no'} sets there; remove those of older weights")
    count = int(counts.pop())
    expected_names = _shard_names(stem, count) if count <= 10_000 else []
    missing = [name for name in expected_names if name not in shard_matches]
    if missing or not expected_names:
        raise FormatError(f"{folder / stem}: {len(missing)} of {count} parts are missing: {', '.join(missing[:3])}")
    return [folder / name for name in expected_names]


def _shard_names(stem: str, count: int) -> list[str]:
    return [f"{stem}-{number:05d}-of-{count:05d}.safetensors" for number in range(1, count + 1)]


def read_card(path: str | Path) -> WeightsCard:
    """Read the card of weights.

    Args:
        path: NAME.json, NAME.safetensors or another file beside it.

    Raises:
        FormatError: The card is missing or broken.
    """
    source = Path(path).expanduser()
    shard = SHARD.fullmatch(source.name)
    card_file = (
        source if source.suffix == ".json" else source.with_name(f"{shard['stem'] if shard else source.stem}.json")
    )
    if not card_file.is_file():
        reason = (
            f"no card {card_file.name} beside it, which says what the weights are"
            if source.is_file()
            else "no such file"
        )
        raise FormatError(f"{source}: {reason}")
    data = read_json(card_file)
    required_names = {card_field.name for card_field in fields(WeightsCard)}
    types_by_name = {
        "data": str,
        "command": str,
        "seed": int,
        "classes": list,
        "metrics": dict,
        "config": dict,
        "hash": str,
    }
    if not isinstance(data, dict) or not required_names - LATER_FIELDS <= data.keys():
        raise FormatError(f"{card_file}: not the card of weights: it needs {', '.join(sorted(required_names))}")
    types_by_name |= {name: kind for name, kind in (("learned_from", str), ("photographs", dict)) if name in data}
    mistyped = [name for name, expected_type in types_by_name.items() if not isinstance(data[name], expected_type)]
    if mistyped or not all(isinstance(name, str) for name in data["classes"]):
        raise FormatError(f"{card_file}: '{(mistyped or ['classes'])[0]}' is of the wrong type")
    metrics = {name: float("nan") if value is None else value for name, value in data["metrics"].items()}
    if not all(isinstance(value, int | float) for value in metrics.values()):
        raise FormatError(f"{card_file}: a metric is no number")
    converted = {"classes": tuple(data["classes"]), "metrics": metrics}
    return WeightsCard(**{name: data[name] for name in required_names & data.keys()} | converted)


def load_card(path: str | Path) -> tuple[WeightsCard, dict[str, Tensor]]:
    """Read a card and the weights beside it, whose hash must be the card's.

    Raises:
        FormatError: The card or the weights are missing, broken, or do not belong together.
    """
    card = read_card(path)
    source = Path(path).expanduser()
    weights_file = source.with_suffix(".safetensors") if source.suffix == ".json" else source
    state = load_weights(weights_file)
    if hash_state(state) != card.hash:
        raise FormatError(f"{weights_file}: not the weights that their card describes (another hash); fetch both again")
    return card, state


# ---------------------------------------------------------------- writing


def save_weights(
    path: str | Path, state: Mapping[str, Tensor], *, card: WeightsCard, half: bool = False, shard_mb: float = 15.0
) -> WeightsCard:
    """Write NAME.safetensors (or its shards) and the card NAME.json; the same bytes for the same tensors.

    Every file is written atomically, the card last; shards of older weights of this name are removed.

    Args:
        path: NAME.safetensors.
        state: Tensors by name.
        card: Description of the weights; hash and version are filled in.
        half: Whether to store matrices and kernels as float16 where they fit; vectors (biases, norms) and
            integers keep their type.
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
    stored = {name: _convert_for_storage(value, half=half) for name, value in sorted(state.items())}
    card = replace(card, hash=hash_state(stored), version=card.version or __version__)
    card_text = _card_text(card, str(target))
    groups = _groups(stored, limit=int(shard_mb * 1e6))
    names = [target.name] if len(groups) == 1 else _shard_names(target.stem, len(groups))
    folder = make_folder(target.parent)
    for name, group in zip(names, groups, strict=True):
        write_atomic(folder / name, dump_safetensors(group, metadata={"ssad": card.hash}))
    # Left-over shards of another number would make the folder ambiguous for `load_weights`.
    for existing in folder.glob(f"{target.stem}*.safetensors"):
        shard = SHARD.fullmatch(existing.name)
        if (existing == target or (shard and shard["stem"] == target.stem)) and existing.name not in names:
            with contextlib.suppress(FileNotFoundError):
                try:
                    existing.unlink()
                except PermissionError as error:
                    raise StoreError(f"{existing}: cannot be removed: {error.strerror}") from None
    # Last: the hash in the card vouches for complete weights.
    write_atomic(target.with_suffix(".json"), card_text + "\n")
    return card


def _card_text(card: WeightsCard, origin: str) -> str:
    """Return the card as JSON; a NaN metric (a class absent from the data) becomes null."""
    try:
        metrics = {name: float(metric) if math.isfinite(metric) else None for name, metric in card.metrics.items()}
        return dump_json(asdict(card) | {"metrics": metrics}, indent=1)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{origin}: the card holds what JSON cannot: {error}") from None


def _convert_for_storage(value: Tensor, *, half: bool) -> Tensor:
    value = value.detach().cpu().contiguous()
    if half and value.is_floating_point() and value.ndim > 1 and float(value.abs().max()) <= HALF_MAX:
        return value.half()
    return value.clone()  # tensors that share memory are refused by safetensors


def _groups(state: Mapping[str, Tensor], *, limit: int) -> list[dict[str, Tensor]]:
    """Group tensors in the order of their names, split where a file would exceed `limit` bytes."""
    groups: list[dict[str, Tensor]] = [{}]
    group_size = 0
    for name, value in state.items():
        tensor_size = value.numel() * value.element_size() + len(name) + 120  # and its line in the header
        if groups[-1] and group_size + tensor_size > limit:
            groups.append({})
            group_size = 0
        groups[-1][name] = value
        group_size += tensor_size
    return groups


# ---------------------------------------------------------------- into a detector


def read_state(path: str | Path, key: str) -> dict[str, Any] | None:
    """Read the state of an interrupted training; None if there is none.

    Args:
        path: The checkpoint file.
        key: Key that a training's checkpoint has.

    Raises:
        FormatError: The file is broken or something else.
    """
    path = Path(path)
    if not path.is_file():
        return None
    try:
        # weights_only: a pickle could run code.
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise FormatError(f"{path}: not a checkpoint of a training ({type(error).__name__}); delete it") from None
    if not isinstance(state, dict) or key not in state:
        raise FormatError(f"{path}: not a checkpoint of a training; delete it")
    return state


def check_finite(state: Mapping[str, Tensor], origin: str) -> None:
    """Check that no tensor holds NaN or infinite values.

    Raises:
        FormatError: A tensor does; `origin` names the weights in the message.
    """
    for name, value in state.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            invalid_count = int((~value.isfinite()).sum())
            raise FormatError(f"{origin}: '{name}' holds {invalid_count} NaN or infinite values of {value.numel()}")


def copy_state(module: nn.Module, state: Mapping[str, Tensor], origin: str | Path) -> None:
    """Copy weights into a module of the same names and shapes; on an error the module stays unchanged.

    Values are cast to the module's types. Counters of BatchNorm's steps may be missing or in excess. Buffers of other
    frameworks that prepare images, anchors and profiles are left out, and a line on standard error names them.

    Args:
        module: The module.
        state: Tensors by name.
        origin: Origin of the weights, for messages.

    Raises:
        FormatError: Names are missing or unknown, shapes differ, values are NaN or infinite, or weights are
            integers.
    """
    parameters = module.state_dict(keep_vars=True)
    name = str(getattr(module, "name", type(module).__name__))
    foreign_buffers = {key: state[key] for key in state if key not in parameters and PREPROCESSOR.fullmatch(key)}
    left_out = {key for key in state if key.endswith(COUNTER) and key.replace(COUNTER, "running_var") in parameters}
    left_out = (left_out | foreign_buffers.keys()) - parameters.keys()
    state = {key: value for key, value in state.items() if key not in left_out}
    missing = [key for key in parameters if key not in state and not key.endswith(COUNTER)]
    unexpected = [key for key in state if key not in parameters]
    if missing or unexpected:
        problems = [_describe_keys("missing", missing, unexpected), _describe_keys("foreign", unexpected, missing)]
        raise FormatError(
            f"{origin}: these are not the weights of {name}: {'; '.join(problem for problem in problems if problem)} "
            f"(of {len(parameters)} names {sum(key in state for key in parameters)} fit)"
        )
    shape_differences = {
        key: (tuple(tensor.shape), tuple(parameters[key].shape))
        for key, tensor in state.items()
        if tensor.shape != parameters[key].shape
    }
    for key, (source_shape, target_shape) in shape_differences.items():
        reason = _explain_shape_mismatch(module, shape_differences.values())
        raise FormatError(
            f"{origin}: '{key}' has the shape {list(source_shape)}, {name} takes {list(target_shape)}: {reason}"
        )
    for key, value in state.items():
        if parameters[key].is_floating_point() and not value.is_floating_point():
            dtype_name = str(value.dtype).removeprefix("torch.")
            raise FormatError(f"{origin}: '{key}' holds {dtype_name} numbers, {name} takes floats (quantised weights?)")
    check_finite(state, str(origin))
    if foreign_buffers:
        described = ", ".join(f"{key} {_values(value)}" for key, value in foreign_buffers.items())
        _say(f"{origin}: not loaded, since {name} has its own: {described}")
    with torch.no_grad():
        for key, value in state.items():
            parameters[key].copy_(value)


def _values(value: Tensor) -> str:
    """Return up to three numbers of a tensor, or its shape."""
    return str([round(number, 4) for number in value.flatten().tolist()] if value.numel() <= 3 else list(value.shape))


def copy_matching_weights(module: nn.Module, state: Mapping[str, Tensor], origin: str | Path) -> list[str]:
    """Copy the weights that fit into a module as a start of training; layers of another shape or name stay fresh.

    Args:
        module: The module, with fresh weights.
        state: Tensors by name.
        origin: Origin of the weights, for messages.

    Returns:
        Names of the weights that stay fresh.

    Raises:
        FormatError: Fewer than four fifths of the module's weights are present, or values are NaN or infinite.
    """
    fresh_state = module.state_dict()
    shared_weights = {
        key: value for key, value in state.items() if key in fresh_state and fresh_state[key].shape == value.shape
    }
    if len(shared_weights) < 0.8 * len(fresh_state):
        copy_state(module, state, origin)  # raises an error that lists the differences
    else:
        copy_state(module, {**fresh_state, **shared_weights}, origin)
    return [key for key in fresh_state if key not in shared_weights and not key.endswith(COUNTER)]


def _describe_keys(relation: str, keys: list[str], other_keys: Iterable[str]) -> str:
    if not keys:
        return ""
    close_matches = difflib.get_close_matches(keys[0], list(other_keys)[:2000], n=1, cutoff=0.5)
    hint = f" (closest: {close_matches[0]})" if close_matches else ""
    ellipsis = ", ..." if len(keys) > 3 else ""
    return f"{len(keys)} {relation}: {', '.join(keys[:3])}{ellipsis}{hint}"


Shape = tuple[int, ...]


def _explain_shape_mismatch(module: nn.Module, shape_pairs: Iterable[tuple[Shape, Shape]]) -> str:
    """A guess at why shapes (given, taken) differ: another number of classes if that explains all, or another width."""
    classes = len(getattr(module, "classes", ()))
    possible_counts: set[int] | None = None
    for source_shape, target_shape in shape_pairs:
        axes = [
            axis
            for axis, (source_length, target_length) in enumerate(zip(source_shape, target_shape, strict=False))
            if source_length != target_length
        ]
        candidates: set[int] = set()
        if len(source_shape) == len(target_shape) and axes == [0] and classes:
            source_rows, target_rows = source_shape[0], target_shape[0]
            for extra in (0, 1, 4, 5):  # rows of a class head: anchors * (extra + classes)
                anchors, remainder = divmod(target_rows, classes + extra)
                if anchors and not remainder and source_rows % anchors == 0 and source_rows // anchors > extra:
                    candidates.add(source_rows // anchors - extra)
        # Only a class count that explains every differing layer is worth naming.
        possible_counts = candidates if possible_counts is None else possible_counts & candidates
    if possible_counts:
        return f"made for {' or '.join(map(str, sorted(possible_counts)))} classes, this detector has {classes}"
    return "another width or variant of the detector"
