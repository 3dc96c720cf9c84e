"""Other people's detectors: torchvision's predictions and losses are the source's; ultralytics only where installed."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from ssad.core.checkpoints import WeightsCard, save_weights
from ssad.core.detections import Detections, Truth
from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.detectors import make_detector
from ssad.detectors.adapters.torchvision_models import MODELS, torchvision_detector, wrap
from ssad.detectors.adapters.two_stage import TwoStage
from ssad.detectors.adapters.ultralytics import ultralytics_detector
from ssad.detectors.check import check_detector

CLASSES = ("car", "person", "dog")
SIZE = (80, 120)
LITE = "ssdlite320_mobilenet_v3_large"
ONE_STAGE = [
    "fcos_resnet50_fpn",
    LITE,
    pytest.param("retinanet_resnet50_fpn", marks=pytest.mark.slow),
    pytest.param("retinanet_resnet50_fpn_v2", marks=pytest.mark.slow),
    pytest.param("ssd300_vgg16", marks=pytest.mark.slow),
]
TWO_STAGE = [
    "fasterrcnn_mobilenet_v3_large_320_fpn",
    pytest.param("fasterrcnn_mobilenet_v3_large_fpn", marks=pytest.mark.slow),
    pytest.param("fasterrcnn_resnet50_fpn", marks=pytest.mark.slow),
    pytest.param("fasterrcnn_resnet50_fpn_v2", marks=pytest.mark.slow),
]


def lively(model: str, **options: Any) -> Any:
    """A detector of torchvision whose heads answer differently from place to place."""
    if not model.startswith("ssd"):
        options |= {"min_size": 96, "max_size": 160}
    detector = torchvision_detector(model, classes=CLASSES, seed=3, **options)
    norms = [part for part in detector.model.modules() if isinstance(part, nn.BatchNorm2d)]
    for part in norms:
        part.momentum = 1.0
        part.train()
    with torch.no_grad():  # fresh statistics fit nothing, and maps would fade away
        for _ in range(2):
            detector.dense(pictures(2))
    detector.eval()
    if isinstance(detector, TwoStage):
        detector.model.roi_heads.box_predictor.cls_score.weight.data *= 5
        detector.model.roi_heads.detections_per_img = 10_000
        return detector
    detector.model.detections_per_img = 10_000
    head = detector.model.head.classification_head
    if detector.kind != "ssd":
        head.cls_logits.weight.data *= 4 if model.endswith("v2") else 60  # the towers of v2 have norms
        detector.model.topk_candidates = 10**6  # columns without a name take no places
    return detector


def pictures(count: int = 2, size: tuple[int, int] = SIZE) -> Tensor:
    """Coarse and fine random patterns."""
    draws = torch.Generator().manual_seed(5)
    coarse = torch.rand(count, 3, 4, 5, generator=draws)
    smooth = nn.functional.interpolate(coarse, size, mode="bilinear", align_corners=False)
    return 0.7 * smooth + 0.3 * torch.rand(count, 3, *size, generator=draws)


def truth() -> list[Truth]:
    """Two objects in the first picture, one in the second."""
    boxes = torch.tensor([[5.0, 10, 60, 70], [50, 8, 115, 60], [20, 20, 100, 75]])
    return [Truth(torch.tensor([0, 2]), boxes[:2]), Truth(torch.tensor([1]), boxes[2:])]


def alike(found: Detections, theirs: dict[str, Tensor], columns: Tensor) -> None:
    """The same detections; nearly equal scores may stand in another order. Columns without a name are left out."""
    named = torch.isin(theirs["labels"], columns)
    scores, labels, boxes = (theirs[name][named] for name in ("scores", "labels", "boxes"))
    assert len(found.score) == len(scores) > 5
    torch.testing.assert_close(found.score, scores, rtol=2e-3, atol=1e-4)  # processors differ by up to 2e-4
    near = (found.box[:, None] - boxes).abs().amax(-1) < 0.01
    near &= columns[found.label][:, None] == labels
    near &= (found.score[:, None] - scores).abs() < 1e-3
    assert near.any(1).all()
    assert near.any(0).all()


# ---------------------------------------------------------------- torchvision


@pytest.mark.parametrize("model", ONE_STAGE + TWO_STAGE)
def test_predictions_are_those_of_torchvision(model: str) -> None:
    detector, images = lively(model), pictures()
    with torch.no_grad():
        theirs = detector.model(list(images))
    for found, their in zip(detector.predict(images), theirs, strict=True):
        alike(found, their, detector.columns)


def sources_losses(detector: Any, images: Tensor, objects: list[Truth]) -> dict[str, Tensor]:
    """torchvision's own, with norms as in evaluation."""
    targets = [{"boxes": one.box, "labels": detector.columns[one.label]} for one in objects]
    detector.model.train()
    try:
        for part in detector.model.modules():
            if isinstance(part, nn.BatchNorm2d | nn.Dropout):
                part.eval()
        result: dict[str, Tensor] = detector.model(list(images), targets)
    finally:
        detector.eval()
    return result


def compare(detector: Any, images: Tensor, objects: list[Truth]) -> None:
    theirs = sources_losses(detector, images, objects)
    dense = detector.dense(images)
    ours = detector.losses(dense, detector.assign(dense, objects))
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        assert float(value) > 0
        torch.testing.assert_close(ours[name], value, rtol=1e-4, atol=1e-6, msg=lambda text, n=name: f"{n}: {text}")


@pytest.mark.parametrize("model", ONE_STAGE)
def test_losses_are_those_of_torchvision(model: str) -> None:
    compare(lively(model), pictures(), truth())


@pytest.mark.parametrize("model", TWO_STAGE)
def test_losses_of_two_stages_are_those_of_torchvision_where_nothing_is_drawn(model: str) -> None:
    detector, images = lively(model), pictures()
    rpn, roi = detector.model.rpn, detector.model.roi_heads
    for sampler in (rpn.fg_bg_sampler, roi.fg_bg_sampler):
        sampler.batch_size_per_image = 10**6  # all are taken
    rpn._pre_nms_top_n["training"] = rpn._pre_nms_top_n["testing"]
    rpn._post_nms_top_n["training"] = rpn._post_nms_top_n["testing"]
    roi.add_gt_proposals = lambda proposals, boxes: proposals
    dense = detector.dense(images)
    boxes = dense.maps["proposals"][0] / dense.maps["scale"][0]
    sides = boxes[..., 2:] - boxes[..., :2]
    objects = []
    for box, side in zip(boxes, sides, strict=True):  # objects that a proposal meets
        large = box[(side > 25).all(-1)]
        assert len(large) > 2
        objects.append(Truth(torch.tensor([0, 2]), torch.stack([large[0], large[-1]])))
    compare(detector, images, objects)


@pytest.mark.slow
def test_losses_of_two_stages_are_the_mean_over_the_draws() -> None:
    detector, images, objects = lively(TWO_STAGE[0]), pictures(), truth()
    detector.model.rpn.fg_bg_sampler.batch_size_per_image = 64
    dense = detector.dense(images)
    ours = detector.losses(dense, detector.assign(dense, objects))
    draws = torch.get_rng_state()
    try:
        torch.manual_seed(0)
        theirs = [sources_losses(detector, images, objects) for _ in range(40)]
    finally:
        torch.set_rng_state(draws)
    for name in ("loss_objectness", "loss_rpn_box_reg"):
        values = torch.stack([one[name] for one in theirs])
        error = float(values.std()) / 40**0.5
        assert abs(float(values.mean() - ours[name])) < 4 * error + 1e-5


def test_crowd_objects_count_neither_way() -> None:
    detector, images, objects = lively(LITE), pictures(), truth()
    crowd = [replace(one, crowd=torch.ones(len(one.label), dtype=torch.bool)) for one in objects]
    dense = detector.dense(images)
    seen, ignored = detector.assign(dense, objects), detector.assign(dense, crowd)
    assert torch.equal(ignored.label == -2, seen.label >= 0)
    assert (ignored.owner == -1).all()


def test_a_threshold_of_the_maker_is_the_default() -> None:
    detector = torchvision_detector(LITE, classes=CLASSES, threshold=0.3)
    assert detector.threshold == 0.3
    with pytest.raises(ConfigError, match="threshold"):
        torchvision_detector(LITE, classes=CLASSES, threshold=1.0)


def test_the_seed_decides_the_weights_and_nothing_else() -> None:
    draws = torch.get_rng_state()
    one, same, other = (torchvision_detector(LITE, classes=CLASSES, seed=seed).state_dict() for seed in (1, 1, 2))
    assert torch.equal(draws, torch.get_rng_state())
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert any(not torch.equal(one[name], other[name]) for name in one)


def test_the_classes_are_those_of_coco_without_a_word() -> None:
    detector = torchvision_detector(LITE)
    assert len(detector.classes) == 80
    assert detector.classes[:3] == ("person", "bicycle", "car")
    assert detector.columns[:3].tolist() == [1, 2, 3]
    assert detector.dense(pictures(1)).logit.shape[2] == 80


@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_weights_go_out_and_come_in(suffix: str, tmp_path: Path) -> None:
    detector, images, path = torchvision_detector(LITE, classes=CLASSES, seed=3), pictures(), tmp_path / f"lite{suffix}"
    if suffix == ".pth":  # as torchvision writes them
        torch.save(detector.model.state_dict(), path)
    else:
        save_weights(path, detector.state_dict(), card=WeightsCard("drawn", "-", 3, CLASSES))
    again = torchvision_detector(LITE, classes=CLASSES, weights=path, seed=9)
    assert torch.equal(detector.dense(images).logit, again.dense(images).logit)
    with pytest.raises(FormatError, match="made for 3 or 4 classes, this detector has 2") as caught:
        torchvision_detector(LITE, classes=("car", "dog"), weights=path)
    assert "\n" not in str(caught.value)


def test_weights_of_frozen_norms_are_used_as_they_were_trained(tmp_path: Path) -> None:
    model = "retinanet_resnet50_fpn"
    state = torchvision_detector(model, classes=CLASSES).model.state_dict()
    torch.save({name: v for name, v in state.items() if not name.endswith("num_batches_tracked")}, tmp_path / "a.pth")
    detector = torchvision_detector(model, classes=CLASSES, weights=tmp_path / "a.pth")
    norms = [part for part in detector.model.modules() if isinstance(part, nn.BatchNorm2d)]
    assert norms
    assert {norm.eps for norm in norms} == {0.0}


def test_an_unknown_model_is_one_line() -> None:
    with pytest.raises(UnknownNameError, match=r"closest: .*retinanet_resnet50_fpn") as caught:
        torchvision_detector("retinanet_resnet50")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("classes", [(), ("car", "car"), "car"], ids=["none", "twice", "a text"])
def test_classes_must_be_distinct_names(classes: Any) -> None:
    with pytest.raises(ConfigError, match="classes must be distinct names, at least one") as caught:
        torchvision_detector(LITE, classes=classes)
    assert "\n" not in str(caught.value)


def test_an_option_that_the_builder_lacks_is_one_line() -> None:
    with pytest.raises(ConfigError, match="torchvision:fcos_resnet50_fpn: no option 'colour'") as caught:
        torchvision_detector("fcos_resnet50_fpn", classes=CLASSES, colour="red")
    assert "\n" not in str(caught.value)


def test_a_model_of_another_kind_is_one_line() -> None:
    with pytest.raises(ConfigError, match="a Linear is no FCOS, RetinaNet or SSD of torchvision"):
        wrap(nn.Linear(2, 2), CLASSES)


def test_an_assignment_of_another_batch_is_one_line() -> None:
    detector = torchvision_detector(LITE, classes=CLASSES)
    dense = detector.dense(pictures())
    assignment = detector.assign(dense, truth())
    with pytest.raises(ConfigError, match="another number or size"):
        detector.losses(detector.dense(pictures(1)), assignment)


def test_it_can_be_had_by_name() -> None:
    name = "ssad.detectors.adapters.torchvision_models:torchvision_detector"
    detector = make_detector(name, model=LITE, classes=CLASSES)
    assert detector.name == f"torchvision:{LITE}"
    assert LITE in MODELS


# ---------------------------------------------------------------- ultralytics

HERE = importlib.util.find_spec("ultralytics") is not None


@pytest.mark.skipif(HERE, reason="ultralytics is installed")
def test_without_the_package_one_line_says_so() -> None:
    with pytest.raises(ConfigError) as caught:
        ultralytics_detector("yolov8n")
    text = str(caught.value)
    assert "the package is not installed; in the checkout of SSAD run: pip install '.[ultralytics]'" in text
    assert "AGPL-3.0" in text
    assert "\n" not in text


@pytest.fixture
def ultralytics() -> Any:
    """The package, imported as the adapter does."""
    pytest.importorskip("ultralytics", reason="ultralytics (AGPL-3.0) is not installed")
    from ssad.detectors.adapters.ultralytics import load_package

    return load_package()


@pytest.mark.parametrize("model", ["yolov8n", "yolo11n", "yolov5nu"])
def test_ultralytics_keeps_every_promise(model: str, ultralytics: Any) -> None:
    check_detector(ultralytics_detector(model, classes=CLASSES))


def test_ultralytics_boxes_are_those_of_the_package(ultralytics: Any) -> None:
    detector, images = ultralytics_detector("yolov8n", classes=CLASSES), pictures(2, (64, 96))
    with torch.no_grad():
        answer = detector.network(images)[0]
        dense = detector.dense(images)
    low, high = dense.box[..., :2], dense.box[..., 2:]
    boxes = torch.cat([(low + high) / 2, high - low], -1).transpose(1, 2)
    torch.testing.assert_close(boxes, answer[:, :4], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(dense.logit.sigmoid().transpose(1, 2), answer[:, 4:], rtol=1e-4, atol=1e-6)


def test_ultralytics_weights_go_out_and_come_in(ultralytics: Any, tmp_path: Path) -> None:
    detector, images = ultralytics_detector("yolov8n", classes=CLASSES), pictures()
    torch.save({"model": detector.network.state_dict()}, tmp_path / "a.pt")
    again = ultralytics_detector("yolov8n", classes=CLASSES, weights=tmp_path / "a.pt", seed=5)
    assert torch.equal(detector.dense(images).logit, again.dense(images).logit)


@pytest.mark.parametrize("model", ["yolov8n-cls", "nothing"])
def test_another_model_of_ultralytics_is_one_line(model: str, ultralytics: Any) -> None:
    with pytest.raises(ConfigError, match=re.escape("ultralytics")) as caught:
        ultralytics_detector(model)
    assert "\n" not in str(caught.value)
