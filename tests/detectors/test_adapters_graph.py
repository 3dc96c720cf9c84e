"""Graph models of TensorFlow.js in PyTorch, and the CenterNet among them."""

from __future__ import annotations

import base64
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.graph_model import SIDE, GraphWriter, tiny_centernet, write_archive, write_folder

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, FormatError
from ssad.detectors import make_detector
from ssad.detectors.adapters.centernet import DISTANCES, CenterNet, centernet_detector, tile_corners
from ssad.detectors.adapters.tfjs_graph import GraphModel, pad_same, read_graph_file
from ssad.detectors.check import check_detector
from ssad.detectors.yolo.classes import COCO

PACKAGE = os.environ.get("SSAD_HUMAN", "")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("human"), tiny_centernet())


@pytest.fixture(scope="module")
def detector(folder: Path) -> CenterNet:
    return centernet_detector(folder)


def run_graph(graph: GraphWriter, image: np.ndarray[Any, Any], output: str) -> np.ndarray[Any, Any]:
    """The graph in the layout of TensorFlow, [H, W, C], one pixel after another: a second implementation."""
    weights: dict[str, np.ndarray[Any, Any]] = {}
    start = 0
    for entry in graph.entries:
        kind = np.dtype("<f2" if entry["dtype"] == "float32" else "<i4")
        end = start + math.prod(entry["shape"]) * kind.itemsize
        values = np.frombuffer(graph.data[start:end], kind).reshape(entry["shape"])
        weights[entry["name"]] = values.astype(np.float64 if entry["dtype"] == "float32" else np.int64)
        start = end
    values_of: dict[str, np.ndarray[Any, Any]] = {"image": image.astype(np.float64), **weights}
    for node in graph.nodes:
        if node["name"] in values_of:
            continue
        first, *others = (values_of[name] for name in node["input"])
        simple = {
            "Mul": lambda a, b: a * b,
            "Add": lambda a, b: a + b,
            "Sub": lambda a, b: a - b,
            "Relu": lambda a: np.maximum(a, 0),
            "Relu6": lambda a: np.clip(a, 0, 6),
            "Sigmoid": lambda a: 1 / (1 + np.exp(-a)),
            "Identity": lambda a: a,
            "Mean": lambda a, axes: a.mean((0, 1), keepdims=True),
            "ConcatV2": lambda a, b, axis: np.concatenate([a, b], -1),
        }
        if node["op"] in simple:
            values_of[node["name"]] = simple[node["op"]](first, *others)
        elif node["op"] == "ResizeBilinear":
            height, width = others[0]
            resized = np.zeros((height, width, first.shape[2]))
            for row, column in np.ndindex(height, width):
                y, x = row * first.shape[0] / height, column * first.shape[1] / width
                top, left = int(y), int(x)
                bottom, right = min(top + 1, first.shape[0] - 1), min(left + 1, first.shape[1] - 1)
                upper = first[top, left] * (1 - x + left) + first[top, right] * (x - left)
                lower = first[bottom, left] * (1 - x + left) + first[bottom, right] * (x - left)
                resized[row, column] = upper * (1 - y + top) + lower * (y - top)
            values_of[node["name"]] = resized
        else:
            kernel, bias = others
            step = int(node["attr"]["strides"]["list"]["i"][1])
            size = [-(-length // step) for length in first.shape[:2]]
            missing = [
                max((count - 1) * step + reach - length, 0)
                for count, reach, length in zip(size, kernel.shape[:2], first.shape[:2], strict=True)
            ]
            padded = np.pad(first, (*((total // 2, total - total // 2) for total in missing), (0, 0)))
            rows = np.zeros((*size, len(bias)))
            for row, column in np.ndindex(*size):
                y, x = row * step, column * step
                part = padded[y : y + kernel.shape[0], x : x + kernel.shape[1]]
                subscripts = "hwc,hwcm->cm" if "Depthwise" in node["op"] else "hwc,hwcm->m"
                rows[row, column] = np.einsum(subscripts, part, kernel).ravel() + bias
            texts = node["attr"]["fused_ops"]["list"]["s"]
            fused = [base64.b64decode(text).decode() for text in texts]
            rows = np.maximum(rows, 0) if {"Relu", "Relu6"} & set(fused) else rows
            values_of[node["name"]] = np.minimum(rows, 6) if "Relu6" in fused else rows
    return values_of[output]


@pytest.mark.parametrize("output", ["heat", "neck", DISTANCES])
def test_a_graph_gives_what_tensorflow_s_definitions_give(folder: Path, output: str) -> None:
    graph = tiny_centernet()
    image = np.random.default_rng(1).random((SIDE, SIDE, 3)) * 255
    model = GraphModel(read_graph_file(folder, "models/centernet.json"), (output,)).double()
    with torch.no_grad():
        (values,) = model(torch.from_numpy(image).permute(2, 0, 1)[None])
    expected = run_graph(graph, image, output)
    assert np.allclose(values[0].permute(1, 2, 0).numpy(), expected, rtol=1e-9, atol=1e-9)


def test_what_cannot_be_halved_is_padded_at_the_end() -> None:
    padded = pad_same(torch.ones(1, 1, 4, 5), (3, 3), (2, 2))
    assert padded[0, 0, :, 2].tolist() == [1, 1, 1, 1, 0]
    assert padded[0, 0, 1].tolist() == [0, 1, 1, 1, 1, 1, 0]


def test_the_detector_keeps_the_protocol(detector: CenterNet) -> None:
    check_detector(detector)


def test_an_archive_is_read_in_place(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_archive(tmp_path / "human.tgz", tiny_centernet())
    monkeypatch.chdir(tmp_path)
    image = torch.rand(1, 3, 50, 80, generator=torch.Generator().manual_seed(0))
    archived, unpacked = (make_detector(f"centernet:{path}") for path in ("human.tgz", folder))
    assert torch.equal(archived.dense(image).logit, unpacked.dense(image).logit)
    assert archived.classes == COCO
    assert sorted(path.name for path in tmp_path.iterdir()) == ["human.tgz"]


def test_tiles_cover_an_image_and_overlap() -> None:
    corners, side = tile_corners((900, 1600), None)
    assert (corners, side) == ([(0, 0), (350, 0), (700, 0)], 900)
    assert tile_corners((100, 40), None) == ([(0, 0), (0, 20), (0, 40), (0, 60)], 40)
    assert tile_corners((60, 60), None) == ([(0, 0)], 60)
    assert tile_corners((30, 60), 1) == ([(0, 0)], 60)


def test_an_object_in_two_tiles_is_one_detection(detector: CenterNet) -> None:
    dense = detector.dense(torch.rand(1, 3, 60, 100, generator=torch.Generator().manual_seed(3)))
    heat = torch.full_like(dense.maps["heat"][0], -9.0)
    label = COCO.index("car")
    box = dense.box.clone()
    for tile, cell in ((0, (8, 12)), (1, (8, 3))):
        heat[tile, label, cell[0], cell[1]] = 2.0 + tile
        box[0, tile * 256 + cell[0] * 16 + cell[1]] = torch.tensor([30.0, 20.0, 60.0, 40.0])
    rows = heat.flatten(2).transpose(1, 2).reshape(1, -1, len(COCO))
    (found,) = detector.choose(
        type(dense)(**{**_fields(dense), "logit": rows, "box": box, "maps": {"heat": [heat]}}), 0.5
    )
    assert found.label.tolist() == [label]
    assert found.score.tolist() == pytest.approx([1 / (1 + math.exp(-3.0))])


def _fields(dense: Any) -> dict[str, Any]:
    return {name: getattr(dense, name) for name in dense.__dataclass_fields__}


def test_centres_are_positive_and_crowds_are_ignored(detector: CenterNet) -> None:
    dense = detector.dense(torch.zeros(1, 3, 64, 64))
    box = torch.tensor([[8.0, 8.0, 32.0, 28.0], [40.0, 40.0, 60.0, 60.0]])
    truth = Truth(torch.tensor([2, 0]), box, crowd=torch.tensor([False, True]))
    assignment = detector.assign(dense, [truth])
    places = (assignment.label[0] == 2).nonzero()[:, 0]
    assert dense.place[places].tolist() == [[22.0, 18.0]]
    assert assignment.owner[0, places].tolist() == [0]
    ignored = dense.place[assignment.label[0] == -2]
    assert ignored.min() >= 40.0
    assert len(ignored) == 25
    losses = detector.losses(dense, assignment)
    nearer = detector.losses(type(dense)(**{**_fields(dense), "box": assignment.extra["box"]}), assignment)
    assert nearer["box"] < 1e-6 < losses["box"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda graph: graph.nodes[-1].update(op="Softmax"), "Softmax is not supported"),
        (lambda graph: graph.nodes.pop(), "no node"),
        (lambda graph: graph.entries[0].update(dtype="string", quantization=None), "string"),
        (lambda graph: graph.entries.pop(), "bytes"),
        (lambda graph: graph.nodes[-1].update(input=["reach", DISTANCES]), "depends on itself"),
        (lambda graph: graph.nodes[0].update(attr={}), r"shape \[\]"),
    ],
)
def test_broken_graphs_are_refused_in_one_line(change: Any, words: str, tmp_path: Path) -> None:
    graph = tiny_centernet()
    change(graph)
    with pytest.raises(FormatError, match=words) as error:
        centernet_detector(write_folder(tmp_path / "broken", graph))
    assert "\n" not in str(error.value)


def test_wrong_files_and_options_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.tgz").write_bytes(b"nothing")
    for name, words in (
        (f"centernet:{tmp_path}/a.tgz", "cannot be read as an archive"),
        (f"centernet:{tmp_path}/b.tgz", "npm pack @vladmandic/human"),
        (f"centernet:{tmp_path}", "no such file"),
    ):
        with pytest.raises(FormatError, match=words):
            make_detector(name)
    with pytest.raises(ConfigError, match="tiles is a whole number"):
        make_detector(f"centernet:{folder}?tiles=0")
    with pytest.raises(ConfigError, match="takes no others"):
        make_detector(f"centernet:{folder}", weights="random")


@pytest.mark.slow
@pytest.mark.skipif(not PACKAGE, reason="set SSAD_HUMAN to the archive of @vladmandic/human")
def test_the_package_s_detector_keeps_the_protocol() -> None:
    check_detector(centernet_detector(PACKAGE))
