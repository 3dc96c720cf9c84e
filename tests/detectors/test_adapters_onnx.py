"""Exported detectors: every layout gives the boxes, scores and gradients of the network that was exported."""

import copy
import io
import itertools
import re
import warnings
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor, nn
from torchvision.models import detection
from torchvision.models.detection.anchor_utils import AnchorGenerator, DefaultBoxGenerator
from torchvision.models.detection.ssd import SSDHead
from torchvision.ops import batched_nms

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, FormatError, MissingExtraError, SSADError
from ssad.detectors import make_detector
from ssad.detectors.adapters.onnx_detector import OnnxOneStage, OnnxYolo, onnx_detector, to_logit
from ssad.detectors.adapters.torchvision_models import wrap
from ssad.detectors.check import check_detector, find_faults
from ssad.engine.kind import Resources
from ssad.engine.run import run
from ssad.experiments.perception.digital.kind import Digital, DigitalSuite
from ssad.experiments.perception.digital.points import points_of
from ssad.experiments.runs import write_report
from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
pytest.importorskip("onnx2torch", reason="the extra onnx is not installed")

CLASSES = ("car", "person", "stop_sign")
SIZE = (64, 96)
STRIDES = (8, 16, 32)


class TinyYolo(nn.Module):
    """A convolution for each level, with the output of an exporter.

    `layout`: yolov5, yolov8, yolox, or yolox-cells: boxes relative to cells.
    """

    def __init__(self, layout: str, classes: int = 3, strides: tuple[int, ...] = STRIDES) -> None:
        super().__init__()
        torch.manual_seed(7)
        self.layout, self.strides = layout, strides
        self.anchors = 3 if layout == "yolov5" else 1
        self.columns = classes + (4 if layout == "yolov8" else 5)
        self.levels = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(3, 8, stride, stride), nn.SiLU(), nn.Conv2d(8, self.anchors * self.columns, 3, padding=1)
            )
            for stride in strides
        )
        for level in self.levels:
            level[0].weight.data *= 4 / 255 if layout.startswith("yolox") else 4
            level[2].weight.data *= 3
            level[2].bias.data -= 1

    def forward(self, images: Tensor) -> Tensor:
        rows = []
        for level, stride in zip(self.levels, self.strides, strict=True):
            maps = level(images)
            count, _, height, width = maps.shape  # not len(), which an exporter takes for a constant
            y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
            cell = torch.stack((x, y), -1).float()
            maps = maps.view(count, self.anchors, self.columns, height, width).permute(0, 1, 3, 4, 2)
            box, score = maps[..., :4], maps[..., 4:].sigmoid()
            if self.layout == "yolov5":
                share = box.sigmoid()
                anchor = torch.tensor([[1.0, 2.0], [2.0, 2.0], [3.0, 1.0]]).view(1, 3, 1, 1, 2) * stride
                middle, extent = (share[..., :2] * 2 - 0.5 + cell) * stride, (share[..., 2:] * 2) ** 2 * anchor
            elif self.layout == "yolov8":
                low, high = cell + 0.5 - box[..., :2].sigmoid() * 4, cell + 0.5 + box[..., 2:].sigmoid() * 4
                middle, extent = (low + high) / 2 * stride, (high - low) * stride
            elif self.layout == "yolox":
                middle, extent = (box[..., :2] + cell) * stride, box[..., 2:].exp() * stride
            else:
                middle, extent = box[..., :2], box[..., 2:]
            rows.append(torch.cat((middle, extent, score), -1).flatten(1, 3))
        output = torch.cat(rows, 1)
        return output.transpose(1, 2) if self.layout == "yolov8" else output


class Heads(nn.Module):
    """Backbone and head of a model of torchvision, as it is exported."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        heads = self.model.head(list(self.model.backbone(images).values()))
        return heads["cls_logits"], heads["bbox_regression"]


def export(
    path: Path, network: nn.Module, size: tuple[int, int] = SIZE, *, dynamic: bool = False, batch: int = 1, **names: Any
) -> Path:
    """Export a network, with texts in the file's metadata."""
    axes = {"images": {0: "batch", 2: "height", 3: "width"}} if dynamic else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter
        torch.onnx.export(
            network.eval(),
            (torch.rand(batch, 3, *size),),
            str(path),
            input_names=["images"],
            dynamic_axes=axes,
            dynamo=False,
        )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {name: str(value) for name, value in names.items()})
    onnx.save(model, str(path))
    return path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Exports of tiny networks, each made once."""
    folder = tmp_path_factory.mktemp("onnx")

    def get(layout: str, *, dynamic: bool = False, classes: int = 3, batch: int = 1) -> Path:
        path = folder / f"{layout}-{dynamic}-{classes}-{batch}.onnx"
        if not path.is_file():
            names = {"names": dict(enumerate(CLASSES)), "task": "detect"} if classes == 3 else {}
            export(path, TinyYolo(layout, classes), dynamic=dynamic, batch=batch, **names)
        return path

    return get


def pictures(count: int = 2, size: tuple[int, int] = SIZE) -> Tensor:
    return torch.rand((count, 3, *size), generator=torch.Generator().manual_seed(5))


def true_boxes() -> list[Truth]:
    return [Truth(torch.tensor([0, 2]), torch.tensor([[10.0, 10, 50, 50], [50, 20, 90, 60]]))]


def message(error: pytest.ExceptionInfo[SSADError]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


# ---------------------------------------------------------------- the YOLO family

LAYOUTS = ("yolov5", "yolov8", "yolox", "yolox-cells")


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dynamic", [False, True])
def test_boxes_and_scores_are_those_of_the_network(layout: str, dynamic: bool, exported: Callable[..., Path]) -> None:
    detector, images = make_detector(f"onnx:{exported(layout, dynamic=dynamic)}"), pictures()
    seen = images.flip(1) * 255 if layout.startswith("yolox") else images  # YOLOX is trained on BGR in 0..255
    with torch.no_grad():
        output = TinyYolo(layout.removesuffix("-cells"))(seen)
        dense = detector.dense(images)
    rows = output.transpose(1, 2) if layout == "yolov8" else output
    middle, extent = rows[..., :2], rows[..., 2:4]
    box = torch.cat((middle - extent / 2, middle + extent / 2), -1)
    assert detector.classes == CLASSES
    torch.testing.assert_close(dense.box, box, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(dense.logit.sigmoid(), rows[..., -3:], rtol=1e-4, atol=1e-5)
    assert (dense.quality is None) == (layout == "yolov8")
    score = rows[..., -3:]
    if dense.quality is not None:
        torch.testing.assert_close(dense.quality.sigmoid(), rows[..., 4], rtol=1e-4, atol=1e-5)
        score = score * rows[..., 4:5]  # of YOLOv5 and YOLOX a box has the score of its class times its objectness
    for found, best in zip(detector.predict(images, threshold=0.01), score.amax((1, 2)), strict=True):
        torch.testing.assert_close(found.score[0], best, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("layout", "iou"), [("yolov5", 0.45), ("yolov8", 0.7), ("yolox", 0.65)])
def test_boxes_are_suppressed_within_a_class_as_the_source_does(
    layout: str, iou: float, exported: Callable[..., Path]
) -> None:
    assert make_detector(f"onnx:{exported(layout)}").layout.iou == iou
    detector, images = make_detector(f"onnx:{exported(layout)}?iou=0.2"), pictures(1)
    dense = detector.dense(images)
    quality = 1.0 if dense.quality is None else dense.quality[0].sigmoid()[:, None]
    score = dense.logit[0].sigmoid() * quality
    threshold = float(score.flatten().sort().values[-290])
    place, label = (score > threshold).nonzero(as_tuple=True)
    kept = batched_nms(dense.box[0, place].double(), score[place, label].double(), label, 0.2)
    (found,) = detector.predict(images, threshold=threshold)
    assert 3 < len(kept) < len(place), "some overlap, and several remain"
    torch.testing.assert_close(found.score, score[place, label][kept])
    assert found.label.tolist() == label[kept].tolist()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_objects_are_assigned_to_places_inside_them(layout: str, exported: Callable[..., Path]) -> None:
    detector, truth = make_detector(f"onnx:{exported(layout)}"), true_boxes() * 2
    dense = detector.dense(pictures(2))
    assignment = detector.assign(dense, truth)
    for owner, objects in zip(assignment.owner, truth, strict=True):
        rows = owner >= 0
        assert set(owner[rows].tolist()) == {0, 1}
        place, box = dense.place[rows], objects.box[owner[rows]]
        assert bool(((place > box[:, :2]) & (place < box[:, 2:])).all())


def test_places_are_the_cells_of_each_level(exported: Callable[..., Path]) -> None:
    dense = make_detector(f"onnx:{exported('yolov5')}").dense(pictures())
    cells = [(SIZE[0] // stride) * (SIZE[1] // stride) for stride in STRIDES]
    assert dense.level.bincount().tolist() == [3 * count for count in cells]
    assert dense.stride.unique().tolist() == [8, 16, 32]
    first_map = dense.place[: cells[0]].view(SIZE[0] // 8, SIZE[1] // 8, 2)
    assert first_map[0, 0].tolist() == [4, 4]
    assert first_map[1, 2].tolist() == [20, 12]
    assert torch.equal(dense.place[cells[0] : 2 * cells[0]], dense.place[: cells[0]])  # the second anchor


@pytest.mark.parametrize("layout", LAYOUTS)
def test_gradients_agree_with_finite_differences(layout: str, exported: Callable[..., Path], tmp_path: Path) -> None:
    model = onnx.load(str(exported(layout)))
    for part in model.graph.node:  # exporters write casts from float32 to float32, which double() must pass
        part.input[:] = ["cast" if name == "images" else name for name in part.input]
    model.graph.node.insert(0, node("Cast", "images", output="cast", to=onnx.TensorProto.FLOAT))
    onnx.save(model, str(tmp_path / "a.onnx"))
    detector = copy.deepcopy(make_detector(f"onnx:{tmp_path / 'a.onnx'}")).double()
    images = pictures(1, (50, 90)).double().requires_grad_()

    def value(images: Tensor) -> Tensor:
        dense = detector.dense(images)
        assert dense.logit.dtype is torch.float64
        return dense.logit.mean() + dense.box.mean() / 100

    (gradient,) = torch.autograd.grad(value(images), images)
    direction = gradient / gradient.norm()
    with torch.no_grad():
        slope = (value(images + 1e-4 * direction) - value(images - 1e-4 * direction)) / 2e-4
    assert float(slope) == pytest.approx(float(gradient.norm()), rel=1e-3)


@pytest.mark.parametrize(("layout", "dynamic"), [("yolov8", True), ("yolox-cells", False)])
def test_an_export_keeps_every_promise(layout: str, dynamic: bool, exported: Callable[..., Path]) -> None:
    check_detector(make_detector(f"onnx:{exported(layout, dynamic=dynamic)}"))


def test_the_check_notes_an_export_with_a_silent_loss(exported: Callable[..., Path]) -> None:
    detector = make_detector(f"onnx:{exported('yolov8')}")
    detector.losses = lambda *_, **__: {}
    assert "losses of a detector without any: refused with ConfigError" in find_faults(detector)


def test_another_shape_lies_in_the_middle_of_the_padding_or_at_its_corner(exported: Callable[..., Path]) -> None:
    for layout, offset in (("yolov8", 16.0), ("yolox", 0.0)):  # 64 x 64 within 64 x 96 pixels
        detector = make_detector(f"onnx:{exported(layout)}")
        dense = detector.dense(pictures(1, (32, 32)))
        assert dense.place[0].tolist() == [(4 - offset) / 2, 2]  # the image is scaled by 2
        assert dense.stride[0] == 4
    one_pixel = torch.zeros(1, 3, 32, 32)
    one_pixel[..., 16, 16] = 1
    difference = detector.dense(one_pixel).logit - detector.dense(torch.zeros_like(one_pixel)).logit
    changed = difference.abs().amax(-1)[0] > 1e-4
    assert bool(changed.any())
    assert bool(((dense.place[changed] - 16.5).abs().amax(-1) < 3 * 16).all())


def test_a_fixed_batch_is_filled_up(exported: Callable[..., Path]) -> None:
    one, four = (make_detector(f"onnx:{exported('yolov5', batch=batch)}") for batch in (1, 4))
    images = pictures(5)
    torch.testing.assert_close(one.dense(images).box, four.dense(images).box)
    assert one.dense(images).box.shape[0] == 5


def test_saturated_scores_have_finite_logits_without_gradient() -> None:
    score = torch.tensor([0.0, 1e-30, 0.25, 0.5, 0.999, 1.0], requires_grad=True)
    logit = to_logit(score)
    assert bool(logit.isfinite().all())
    torch.testing.assert_close(logit[1:5].sigmoid(), score[1:5].detach())
    (gradient,) = torch.autograd.grad(logit.sum(), score)
    assert gradient[[0, 5]].tolist() == [0, 0]
    assert gradient[3] == pytest.approx(4)


# ---------------------------------------------------------------- attacks


def test_an_export_is_attacked_by_losses_of_its_outputs_and_not_by_a_training_loss(
    exported: Callable[..., Path],
) -> None:
    detector, images = make_detector(f"onnx:{exported('yolov8')}"), (pictures(1) * 255).round() / 255
    attack = make_attack("pgd", steps=3)
    for loss in ("margin", "vanish", "hide", "mislabel", "fabricate"):
        result = run_attack(attack, detector, images, true_boxes(), Budget(px(4)), objective=loss)
        assert bool((result.after > result.before).all()), loss
    for loss in ("full", "classification"):
        with pytest.raises(ConfigError, match="no training loss; attack it with the loss margin, vanish"):
            run_attack(attack, detector, images, true_boxes(), Budget(px(4)), objective=loss)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_default_loss_of_a_suite_rises_with_the_scores_that_it_hides(
    layout: str, exported: Callable[..., Path]
) -> None:
    """`vanish` lowers the scores of objects in every family of outputs, more than noise of the same size does."""
    detector, images = make_detector(f"onnx:{exported(layout)}"), (pictures(2) * 255).round() / 255
    score = detector.dense(images).logit.sigmoid()
    scores = []
    for name in ("pgd", "noise"):
        attack = make_attack(name, steps=4) if name == "pgd" else make_attack(name)
        result = run_attack(attack, detector, images, true_boxes() * 2, Budget(px(8)), objective="vanish")
        dense = detector.dense(result.images)
        shown = dense.logit.sigmoid() * (1.0 if dense.quality is None else dense.quality.sigmoid()[..., None])
        scores.append(float(shown.mean()))
    dense = detector.dense(images)
    clean = float((score * (1.0 if dense.quality is None else dense.quality.sigmoid()[..., None])).mean())
    assert scores[0] < clean
    assert scores[0] < scores[1]


def test_an_export_runs_through_a_digital_suite(exported: Callable[..., Path], tiny_set: Path, tmp_path: Path) -> None:
    """From the file to the report, with the loss and the audit that a suite chooses by itself."""
    suite = DigitalSuite(
        kind="digital",
        name="mine",
        detectors=[f"onnx:{exported('yolov8', dynamic=True)}"],
        data=str(tiny_set),
        split="all",
        attacks=["pgd"],
        sweeps=[],
        steps=2,
        replicates=0,
    )
    records = run(Digital().plan(suite), tmp_path, Resources(0, console=Console(file=io.StringIO())))
    assert [(record["status"], record["reason"]) for record in records] == [("ok", "")] * len(records)
    (attacked,) = (record for record in records if record["attack"] == "pgd")
    assert attacked["loss"] == "vanish"
    assert attacked["loss_after"] > attacked["loss_before"]
    assert attacked["references"]
    assert "vanish" in write_report(tmp_path).read_text()


def test_suites_with_exports_ascend_a_loss_that_they_have() -> None:
    def losses(*detectors: str, **keys: Any) -> set[str]:
        suite = DigitalSuite(kind="digital", name="mine", detectors=list(detectors), **keys)
        return {spec.loss for point in points_of(suite) for spec in point.specs}

    assert losses("yolov5n") == {"full", "margin"}
    assert losses("yolov5n", "onnx:a.onnx") == {"vanish", "margin"}
    assert losses("onnx:a.onnx", attacks=[{"name": "pgd", "loss": "full"}]) == {"full", "vanish"}  # noise: vanish


# ---------------------------------------------------------------- classes and options


def test_classes_come_from_a_file_the_metadata_or_coco(exported: Callable[..., Path], tmp_path: Path) -> None:
    names = tmp_path / "names.txt"
    names.write_text("lorry\n\ntram\nbicycle\n")
    assert make_detector(f"onnx:{exported('yolov8')}?classes={names}").classes == ("lorry", "tram", "bicycle")
    assert make_detector(f'onnx:{exported("yolov8")}?classes=["a","b","c"]@mine').classes == ("a", "b", "c")
    assert make_detector(f"onnx:{exported('yolox', classes=80)}").classes[:2] == ("person", "bicycle")
    for path, hint in ((exported("yolov8", classes=2), "2 classes and no names"), (exported("yolov8"), "")):
        names.write_text("lorry\n")
        with pytest.raises(ConfigError, match=hint or "3 classes and 1 names") as caught:
            make_detector(f"onnx:{path}" + ("" if hint else f"?classes={names}"))
        message(caught)
    names.write_text("\n")
    with pytest.raises(FormatError, match="no names of classes"):
        make_detector(f"onnx:{exported('yolov8')}?classes={names}")


def test_preprocessing_can_be_another(exported: Callable[..., Path]) -> None:
    path, images = exported("yolov8"), pictures()
    detector = onnx_detector(path, channels="bgr", scale=2.0, mean=[0.1, 0.2, 0.3], std=[2.0, 2.0, 4.0])
    mean, std = (torch.tensor(values)[:, None, None] for values in ((0.1, 0.2, 0.3), (2.0, 2.0, 4.0)))
    plain = onnx_detector(path)
    changed = (images.flip(1) * 2 - mean) / std
    torch.testing.assert_close(detector.dense(images).logit, plain.dense(changed).logit, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("layout=yolo", "no layout 'yolo'; layouts are yolov8, yolov5, yolox, retinanet, ssd"),
        ("layout=yolov5", "are those of none of yolov5"),
        ("layout=ssd", "a ssd has cls_logits"),
        ("channels=gbr", "channels are rgb or bgr"),
        ("mean=0.5", "mean is a list of three numbers"),
        ("input_width=640", "it takes images of 96 x 64 pixels alone"),
        ("threshold=2", "threshold 2 is not in"),
        ("colour=rgb", "unexpected keyword argument 'colour'"),
    ],
)
def test_an_option_that_does_not_fit_is_one_line(options: str, problem: str, exported: Callable[..., Path]) -> None:
    with pytest.raises(SSADError, match=re.escape(problem)) as caught:
        make_detector(f"onnx:{exported('yolov8')}?{options}")
    message(caught)


# ---------------------------------------------------------------- torchvision


class Pyramid(nn.Module):
    """Maps of the sizes that torchvision's anchors are made for."""

    def __init__(self, first: nn.Module, *later: nn.Module) -> None:
        super().__init__()
        self.out_channels = 8
        self.stages = nn.ModuleList((first, *later))

    def forward(self, images: Tensor) -> "OrderedDict[str, Tensor]":
        maps = itertools.accumulate(self.stages, lambda value, stage: torch.tanh(stage(value)), initial=images)
        return OrderedDict((str(index), value) for index, value in enumerate(list(maps)[1:]))


def halving(count: int) -> list[nn.Module]:
    return [nn.Conv2d(8, 8, 3, 2, 1) for _ in range(count)]


def tiny_model(kind: str) -> Any:
    """A model of torchvision with a tiny backbone, whose head answers differently from place to place."""
    torch.manual_seed(3)
    if kind == "retinanet":
        backbone = Pyramid(nn.Conv2d(3, 8, 8, 8), *halving(4))
        sizes = tuple((side, int(side * 2 ** (1 / 3)), int(side * 2 ** (2 / 3))) for side in (32, 64, 128, 256, 512))
        generator = AnchorGenerator(sizes, ((0.5, 1.0, 2.0),) * 5)
        model: Any = detection.RetinaNet(backbone, 4, anchor_generator=generator)
        for layer in (*model.head.classification_head.modules(), *model.head.regression_head.modules()):
            if isinstance(layer, nn.Conv2d):
                layer.weight.data *= 15
        return model.eval()
    if kind == "ssd300":
        backbone = Pyramid(nn.Conv2d(3, 8, 8, 8, 2), *halving(4), nn.Conv2d(8, 8, 3))
        generator = DefaultBoxGenerator(
            [[2], [2, 3], [2, 3], [2, 3], [2], [2]],
            scales=[0.07, 0.15, 0.33, 0.51, 0.69, 0.87, 1.05],
            steps=[8, 16, 32, 64, 100, 300],
        )
        settings: dict[str, Any] = {"image_mean": [0.48235, 0.45882, 0.40784], "image_std": [1 / 255] * 3}
    else:
        backbone = Pyramid(nn.Conv2d(3, 8, 16, 16), *halving(5))
        generator = DefaultBoxGenerator([[2, 3] for _ in range(6)], min_ratio=0.2, max_ratio=0.95)
        settings = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
    side = int(kind[-3:])
    head = SSDHead([8] * 6, generator.num_anchors_per_location(), 4)
    return detection.ssd.SSD(backbone, generator, (side, side), 4, head=head, **settings).eval()


@pytest.mark.parametrize("kind", ["retinanet", "ssd300", "ssdlite320"])
def test_torchvision_heads_give_its_boxes_and_losses(kind: str, tmp_path: Path) -> None:
    model = tiny_model(kind)
    size = (96, 128) if kind == "retinanet" else (int(kind[-3:]),) * 2
    path = export(tmp_path / f"{kind}.onnx", Heads(model), size)
    if kind == "retinanet":
        model.transform.fixed_size = size[::-1]
    original, images = wrap(model, CLASSES), pictures(2, (80, 110))
    detector = make_detector(f'onnx:{path}?classes=["car","person","stop_sign"]')
    assert isinstance(detector, OnnxOneStage)
    with torch.no_grad():
        expected, dense = original.dense(images), detector.dense(images)
    for name in ("logit", "box", "place", "stride", "level"):
        torch.testing.assert_close(getattr(dense, name), getattr(expected, name), rtol=1e-4, atol=1e-2)
    truth = true_boxes() * 2
    losses = detector.losses(dense, detector.assign(dense, truth))
    for name, value in original.losses(expected, original.assign(expected, truth)).items():
        torch.testing.assert_close(losses[name], value, rtol=1e-3, atol=1e-4)
    images.requires_grad_()
    (gradient,) = torch.autograd.grad(detector.dense(images).logit.square().mean(), images)
    assert bool(gradient.flatten(1).any(1).all())
    clean = (images.detach() * 255).round() / 255
    result = run_attack(make_attack("pgd", steps=3), detector, clean, truth, Budget(px(4)), objective="vanish")
    assert bool((result.after > result.before).all()), "the default of suites with exports"


def test_torchvision_heads_keep_every_promise(tmp_path: Path) -> None:
    path = export(tmp_path / "lite.onnx", Heads(tiny_model("ssdlite320")), (320, 320))
    check_detector(make_detector(f'onnx:{path}?classes=["car","person","stop_sign"]'))


def test_an_image_that_the_graph_normalises_is_not_normalised_again(tmp_path: Path) -> None:
    class Normalising(Heads):
        """Heads behind the model's normalisation."""

        def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
            return super().forward((images - 0.5) / 0.5)

    model, images = tiny_model("ssdlite320"), pictures()
    plain, normalising = (
        make_detector(f'onnx:{export(tmp_path / f"{index}.onnx", network, (320, 320))}?classes=["a","b","c"]')
        for index, network in enumerate((Heads(model), Normalising(model)))
    )
    torch.testing.assert_close(plain.dense(images).logit, normalising.dense(images).logit, rtol=1e-4, atol=1e-4)


# ---------------------------------------------------------------- refusals


def graph_of(
    path: Path, *nodes: Any, kind: int = onnx.TensorProto.FLOAT, axes: tuple[int, ...] = (1, 3, *SIZE)
) -> Path:
    """Write a graph of nodes from `images` to `output`."""
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        list(nodes), "g", [value("images", kind, list(axes))], [value("output", kind, [None] * len(axes))]
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 8
    path.write_bytes(model.SerializeToString())
    return path


def node(operator: str, *inputs: str, output: str = "output", **attributes: Any) -> Any:
    return onnx.helper.make_node(operator, list(inputs), [output], **attributes)


def refusal(path: Path) -> str:
    with pytest.raises(FormatError) as caught:
        make_detector(f"onnx:{path}")
    return message(caught)


@pytest.mark.parametrize("operator", ["NonMaxSuppression", "TopK", "NonZero", "GridSample", "Einstein"])
def test_an_operator_that_is_not_supported_is_named(
    operator: str, exported: Callable[..., Path], tmp_path: Path
) -> None:
    model = onnx.load(str(exported("yolov8")))
    last = model.graph.output[0].name
    added = {
        "NonMaxSuppression": node("NonMaxSuppression", last, last),
        "TopK": onnx.helper.make_node("TopK", [last, "count"], ["output", "indices"]),
        "NonZero": node("NonZero", last),
        "GridSample": node("GridSample", last, last),
        "Einstein": onnx.helper.make_node("Einstein", [last], ["output"], domain="com.mine"),
    }[operator]
    model.graph.node.append(added)
    model.graph.initializer.append(onnx.helper.make_tensor("count", onnx.TensorProto.INT64, [1], [5]))
    model.graph.output[0].name = "output"
    del model.graph.output[0].type.tensor_type.shape.dim[:]
    if operator == "Einstein":
        model.opset_import.append(onnx.helper.make_opsetid("com.mine", 1))
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    text = refusal(tmp_path / "a.onnx")
    assert f"the operator {operator} is not supported" in text
    assert ("without NMS" in text) == (operator in ("NonMaxSuppression", "TopK", "NonZero"))


def test_other_graphs_are_one_line(exported: Callable[..., Path], tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    assert "no file" in refusal(path)
    path.write_bytes(b"\x08\x08\x12\xff\xff")
    assert "not a readable ONNX file" in refusal(path)
    path.write_bytes(b"")
    assert "not a valid ONNX graph" in refusal(path)
    sigmoid = node("Sigmoid", "images")
    assert "its input is of float16" in refusal(graph_of(path, sigmoid, kind=onnx.TensorProto.FLOAT16))
    assert "images [B, 3, H, W]" in refusal(graph_of(path, sigmoid, axes=(1, 1, 64, 96)))
    assert "outputs [1, 3, 64, 96]" in refusal(graph_of(path, sigmoid))
    raw = TinyYolo("yolov8")
    with torch.no_grad():
        Boxless = type("Boxless", (TinyYolo,), {"forward": lambda self, x: TinyYolo.forward(self, x) / 640})
        shares = export(tmp_path / "shares.onnx", Boxless("yolov8"), names=dict(enumerate(CLASSES)))
    assert "its boxes are not centres and sizes in pixels" in refusal(shares)
    task = export(tmp_path / "pose.onnx", raw, task="pose")
    assert "task 'pose'" in refusal(task)
    broken_names = export(tmp_path / "names.onnx", raw, names="__import__('os').system('true')")
    assert "no names of classes" in refusal(broken_names)
    with pytest.raises(ConfigError, match="the file holds its weights"):
        make_detector(f"onnx:{exported('yolov8')}", weights="random")


def test_weights_beside_the_file_come_in_and_those_elsewhere_do_not(
    exported: Callable[..., Path], tmp_path: Path
) -> None:
    expected = make_detector(f"onnx:{exported('yolov8')}").dense(pictures())
    model = onnx.load(str(exported("yolov8")))
    path = tmp_path / "inside" / "a.onnx"
    path.parent.mkdir()
    onnx.save(model, str(path), save_as_external_data=True, location="a.onnx.data", size_threshold=0)
    torch.testing.assert_close(make_detector(f"onnx:{path}").dense(pictures()).box, expected.box)
    path.with_name("a.onnx.data").rename(tmp_path / "stolen")
    assert "its weights are not there" in refusal(path)
    path.with_name("a.onnx.data").symlink_to(tmp_path / "stolen")
    assert "outside its own folder" in refusal(path)
    raw = path.read_bytes().replace(b"a.onnx.data", b"../stolen\x2f\x2f")
    path.write_bytes(raw)
    assert "outside its own folder" in refusal(path)


def test_without_the_extra_it_is_named(exported: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    path = exported("yolov8")
    monkeypatch.setitem(__import__("sys").modules, "onnx2torch", None)
    with pytest.raises(MissingExtraError, match=r"needs the extra onnx \(onnx2torch is not installed\)") as caught:
        make_detector(f"onnx:{path}")
    message(caught)


def test_another_graph_has_another_hash(exported: Callable[..., Path], tmp_path: Path) -> None:
    from ssad.core.checkpoints import state_hash

    model = onnx.load(str(exported("yolov8")))
    model.doc_string = "the same weights"
    (tmp_path / "b.onnx").write_bytes(model.SerializeToString())
    first, second = (make_detector(f"onnx:{path}") for path in (exported("yolov8"), tmp_path / "b.onnx"))
    assert isinstance(first, OnnxYolo)
    assert state_hash(first) != state_hash(second)
    assert state_hash(first) == state_hash(make_detector(f"onnx:{exported('yolov8')}"))
