"""A tiny CenterNet as a graph model of TensorFlow.js, of the operations and names of the package's."""

from __future__ import annotations

import base64
import io
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np

from ssad.detectors.adapters.centernet import DISTANCES, HEAT_MAPS
from ssad.detectors.yolo.classes import COCO

SIDE = 64


class GraphWriter:
    """Nodes and weights of a graph."""

    def __init__(self, seed: int = 0) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.entries: list[dict[str, Any]] = []
        self.data = b""
        self.draws = np.random.default_rng(seed)

    def add(self, name: str, op: str, *inputs: str, **attributes: Any) -> str:
        self.nodes.append({"name": name, "op": op, "input": list(inputs), "attr": attributes})
        return name

    def constant(self, name: str, values: Any, dtype: str = "float32") -> str:
        array = np.asarray(values)
        entry: dict[str, Any] = {"name": name, "shape": list(array.shape), "dtype": dtype}
        if dtype == "float32":
            entry["quantization"] = {"dtype": "float16", "original_dtype": "float32"}
        self.entries.append(entry)
        self.data += array.astype("<f2" if dtype == "float32" else "<i4").tobytes()
        return self.add(name, "Const")

    def convolution(
        self,
        name: str,
        source: str,
        shape: tuple[int, ...],
        *,
        stride: int = 1,
        relu: str = "",
        depthwise: bool = False,
        level: float = 0.0,
    ) -> str:
        spread = 1.5 / np.sqrt(np.prod(shape[:2] if depthwise else shape[:3]))
        kernel = self.constant(f"{name}/kernel", self.draws.normal(0, spread, shape))
        maps = shape[2] * shape[3] if depthwise else shape[3]
        bias = self.constant(f"{name}/bias", self.draws.normal(level, 0.2, maps))
        fused = [text for text in ("BiasAdd", relu) if text]
        return self.add(
            name,
            "FusedDepthwiseConv2dNative" if depthwise else "_FusedConv2D",
            source,
            kernel,
            bias,
            strides={"list": {"i": ["1", str(stride), str(stride), "1"]}},
            dilations={"list": {"i": ["1", "1", "1", "1"]}},
            padding={"s": encoded("SAME")},
            fused_ops={"list": {"s": [encoded(text) for text in fused]}},
        )

    def topology(self, weights: str = "centernet.bin") -> dict[str, Any]:
        return {
            "format": "graph-model",
            "modelTopology": {"node": self.nodes},
            "weightsManifest": [{"paths": [weights], "weights": self.entries}],
        }


def encoded(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def tiny_centernet(seed: int = 0) -> GraphWriter:
    """A network of 64 x 64 pixels with all supported operations, random weights and the two heads."""
    graph = GraphWriter(seed)
    graph.add("image", "Placeholder", shape={"shape": {"dim": [{"size": str(n)} for n in (1, SIDE, SIDE, 3)]}})
    scaled = graph.add("scaled", "Mul", "image", graph.constant("scale", 1 / 64))
    first = graph.convolution("first", scaled, (3, 3, 3, 6), stride=2)
    shifted = graph.add("shifted", "Add", first, graph.constant("three", 3.0))
    gate = graph.add("gate", "Mul", graph.add("clipped", "Relu6", shifted), graph.constant("sixth", 1 / 6))
    swish = graph.add("swish", "Mul", first, gate)
    wide = graph.convolution("wide", swish, (3, 3, 6, 1), stride=2, relu="Relu6", depthwise=True)
    axes = graph.constant("axes", [1, 2], "int32")
    mean = graph.add("mean", "Mean", wide, axes, keep_dims={"b": True})
    squeezed = graph.add("squeezed", "Sigmoid", graph.convolution("squeeze", mean, (1, 1, 6, 6), relu="Relu"))
    excited = graph.add("excited", "Mul", wide, squeezed)
    deep = graph.convolution("deep", excited, (3, 3, 6, 8), stride=2)
    size = graph.constant("size", [SIDE // 4, SIDE // 4], "int32")
    up = graph.add("up", "ResizeBilinear", deep, size, align_corners={"b": False}, half_pixel_centers={"b": False})
    joined = graph.add("joined", "ConcatV2", up, excited, graph.constant("axis", 3, "int32"))
    neck = graph.add("neck", "Relu", graph.add("centred", "Sub", joined, graph.constant("tenth", 0.1)))
    heat = graph.convolution("heat", neck, (1, 1, 14, len(COCO)))
    graph.add(HEAT_MAPS, "Identity", graph.add("probability", "Sigmoid", heat))
    reach = graph.convolution("reach", neck, (1, 1, 14, 4), level=3.0)
    graph.add(DISTANCES, "Mul", reach, graph.constant("pixels", 16.0))
    return graph


def write_folder(folder: Path, graph: GraphWriter) -> Path:
    """Write the files of the package below a folder."""
    (folder / "models").mkdir(parents=True)
    (folder / "models" / "centernet.json").write_text(json.dumps(graph.topology()))
    (folder / "models" / "centernet.bin").write_bytes(graph.data)
    return folder


def write_archive(path: Path, graph: GraphWriter) -> Path:
    """Write the archive of the package as `npm pack` does."""
    files = {
        "package/package.json": b"{}",
        "package/models/centernet.json": json.dumps(graph.topology()).encode(),
        "package/models/centernet.bin": graph.data,
    }
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return path
