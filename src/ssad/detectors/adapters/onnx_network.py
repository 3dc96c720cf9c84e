"""Networks in ONNX files as modules of PyTorch, with gradients: read, checked, rewritten for onnx2torch, and run.

A file is data: nothing in it runs but the operators of ONNX that onnx2torch knows. Weights beside it are read from
its own folder only.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ssad.core.errors import FormatError, MissingExtraError
from ssad.core.pickled import MAX_BYTES
from ssad.core.safeio import read_bytes

OPSET = 17  # onnx2torch 1.5 knows the operators as this version of ONNX has them, and few later ones
# These pick boxes, cells or classes: behind them there are no dense outputs, and no gradient to what was not picked.
SELECTIONS = frozenset({"NonMaxSuppression", "TopK", "NonZero", "ArgMax", "RoiAlign"})
REDUCTIONS = frozenset(
    {"ReduceL1", "ReduceL2", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd", "ReduceSumSquare"}
)
# Attributes that later versions added, with the values that mean what the operator did before
ADDED_ATTRIBUTES: Mapping[str, Mapping[str, object]] = {
    "Resize": {"antialias": 0, "keep_aspect_ratio_policy": b"stretch"},
    **{name: {"noop_with_empty_axes": 0} for name in REDUCTIONS},
}
MAX_METADATA = 1 << 20


class OnnxNetwork(nn.Module):
    """A network of an ONNX file. Starts frozen and in eval mode.

    Attributes:
        path: The file.
        batch: Images that it takes at once; None: any number.
        size: Height and width that it takes; None for an axis of any length.
        metadata: What the exporter wrote beside the graph, texts by name.
        operators: Operators of the graph.
        output_names: Names of the outputs.
        tails: Operators between the last convolutions and each output.
        normalises: Whether the graph does arithmetic on the image before its first layer.
    """

    def __init__(self, path: Path, model: Any, graph: nn.Module, content_hash: str) -> None:
        super().__init__()
        self.path = path
        self.graph = graph
        image = model.graph.input[0]
        axes = [axis.dim_value if axis.dim_value > 0 else None for axis in image.type.tensor_type.shape.dim]
        self.batch, self.size = axes[0], (axes[2], axes[3])
        self.metadata = {entry.key: entry.value for entry in model.metadata_props}
        self.operators = frozenset(node.op_type for node in model.graph.node)
        self.output_names = tuple(output.name for output in model.graph.output)
        self.tails = tuple(_tail_operators(model, name) for name in self.output_names)
        self.normalises = any(
            node.op_type in {"Sub", "Add", "Div", "Mul"} for node in model.graph.node if image.name in node.input
        )
        # The graph is no part of the state, but the hash of a detector's state must tell two graphs apart.
        digits = torch.tensor([int(content_hash[index : index + 2], 16) for index in range(0, 64, 2)])
        self.register_buffer("content_hash", digits)
        self.requires_grad_(False).eval()

    def forward(self, images: Tensor) -> list[Tensor]:
        """Return all outputs for images [B, 3, H, W] of the size that the network takes.

        Args:
            images: [B, 3, H, W]; a network of a fixed batch sees them in parts, the last one filled up.
        """
        if self.batch is None or self.batch == len(images):
            return self._run(images)
        parts = []
        for part in torch.split(images, self.batch):
            missing = self.batch - len(part)
            filled = torch.cat((part, part[-1:].detach().expand(missing, -1, -1, -1))) if missing else part
            parts.append([output[: len(part)] for output in self._run(filled)])
        return [torch.cat(outputs) for outputs in zip(*parts, strict=True)]

    def _run(self, images: Tensor) -> list[Tensor]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # onnx2torch slices by lists, which torch warns of
            outputs = self.graph(images)
        return list(outputs) if isinstance(outputs, list | tuple) else [outputs]


def read_network(path: str | Path) -> OnnxNetwork:
    """Read an ONNX file of a detector as a differentiable module, on the CPU, in float32.

    Args:
        path: The file; weights that were exported into files beside it are read too.

    Raises:
        MissingExtraError: The extra `onnx` is not installed.
        FormatError: The file is broken, takes something else than images of floats, or has operators that are not
            supported; the message names them.
    """
    source = Path(path).expanduser()
    try:
        onnx, onnx2torch = (importlib.import_module(name) for name in ("onnx", "onnx2torch"))
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"detector 'onnx:{source}'", "onnx" if error.name == "onnx" else "onnx2torch") from None
    model, content_hash = _parse(onnx, source)
    _remove_copies(onnx, model)
    _lower_opset(onnx, model)
    _check_operators(model, source)
    _check_input(onnx, model, source)
    try:
        graph = onnx2torch.convert(model)
    except Exception as error:  # what the converters raise for attributes that they do not know
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FormatError(
            f"{source}: an operator is used in a way that onnx2torch does not support: {reason}"
        ) from None
    return OnnxNetwork(source, model, graph, content_hash)


def class_names(network: OnnxNetwork) -> tuple[str, ...] | None:
    """Return the names of the classes in the metadata of Ultralytics' exports; None if there are none.

    Raises:
        FormatError: The metadata hold something else under `names`.
    """
    text = network.metadata.get("names")
    if text is None:
        return None
    try:
        names = ast.literal_eval(text) if len(text) <= MAX_METADATA else None
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        names = None
    if isinstance(names, dict) and sorted(names, key=str) == sorted(range(len(names)), key=str):
        names = [names[index] for index in range(len(names))]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise FormatError(f"{network.path}: its metadata hold no names of classes; give them: ?classes=names.txt")
    return tuple(names)


def _parse(onnx: Any, path: Path) -> tuple[Any, str]:
    """Return the model with all weights, and the SHA-256 of its files."""
    content = read_bytes(path, limit=MAX_BYTES)
    hasher = hashlib.sha256(content)
    try:
        model = onnx.load_model_from_string(content)
        # Graphs within graphs are refused later: `If` and `Loop` are not supported.
        external = [tensor for tensor in model.graph.initializer if tensor.data_location == onnx.TensorProto.EXTERNAL]
        constants = [
            attribute.t for node in model.graph.node for attribute in node.attribute if attribute.HasField("t")
        ]
    except Exception as error:  # the parser of protobuf has several
        raise FormatError(f"{path}: not a readable ONNX file: {' '.join(str(error).split())[:120]}") from None
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in constants):
        raise FormatError(f"{path}: a constant of the graph lies in another file; export it with the weights inside")
    names = {entry.value for tensor in external for entry in tensor.external_data if entry.key == "location"}
    for name in sorted(names):
        weights_file = path.parent / name
        if Path(name).name != name or weights_file.is_symlink():
            raise FormatError(f"{path}: its weights lie in '{name}', outside its own folder")
        if not weights_file.is_file():
            raise FormatError(f"{path}: its weights are not there: {weights_file}; put the file beside it")
        hasher.update(read_bytes(weights_file, limit=MAX_BYTES))
    try:
        for tensor in external:
            onnx.external_data_helper.load_external_data_for_tensor(tensor, str(path.parent))
            tensor.data_location = onnx.TensorProto.DEFAULT
            del tensor.external_data[:]
        onnx.checker.check_model(model)
    except Exception as error:  # broken bytes may raise any exception
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FormatError(f"{path}: not a valid ONNX graph: {reason}") from None
    return model, hasher.hexdigest()


def _check_input(onnx: Any, model: Any, path: Path) -> None:
    """Check that the network takes images [B, 3, H, W] of float32 and nothing else."""
    initialised = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in initialised]
    if len(inputs) != 1:
        names = ", ".join(value.name for value in inputs) or "none"
        raise FormatError(f"{path}: it takes {len(inputs)} inputs ({names}); a detector takes images alone")
    del model.graph.input[:]
    model.graph.input.extend(inputs)
    tensor_type = inputs[0].type.tensor_type
    axes = [axis.dim_value for axis in tensor_type.shape.dim]
    if len(axes) != 4 or axes[1] not in (0, 3):
        raise FormatError(f"{path}: its input has the shape {axes}; a detector takes images [B, 3, H, W]")
    if tensor_type.elem_type != onnx.TensorProto.FLOAT:
        kind = onnx.TensorProto.DataType.Name(tensor_type.elem_type).lower()
        raise FormatError(
            f"{path}: its input is of {kind}; export it in float32 (without half precision or quantisation)"
        )


def _remove_copies(onnx: Any, model: Any) -> None:
    """Let the readers of a copy read the original, and move constants to the weights, where onnx2torch finds them."""
    outputs = {output.name for output in model.graph.output}
    graph = onnx.shape_inference.infer_shapes(model).graph
    floats = {
        value.name
        for value in (*graph.value_info, *graph.input)
        if value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT
    }
    originals: dict[str, str] = {}
    nodes = []
    for node in model.graph.node:
        for index, name in enumerate(node.input):
            node.input[index] = originals.get(name, name)
        while node.input and not node.input[-1]:
            node.input.pop()  # an option that is not given
        # A cast from float32 to float32 would keep a copy of the network in float64 from running.
        is_copy = node.op_type == "Cast" and node.input[0] in floats and node.attribute[0].i == onnx.TensorProto.FLOAT
        if (is_copy or node.op_type == "Identity") and node.output[0] not in outputs:
            originals[node.output[0]] = node.input[0]
        elif node.op_type == "Constant" and node.attribute[0].name == "value":
            tensor = onnx.TensorProto.FromString(node.attribute[0].t.SerializeToString())
            tensor.name = node.output[0]
            model.graph.initializer.append(tensor)
        else:
            nodes.append(onnx.NodeProto.FromString(node.SerializeToString()))
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def _lower_opset(onnx: Any, model: Any) -> None:
    """Declare the version of ONNX that onnx2torch knows, and write the operators that have changed since as before.

    What has no earlier form (antialiasing, axes of a resize) keeps an attribute that makes the check of the operators
    fail. Most operators have only taken more number types since.
    """
    main = next((entry for entry in model.opset_import if entry.domain in ("", "ai.onnx")), None)
    if main is None or main.version <= OPSET:
        return
    main.version = OPSET
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in model.graph.node:
        former = ADDED_ATTRIBUTES.get(node.op_type, {})
        attributes = [
            attribute
            for attribute in node.attribute
            if attribute.name not in former or onnx.helper.get_attribute_value(attribute) != former[attribute.name]
        ]
        if node.op_type == "Split":
            attributes = [attribute for attribute in attributes if attribute.name != "num_outputs"]
        if node.op_type == "Reshape" and node.input[1] in constants:
            shape = onnx.numpy_helper.to_array(constants[node.input[1]])
            # A shape without 0 means the same whatever a 0 would mean.
            attributes = [attribute for attribute in attributes if attribute.name != "allowzero" or not shape.all()]
        if node.op_type in REDUCTIONS and len(node.input) == 2 and node.input[1] in constants:
            axes = onnx.numpy_helper.to_array(constants[node.input.pop()]).reshape(-1).tolist()
            attributes.append(onnx.helper.make_attribute("axes", axes))
        del node.attribute[:]
        node.attribute.extend(attributes)


def _check_operators(model: Any, path: Path) -> None:
    """Check that no operator selects boxes, and that onnx2torch knows all of them.

    Raises:
        FormatError: An operator does, or is not known.
    """
    registry = importlib.import_module("onnx2torch.node_converters.registry")
    versions = {"" if entry.domain == "ai.onnx" else entry.domain: entry.version for entry in model.opset_import}
    selections, unsupported = set(), set()
    for node in model.graph.node:
        domain = "" if node.domain == "ai.onnx" else node.domain
        if node.op_type in SELECTIONS:
            selections.add(node.op_type)
            continue
        try:
            registry.get_converter(node.op_type, versions.get(domain, 1), domain)
        except NotImplementedError:
            unsupported.add(node.op_type)
            continue
        later = {attribute.name for attribute in node.attribute} & ADDED_ATTRIBUTES.get(node.op_type, {}).keys()
        if (
            later
            or (node.op_type == "Pad" and len(node.input) > 3)
            or (node.op_type in REDUCTIONS and len(node.input) > 1)
        ):
            unsupported.add(f"{node.op_type} with {', '.join(sorted(later)) or 'axes'}")
    if selections:
        raise FormatError(
            f"{path}: {_operators(selections)} not supported: boxes are chosen there, without gradients; export "
            "the network without NMS and postprocessing (docs/how-to/use-detectors.md)"
        )
    if unsupported:
        raise FormatError(
            f"{path}: {_operators(unsupported)} not supported by onnx2torch; export with opset {OPSET} or less, in "
            "float32, or wrap the network in a class (docs/how-to/use-detectors.md)"
        )


def _operators(names: Iterable[str]) -> str:
    ordered = sorted(names)
    return f"the operator{'s' if len(ordered) > 1 else ''} {', '.join(ordered)} {'are' if len(ordered) > 1 else 'is'}"


def _tail_operators(model: Any, output: str) -> frozenset[str]:
    """Return the operators between the last convolutions and an output."""
    producers = {name: node for node in model.graph.node for name in node.output}
    operators: set[str] = set()
    visited, stack = set(), [output]
    while stack:
        name = stack.pop()
        node = producers.get(name)
        if name in visited or node is None or node.op_type in {"Conv", "ConvTranspose", "Gemm"}:
            continue
        visited.add(name)
        operators.add(node.op_type)
        # The shape of a map says nothing about its numbers.
        if node.op_type != "Shape":
            stack += node.input
    return frozenset(operators)
