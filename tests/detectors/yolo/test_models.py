"""YOLO networks and their weights: published sizes, darknet files against an interpreter of its layer table, names."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.errors import ConfigError, FormatError
from ssad.detectors.yolo.darknet import convolutions, read_darknet
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolo.models import YoloSpec
from ssad.detectors.yolov3 import YOLOV3, YOLOV3_TINY, YOLOV3_TINY_OFFICIAL, yolov3, yolov3_tiny
from ssad.detectors.yolov5 import HEADS, LAYERS, YOLOV5N, YOLOV5S, from_yolov5_keys

NARROW_V3 = replace(YOLOV3, width=0.25)
NARROW_TINY = replace(YOLOV3_TINY, width=0.5)

# the layer tables that darknet prints: filters kernel/stride, s: add the map so many layers back, r: join these
V3_TABLE = (
    "32 3/1  64 3/2 32 1/1 64 3/1 s3  128 3/2 "
    + "64 1/1 128 3/1 s3 " * 2
    + "256 3/2 "
    + "128 1/1 256 3/1 s3 " * 8
    + "512 3/2 "
    + "256 1/1 512 3/1 s3 " * 8
    + "1024 3/2 "
    + "512 1/1 1024 3/1 s3 " * 4
    + "512 1/1 1024 3/1 " * 3
    + "out r-4 256 1/1 up r-1,61 "
    + "256 1/1 512 3/1 " * 3
    + "out r-4 128 1/1 up r-1,36 "
    + "128 1/1 256 3/1 " * 3
    + "out"
)
TINY_TABLE = (
    "16 3/1 max2 32 3/1 max2 64 3/1 max2 128 3/1 max2 256 3/1 max2 512 3/1 max1 1024 3/1 256 1/1 512 3/1 out "
    "r-4 128 1/1 up r-1,8 256 3/1 out"
)


def darknet_forward(table: str, values: np.ndarray, x: Tensor, *, width: float, outputs: int) -> list[Tensor]:
    """Run a layer table on values that are taken one after the other; the raw maps in the table's order."""
    layers: list[Tensor] = []
    found, at = [], 0
    words = iter(table.split())

    def take(*shape: int) -> Tensor:
        nonlocal at
        part = values[at : at + int(np.prod(shape))]
        at += len(part)
        return torch.from_numpy(part.copy()).view(shape)

    for word in words:
        if word == "out":
            bias = take(outputs)
            x = functional.conv2d(x, take(outputs, x.shape[1], 1, 1), bias)
            found.append(x)
            layers += [x, x]  # the convolution and the detection layer count as two
            continue
        if word == "up":
            x = x.repeat_interleave(2, 2).repeat_interleave(2, 3)
        elif word == "max2":
            x = functional.max_pool2d(x, 2)
        elif word == "max1":
            x = functional.max_pool2d(torch.cat((x, x[..., -1:]), 3), (1, 2), 1)
            x = functional.max_pool2d(torch.cat((x, x[:, :, -1:]), 2), (2, 1), 1)
        elif word[0] == "s":
            x = x + layers[-int(word[1:])]
        elif word[0] == "r":
            x = torch.cat([layers[int(index)] for index in word[1:].split(",")], 1)
        else:
            filters = int(int(word) * width)
            kernel, stride = (int(part) for part in next(words).split("/"))
            bias, weight, mean, variance = (take(filters) for _ in range(4))
            x = functional.conv2d(x, take(filters, x.shape[1], kernel, kernel), None, stride, kernel // 2)
            shape = (1, -1, 1, 1)
            x = (x - mean.view(shape)) / (variance.view(shape) + 1e-5).sqrt() * weight.view(shape) + bias.view(shape)
            x = torch.where(x > 0, x, 0.1 * x)
        layers.append(x)
    assert at == len(values)
    return found


def shake(detector: Yolo) -> Yolo:
    """Other values everywhere, batch norm included."""
    source = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for layer in convolutions(detector):
            for index, tensor in enumerate(layer):
                noise = torch.rand(tensor.shape, generator=source)
                if index == len(layer) - 1:
                    tensor.mul_(0.5 + noise)
                else:
                    tensor.copy_(0.5 + noise if index in {1, 3} else 0.2 * noise)
    return detector


@pytest.mark.parametrize(
    ("spec", "count"),
    [(YOLOV3, 61_949_149), (YOLOV3_TINY, 8_852_366), (YOLOV5N, 1_872_157), (YOLOV5S, 7_235_389)],
)
def test_numbers_of_parameters_are_the_published_ones(spec: YoloSpec, count: int) -> None:
    detector = Yolo(spec)
    assert sum(part.numel() for part in detector.parameters()) == count
    assert len(detector.classes) == 80


@pytest.mark.parametrize(("spec", "fused"), [(YOLOV5N, 1_867_405), (YOLOV5S, 7_225_885)])
def test_fused_numbers_of_parameters_are_the_published_ones(spec: YoloSpec, fused: int) -> None:
    parameters = dict(Yolo(spec).named_parameters())
    norms = sum(part.numel() for name, part in parameters.items() if ".norm.weight" in name)
    # folding a batch norm into its convolution leaves one bias of its two vectors
    assert sum(part.numel() for part in parameters.values()) - norms == fused


@pytest.mark.parametrize(("spec", "size"), [(YOLOV3, 248_007_048), (YOLOV3_TINY, 35_434_956)])
def test_official_darknet_files_have_the_size_that_is_expected(spec: YoloSpec, size: int) -> None:
    floats = sum(tensor.numel() for layer in convolutions(Yolo(spec)) for tensor in layer)
    assert 20 + 4 * floats == size


def write_darknet(detector: Yolo, path: Path, *, seen: int = 0) -> None:
    """The detector's weights as darknet 0.2.5 would write them."""
    parts = [struct.pack("<3iq", 0, 2, 5, seen)]
    parts += [v.detach().numpy().astype("<f4").tobytes() for layer in convolutions(detector) for v in layer]
    path.write_bytes(b"".join(parts))


@pytest.mark.parametrize(("spec", "table"), [(NARROW_V3, V3_TABLE), (NARROW_TINY, TINY_TABLE)])
def test_darknet_weights_run_as_the_layer_table_says(spec: YoloSpec, table: str, tmp_path: Path) -> None:
    detector = shake(Yolo(spec, ("a", "b")))
    write_darknet(detector, tmp_path / "w.weights", seen=12345)
    other = Yolo(spec, ("a", "b"), seed=5)
    assert read_darknet(other, tmp_path / "w.weights") == 12345
    assert all(
        torch.equal(a, b) for a, b in zip(detector.state_dict().values(), other.state_dict().values(), strict=True)
    )

    x = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    values = np.fromfile(tmp_path / "w.weights", "<f4", offset=20)
    expected = darknet_forward(table, values, x, width=spec.width, outputs=21)
    raw = other.dense(x).maps["raw"]
    for ours, theirs in zip(reversed(raw), expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * float(theirs.abs().max()))


def test_leading_layers_alone_are_read_from_a_trunk_file(tmp_path: Path) -> None:
    detector = shake(Yolo(NARROW_TINY))
    write_darknet(detector, tmp_path / "w.weights")
    layers = convolutions(detector)[:7]
    data = (tmp_path / "w.weights").read_bytes()[: 20 + 4 * sum(tensor.numel() for layer in layers for tensor in layer)]
    (tmp_path / "trunk").write_bytes(data)
    other = Yolo(NARROW_TINY, ("car",))
    fresh = other.network.outputs()[0].weight.clone()
    read_darknet(other, tmp_path / "trunk", layers=7)
    assert torch.equal(convolutions(other)[6][4], layers[6][4])
    assert torch.equal(other.network.outputs()[0].weight, fresh)
    with pytest.raises(ConfigError, match="13 convolutions"):
        read_darknet(other, tmp_path / "trunk", layers=14)


def test_a_foreign_or_broken_darknet_file_is_one_line(tmp_path: Path) -> None:
    detector = Yolo(NARROW_TINY, ("car",))
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    path = tmp_path / "w.weights"
    write_darknet(detector, path)
    data = path.read_bytes()
    floats = np.frombuffer(data, "<f4", offset=20).copy()
    nan, negative = floats.copy(), floats.copy()
    nan[100] = np.nan
    negative[3 * convolutions(detector)[0][0].numel()] = -1.0
    cases = {
        "cut short": data[:-4],
        "another network": data + b"\0" * 8,
        "not a darknet": b"PK\x03\x04",
        "version": b"PK\x03\x04" + data[4:],
        "NaN": data[:20] + nan.tobytes(),
        "negative variance": data[:20] + negative.tobytes(),
    }
    for message, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(FormatError, match=message) as caught:
            read_darknet(detector, path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    with pytest.raises(FormatError, match="no such file"):
        yolov3_tiny(weights=tmp_path / "none.weights")
    assert all(torch.equal(before[name], value) for name, value in detector.state_dict().items())
    with pytest.raises(ConfigError, match="no darknet network"):
        read_darknet(Yolo(YOLOV5N, ("car",)), path)


def test_an_old_header_counts_images_in_four_bytes(tmp_path: Path) -> None:
    detector = shake(Yolo(NARROW_TINY, ("car",)))
    path = tmp_path / "w.weights"
    write_darknet(detector, path)
    path.write_bytes(np.array([0, 1, 0, 77], "<i4").tobytes() + path.read_bytes()[20:])
    other = Yolo(NARROW_TINY, ("car",))
    assert read_darknet(other, path) == 77
    assert torch.equal(convolutions(other)[-1][1], convolutions(detector)[-1][1])


def test_the_official_tiny_weights_have_their_anchors() -> None:
    detector = yolov3_tiny(("car",), spec=YOLOV3_TINY_OFFICIAL)
    assert detector.anchors[0].tolist() == [[23, 27], [37, 58], [81, 82]]
    assert detector.anchors[1].tolist() == yolov3_tiny(("car",)).anchors[1].tolist()


@pytest.mark.parametrize(("spec", "epsilon"), [(YOLOV5N, 1e-3), (YOLOV3_TINY, 1e-5)], ids=["yolov5", "darknet"])
def test_batch_norms_have_the_published_epsilon(spec: YoloSpec, epsilon: float) -> None:
    """Where the variance is 0, a norm divides by the root of its epsilon and nothing else."""
    network = Yolo(replace(spec, width=0.125)).network
    norms = [part for part in network.modules() if isinstance(part, nn.BatchNorm2d)]
    assert len(norms) > 10
    for norm in norms:
        assert norm.running_var is not None
        norm.running_var.zero_()
        x = torch.full((1, norm.num_features, 1, 1), 2.0)
        torch.testing.assert_close(norm(x), x / epsilon**0.5)


def yolov5_names(detector: Yolo) -> dict[str, str]:
    """The published name of each tensor of YOLOv5, by walking the layer table: number, then parts of the block."""
    number = {own: index for index, own in LAYERS.items()}
    names = {}
    for own in detector.network.state_dict():
        top, *rest = own.split(".")
        if top == "heads":
            names[f"network.{own}"] = f"model.{HEADS}.m.{'.'.join(rest)}"
            continue
        rest = ["bn" if part == "norm" else part for part in rest]
        if top == "pool":
            rest[0] = {"reduce": "cv1", "merge": "cv2"}[rest[0]]
        elif rest[0] == "blocks":
            rest = ["m", rest[1], {"reduce": "cv1", "expand": "cv2"}[rest[2]], *rest[3:]]
        elif rest[0] in {"through", "past", "merge"}:
            rest[0] = {"through": "cv1", "past": "cv2", "merge": "cv3"}[rest[0]]
        names[f"network.{own}"] = f"model.{number[top]}.{'.'.join(rest)}"
    return names


@pytest.mark.parametrize("prefix", ["", "model."])
def test_yolov5_names_are_mapped_one_to_one(prefix: str) -> None:
    detector = Yolo(YOLOV5N, seed=3)
    state = detector.state_dict()
    names = yolov5_names(detector)
    foreign = {
        prefix + name: state[own].half() if state[own].is_floating_point() else state[own]
        for own, name in names.items()
    }
    for known in (
        "model.0.conv.weight",
        "model.2.cv1.conv.weight",
        "model.2.m.0.cv2.bn.running_var",
        "model.9.cv2.conv.weight",
        "model.24.m.0.weight",
        "model.23.cv3.bn.bias",
    ):
        assert prefix + known in foreign
    foreign[f"{prefix}model.24.anchors"] = detector.anchors.half() / torch.tensor([8.0, 16.0, 32.0]).view(3, 1, 1)
    mapped = from_yolov5_keys(foreign)
    assert set(mapped) == set(state)
    assert torch.equal(mapped["anchors"], detector.anchors)
    Yolo(YOLOV5N).load_state_dict(mapped, strict=True)
    torch.testing.assert_close(
        mapped["network.neck4.merge.conv.weight"], state["network.neck4.merge.conv.weight"], rtol=1e-3, atol=1e-5
    )


@pytest.mark.parametrize(
    "key",
    [
        "model.0.weight",
        "model.11.conv.weight",
        "model.2.cv4.conv.weight",
        "model.9.m.0.cv1.conv.weight",
        "optimizer",
        "model.24.cv2.0.0.conv.weight",
        "model.0.cv1.conv.weight",
        "model.2.conv.weight",
        "model.24.m.3.weight",
    ],
)
def test_a_foreign_yolov5_name_is_one_line(key: str) -> None:
    with pytest.raises(FormatError, match=r"no name of YOLOv5") as caught:
        from_yolov5_keys({key: torch.zeros(1)})
    assert key in str(caught.value)


def test_fresh_weights_depend_on_the_seed_alone() -> None:
    torch.manual_seed(0)
    state = torch.random.get_rng_state()
    first = Yolo(NARROW_TINY, seed=1)
    assert torch.equal(state, torch.random.get_rng_state())
    torch.manual_seed(9)
    second, third = Yolo(NARROW_TINY, seed=1), Yolo(NARROW_TINY, seed=2)
    weights = [detector.network.trunk[0].conv.weight for detector in (first, second, third)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])
    assert not first.training
    assert not any(part.requires_grad for part in first.parameters())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rule": "v8"}, "unknown rule"),
        ({"network": "vgg"}, "unknown network"),
        ({"box_loss": "l1"}, "box loss"),
        ({"width": 0.0}, "width"),
        ({"strides": (8, 16)}, "each level"),
        ({"strides": (4, 8, 16)}, "strides"),
    ],
)
def test_a_wrong_spec_is_one_line(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(YOLOV3, **change)  # type: ignore[arg-type]


def test_wrong_classes_and_widths_are_one_line() -> None:
    with pytest.raises(ConfigError, match="distinct"):
        yolov3(("car", "car"), spec=NARROW_V3)
    with pytest.raises(ConfigError, match="input_width"):
        yolov3(("car",), spec=NARROW_V3, input_width=8)
