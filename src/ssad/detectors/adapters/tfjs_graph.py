"""Graph models of TensorFlow.js: read from a folder or an npm archive, and executed by PyTorch with gradients.

A graph model is a JSON file, with the nodes of a frozen TensorFlow graph and a manifest of its weights, and the binary
files that the manifest names. Only tensors and names are read; nothing in the files runs.

Sources: the format of @tensorflow/tfjs-converter 4 (`graph-model`, weights manifest, float16 quantisation), and the
definitions of TensorFlow's operations (padding SAME, legacy bilinear resizing, fused convolutions).
"""

from __future__ import annotations

import base64
import math
import tarfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.errors import FormatError
from ssad.core.folders import path_inside
from ssad.core.safeio import MIB, parse_json, read_bytes

MAX_TOPOLOGY_BYTES: Final = 64 * MIB
MAX_WEIGHT_BYTES: Final = 512 * MIB
MAX_ARCHIVE_BYTES: Final = 1024 * MIB  # unpacked bytes of an archive that are passed before the search ends
ARCHIVES: Final = (".tgz", ".tar.gz", ".tar")
NUMBER_TYPES: Final = {"float32": np.float32, "float16": np.float16, "int32": np.int32}
CHANNEL_AXES: Final = {0: 0, 1: 2, 2: 3, 3: 1, -1: 1, -2: 3, -3: 2}
"""Axis of [B, H, W, C] -> axis of [B, C, H, W]."""


@dataclass(frozen=True, slots=True)
class Node:
    """Operation of a graph.

    Attributes:
        name: Name of its output.
        op: Type of the operation.
        inputs: Names of its inputs.
        attributes: Attributes as the file has them.
    """

    name: str
    op: str
    inputs: tuple[str, ...]
    attributes: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class GraphFile:
    """Content of a graph model.

    Attributes:
        source: File, for messages.
        nodes: Nodes by name.
        weights: Values of the constants, float32 or int32, by name.
    """

    source: str
    nodes: Mapping[str, Node]
    weights: Mapping[str, np.ndarray[Any, Any]]


def read_graph_file(path: Path, model: str) -> GraphFile:
    """Read a graph model.

    Args:
        path: The JSON file of the model, a folder, or an archive as `npm pack` writes it, which is not unpacked.
        model: Path of the JSON file inside of a folder or an archive, such as models/centernet.json.

    Raises:
        FormatError: There is no such model, or it is broken.
    """
    source, topology, read_weights = _open(path, model)
    content = parse_json(topology, source)
    try:
        nodes = {
            str(graph_node["name"]): Node(
                str(graph_node["name"]),
                str(graph_node["op"]),
                tuple(map(str, graph_node.get("input", ()))),
                graph_node.get("attr", {}),
            )
            for graph_node in content["modelTopology"]["node"]
        }
        weights: dict[str, np.ndarray[Any, Any]] = {}
        for group in content["weightsManifest"]:
            data = b"".join(read_weights(str(name)) for name in group["paths"])
            weights |= _parse_weights(group["weights"], data)
    except FormatError as error:
        raise FormatError(f"{source}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(f"{source}: no graph model of TensorFlow.js ({type(error).__name__}: {error})") from None
    return GraphFile(source, nodes, weights)


def _open(path: Path, model: str) -> tuple[str, bytes, Callable[[str], bytes]]:
    """Return the name of a model, the bytes of its JSON file, and a function that reads files beside it."""
    if path.is_dir():
        path = path / model
    if not path.is_file():
        raise FormatError(f"{path}: no such file; give the archive of the package, or its folder")
    if not path.name.endswith(ARCHIVES):
        folder = path.parent
        return (
            str(path),
            read_bytes(path, limit=MAX_TOPOLOGY_BYTES),
            lambda name: read_bytes(path_inside(folder, name), limit=MAX_WEIGHT_BYTES),
        )
    files = _read_archive(path, model)

    def read_member(name: str) -> bytes:
        if name not in files:
            raise FormatError(f"no file {name} beside {model}")
        return files[name]

    return f"{path}:{model}", read_member(Path(model).name), read_member


def _read_archive(path: Path, model: str) -> dict[str, bytes]:
    """Return the files of an archive that lie in the folder of a model and begin with its name, by file name."""
    folder, stem = Path(model).parent, Path(model).stem
    files: dict[str, bytes] = {}
    passed_bytes = 0
    try:
        with tarfile.open(path) as archive:
            for member in archive:
                passed_bytes += member.size
                if passed_bytes > MAX_ARCHIVE_BYTES:
                    raise FormatError(f"{path}: more than {MAX_ARCHIVE_BYTES // MIB} MiB unpacked; not this archive")
                name = Path(member.name)
                is_model_file = name.parent.parts[-len(folder.parts) :] == folder.parts and name.name.startswith(stem)
                if not is_model_file or not member.isfile():
                    continue
                limit = MAX_TOPOLOGY_BYTES if name.suffix == ".json" else MAX_WEIGHT_BYTES
                if member.size > limit:
                    raise FormatError(f"{path}: {member.name}: more than {limit // MIB} MiB")
                content = archive.extractfile(member)
                if content is not None:
                    files[name.name] = content.read()
    except (tarfile.TarError, OSError, EOFError, ValueError) as error:
        raise FormatError(f"{path}: cannot be read as an archive ({type(error).__name__}: {error})") from None
    if Path(model).name not in files:
        raise FormatError(f"{path}: no {model} in the archive")
    return files


def _parse_weights(entries: Sequence[Mapping[str, Any]], data: bytes) -> dict[str, np.ndarray[Any, Any]]:
    """Return the tensors of a group of the manifest."""
    weights: dict[str, np.ndarray[Any, Any]] = {}
    start_byte = 0
    for entry in entries:
        name = str(entry["name"])
        tensor_shape = tuple(int(length) for length in entry["shape"])
        stored_type = str((entry.get("quantization") or {}).get("dtype", entry["dtype"]))
        if stored_type not in NUMBER_TYPES or min(tensor_shape, default=1) < 0:
            raise FormatError(f"weight {name}: {stored_type} of shape {list(tensor_shape)} is not read")
        dtype = np.dtype(NUMBER_TYPES[stored_type]).newbyteorder("<")
        end = start_byte + math.prod(tensor_shape) * dtype.itemsize
        if end > len(data):
            raise FormatError(f"weight {name}: the file of weights is too short ({len(data)} bytes)")
        values = np.frombuffer(data[start_byte:end], dtype).reshape(tensor_shape)
        weights[name] = values.astype(np.int32 if stored_type == "int32" else np.float32)
        if not np.isfinite(weights[name]).all():
            raise FormatError(f"weight {name}: a value is not finite")
        start_byte = end
    if start_byte != len(data):
        raise FormatError(f"the file of weights has {len(data)} bytes, the manifest {start_byte}")
    return weights


class GraphModel(nn.Module):
    """Part of a graph that leads from one input to some outputs, as a frozen module.

    Images and maps are [B, C, H, W], though the graph has [B, H, W, C].

    Args:
        graph: The graph.
        outputs: Names of the outputs.

    Raises:
        FormatError: A node is missing, or has an operation or attribute that is not supported.
    """

    def __init__(self, graph: GraphFile, outputs: Sequence[str]) -> None:
        super().__init__()
        self.source = graph.source
        self.outputs = tuple(outputs)
        self.order = _sort_nodes(graph, outputs)
        placeholders = [graph_node for graph_node in self.order if graph_node.op == "Placeholder"]
        if len(placeholders) != 1:
            raise FormatError(f"{graph.source}: {len(placeholders)} inputs, expected one")
        self.input = placeholders[0].name
        self.input_size = _input_size(graph.source, placeholders[0])
        self.constants = {
            graph_node.name: graph.weights[graph_node.name]
            for graph_node in self.order
            if graph_node.op == "Const" and graph.weights
        }
        self.weights = nn.ParameterDict()
        for graph_node in self.order:
            if graph_node.op not in OPERATIONS:
                raise FormatError(
                    f"{graph.source}: node {graph_node.name}: the operation {graph_node.op} is not supported"
                )
            if graph_node.op in CONVOLUTIONS:
                self._add_convolution(graph_node)
        self.requires_grad_(False).eval()

    def _add_convolution(self, graph_node: Node) -> None:
        """Store the kernel of a convolution as PyTorch has it, and its bias."""
        values = [self.constants.get(name) for name in graph_node.inputs[1:]]
        kernel = values[0] if values else None
        if kernel is None or kernel.ndim != 4 or any(value is None for value in values):
            raise FormatError(f"{self.source}: node {graph_node.name}: its kernel or bias is no constant")
        if "Depthwise" in graph_node.op:  # [h, w, in, multiplier] to [in * multiplier, 1, h, w]
            kernel = kernel.transpose(2, 3, 0, 1).reshape(-1, 1, *kernel.shape[:2])
        else:  # [h, w, in, out] to [out, in, h, w]
            kernel = kernel.transpose(3, 2, 0, 1)
        self.weights[_key(graph_node.name)] = nn.Parameter(torch.from_numpy(np.ascontiguousarray(kernel)))
        if len(values) > 1:
            bias_values = np.ascontiguousarray(values[1])
            if bias_values.shape != kernel.shape[:1]:
                raise FormatError(
                    f"{self.source}: node {graph_node.name}: bias {list(bias_values.shape)} of a kernel for "
                    f"{kernel.shape[0]} maps"
                )
            self.weights[_key(graph_node.name, "bias")] = nn.Parameter(torch.from_numpy(bias_values))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs for images [B, C, H, W] of `input_size`.

        Raises:
            FormatError: The shapes of the graph do not fit together.
        """
        values: dict[str, Tensor] = {self.input: images}
        for graph_node in self.order:
            if graph_node.op in ("Placeholder", "Const"):
                continue
            try:
                values[graph_node.name] = OPERATIONS[graph_node.op](self, graph_node, values)
            except (RuntimeError, KeyError, IndexError, TypeError) as error:
                reason = " ".join(str(error).split())[:120]
                raise FormatError(f"{self.source}: node {graph_node.name} ({graph_node.op}): {reason}") from None
        return tuple(values[name] for name in self.outputs)

    def operand(self, name: str, values: Mapping[str, Tensor], template: Tensor | None = None) -> Tensor:
        """Return a value of the graph, or a constant that broadcasts over maps."""
        if name in values:
            return values[name]
        constant = torch.from_numpy(self.constants[name])
        if constant.ndim == 1:
            constant = constant[:, None, None]
        elif constant.ndim == 4:
            constant = constant.permute(0, 3, 1, 2)
        elif constant.ndim:
            raise KeyError(f"constant {name} of {constant.ndim} dimensions")
        return constant if template is None else constant.to(template)


def _key(name: str, kind: str = "kernel") -> str:
    """Return the name of a parameter: a module takes no dots."""
    return f"{name}/{kind}".replace(".", "_")


def _sort_nodes(graph: GraphFile, outputs: Sequence[str]) -> list[Node]:
    """Return the nodes that outputs need, each after its inputs."""
    ordered: dict[str, Node] = {}
    open_names: set[str] = set()
    pending = [(name, False) for name in reversed(outputs)]
    while pending:
        name, are_inputs_done = pending.pop()
        if name in ordered:
            continue
        graph_node = graph.nodes.get(name)
        if graph_node is None:
            raise FormatError(f"{graph.source}: no node '{name}'")
        if are_inputs_done:
            ordered[name] = graph_node
            continue
        if name in open_names:
            raise FormatError(f"{graph.source}: node '{name}' depends on itself")
        open_names.add(name)
        if graph_node.op == "Const" and name not in graph.weights:
            raise FormatError(f"{graph.source}: constant '{name}' has no value in the manifest")
        pending.append((name, True))
        pending.extend((input_name, False) for input_name in reversed(graph_node.inputs))
    return list(ordered.values())


def _input_size(source: str, graph_node: Node) -> tuple[int, int]:
    """Return height and width of the input [1, H, W, 3]."""
    try:
        tensor_shape = [int(length["size"]) for length in graph_node.attributes["shape"]["shape"]["dim"]]
    except (KeyError, TypeError, ValueError):
        tensor_shape = []
    if len(tensor_shape) != 4 or tensor_shape[3] != 3 or not 0 < min(tensor_shape[1:]) <= max(tensor_shape[1:]) <= 4096:
        raise FormatError(f"{source}: input '{graph_node.name}' of shape {tensor_shape}; expected [1, H, W, 3]")
    return tensor_shape[1], tensor_shape[2]


# ---------------------------------------------------------------- operations


def _text(graph_node: Node, name: str) -> str:
    """Return an attribute that is a text, which the file holds in base64."""
    return base64.b64decode(graph_node.attributes[name]["s"]).decode()


def _integers(graph_node: Node, name: str) -> list[int]:
    return [int(value) for value in graph_node.attributes[name]["list"]["i"]]


def pad_same(images: Tensor, kernel: Sequence[int], stride: Sequence[int], *, value: float = 0.0) -> Tensor:
    """Pad images [B, C, H, W] as TensorFlow's SAME does: what cannot be halved goes to the bottom and the right.

    Args:
        images: The images.
        kernel: Height and width of the kernel, dilated.
        stride: Vertical and horizontal stride.
        value: Value of the padding.
    """
    padding: list[int] = []
    for length, size, step in zip(reversed(images.shape[2:]), reversed(kernel), reversed(stride), strict=True):
        total = max((-(-length // step) - 1) * step + size - length, 0)
        padding += [total // 2, total - total // 2]
    return functional.pad(images, padding, value=value) if any(padding) else images


def _convolve(model: GraphModel, graph_node: Node, values: Mapping[str, Tensor]) -> Tensor:
    images = model.operand(graph_node.inputs[0], values)
    kernel = model.weights[_key(graph_node.name)].to(images.dtype)
    bias_key = _key(graph_node.name, "bias")
    bias_values = model.weights[bias_key].to(images.dtype) if bias_key in model.weights else None
    _, *stride, _ = _integers(graph_node, "strides")
    _, *dilation, _ = _integers(graph_node, "dilations") if "dilations" in graph_node.attributes else [1, 1, 1, 1]
    if _text(graph_node, "padding") == "SAME":
        reach = [(length - 1) * step + 1 for length, step in zip(kernel.shape[2:], dilation, strict=True)]
        images = pad_same(images, reach, stride)
    elif _text(graph_node, "padding") != "VALID":
        raise KeyError(f"padding {_text(graph_node, 'padding')} is not supported")
    groups = images.shape[1] if "Depthwise" in graph_node.op else 1
    convolved = functional.conv2d(images, kernel, bias_values, tuple(stride), 0, tuple(dilation), groups)
    fused = graph_node.attributes.get("fused_ops", {}).get("list", {}).get("s", [])
    for name in (base64.b64decode(text).decode() for text in fused):
        if name == "Relu":
            convolved = convolved.relu()
        elif name == "Relu6":
            convolved = convolved.clamp(0, 6)
        elif name != "BiasAdd":
            raise KeyError(f"the fused operation {name} is not supported")
    return convolved


def _combine(model: GraphModel, graph_node: Node, values: Mapping[str, Tensor]) -> Tensor:
    template = next(values[name] for name in graph_node.inputs if name in values)
    first, second = (model.operand(name, values, template) for name in graph_node.inputs)
    if graph_node.op == "Mul":
        return first * second
    return first - second if graph_node.op == "Sub" else first + second


def _mean(model: GraphModel, graph_node: Node, values: Mapping[str, Tensor]) -> Tensor:
    axes = [CHANNEL_AXES[int(axis)] for axis in np.atleast_1d(model.constants[graph_node.inputs[1]])]
    if not graph_node.attributes.get("keep_dims", {}).get("b", False):
        raise KeyError("a mean that drops axes is not supported")
    return values[graph_node.inputs[0]].mean(axes, keepdim=True)


def _concatenate(model: GraphModel, graph_node: Node, values: Mapping[str, Tensor]) -> Tensor:
    *names, axis = graph_node.inputs
    return torch.cat([values[name] for name in names], CHANNEL_AXES[int(model.constants[axis])])


def _resize(model: GraphModel, graph_node: Node, values: Mapping[str, Tensor]) -> Tensor:
    flags = {
        name: graph_node.attributes.get(name, {}).get("b", False) for name in ("align_corners", "half_pixel_centers")
    }
    if any(flags.values()):
        raise KeyError("only legacy bilinear resizing is supported")
    images = values[graph_node.inputs[0]]
    height, width = (int(length) for length in model.constants[graph_node.inputs[1]])
    rows, columns = (
        _interpolation(old_length, new_length).to(images)
        for old_length, new_length in zip(images.shape[2:], (height, width), strict=True)
    )
    return rows @ images @ columns.T


def _interpolation(old_length: int, new_length: int) -> Tensor:
    """Return the matrix [new, old] of TensorFlow's legacy resizing, whose pixel i lies at i * old / new."""
    position = torch.arange(new_length, dtype=torch.float64) * old_length / new_length
    low = position.floor().long().clamp(max=old_length - 1)
    high = (low + 1).clamp(max=old_length - 1)
    share = (position - low)[:, None]
    return functional.one_hot(low, old_length) * (1 - share) + functional.one_hot(high, old_length) * share


OPERATIONS: Final[Mapping[str, Callable[[GraphModel, Node, Mapping[str, Tensor]], Tensor]]] = {
    "Placeholder": lambda model, graph_node, values: values[graph_node.name],
    "Const": lambda model, graph_node, values: values[graph_node.name],
    "Identity": lambda model, graph_node, values: values[graph_node.inputs[0]],
    "Relu": lambda model, graph_node, values: values[graph_node.inputs[0]].relu(),
    "Relu6": lambda model, graph_node, values: values[graph_node.inputs[0]].clamp(0, 6),
    "Sigmoid": lambda model, graph_node, values: values[graph_node.inputs[0]].sigmoid(),
    "Add": _combine,
    "AddV2": _combine,
    "Sub": _combine,
    "Mul": _combine,
    "Mean": _mean,
    "ConcatV2": _concatenate,
    "ResizeBilinear": _resize,
    "Conv2D": _convolve,
    "_FusedConv2D": _convolve,
    "DepthwiseConv2dNative": _convolve,
    "FusedDepthwiseConv2dNative": _convolve,
}
CONVOLUTIONS: Final = frozenset(name for name, run in OPERATIONS.items() if run is _convolve)
