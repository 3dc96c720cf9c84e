"""The conformance test of detectors: it passes those of SSAD, and names the one promise that another breaks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import pytest
import torch
from helpers.mono3d import TINY, TINY_PGD, lively
from helpers.quick import others_slow
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.detectors.adapters.torchvision_models import MODELS, torchvision_detector
from ssad.detectors.check import DetectorCheckError, check_detector, each_fault, find_faults
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolov3 import YOLOV3, YOLOV3_TINY
from ssad.detectors.yolov5 import YOLOV5N

CLASSES = ("car", "person")
SIZE = (48, 64)
SMALL = replace(YOLOV3_TINY, width=0.125)
Reduction = Literal["batch", "image"]


# ---------------------------------------------------------------- those that keep their promises


@pytest.mark.parametrize("config", [TINY, pytest.param(TINY_PGD, marks=pytest.mark.slow)], ids=["fcos3d", "pgd"])
def test_mono3d_keeps_every_promise(config: Any) -> None:
    check_detector(lively(config))


@pytest.mark.parametrize(
    "spec", [SMALL, replace(YOLOV5N, width=0.125), replace(YOLOV3, width=0.125, depth=0.125)], ids=["tiny", "v5", "v3"]
)
def test_yolo_keeps_every_promise(spec: Any) -> None:
    check_detector(Yolo(spec, CLASSES))


def test_a_resized_yolo_keeps_every_promise() -> None:
    check_detector(Yolo(SMALL, CLASSES, input_width=96))


def test_the_promises_hold_in_float64() -> None:
    check_detector(Yolo(SMALL, CLASSES).double())


@pytest.mark.slow
def test_torchvision_keeps_every_promise() -> None:
    detector = torchvision_detector("ssdlite320_mobilenet_v3_large", classes=CLASSES)
    detector.model.transform.fixed_size = (128, 128)  # in place of 320, to be quick
    check_detector(detector)


@pytest.mark.slow
@pytest.mark.parametrize("model", [name for name in MODELS if not name.startswith("ssdlite")])
def test_every_model_of_torchvision_keeps_every_promise(model: str) -> None:
    options: dict[str, int] = {} if model == "ssd300_vgg16" else {"min_size": 96, "max_size": 160}
    if model.startswith("fasterrcnn"):
        options["rpn_post_nms_top_n_test"] = 50  # in place of 1,000, to be quick
    check_detector(torchvision_detector(model, classes=CLASSES, **options))


def test_it_leaves_the_detector_and_the_random_numbers_alone() -> None:
    detector = Yolo(SMALL, CLASSES)
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    draws = torch.get_rng_state()
    check_detector(detector, size=SIZE)
    assert torch.equal(draws, torch.get_rng_state())
    assert all(torch.equal(before[name], value) for name, value in detector.state_dict().items())
    assert not any(part.training for part in detector.modules())


# ---------------------------------------------------------------- those that break one

WRONG: dict[str, tuple[Callable[[], Any], str]] = {}


def breaks(promise: str) -> Callable[[Callable[[], Any]], Callable[[], Any]]:
    """Puts a class or builder of a broken detector into the table; promise: a part of the fault that names it."""

    def put(make: Callable[[], Any]) -> Callable[[], Any]:
        WRONG[make.__name__] = (make, promise)
        return make

    return put


class Base(Yolo):
    """A small detector that keeps every promise, with places to go wrong."""

    def __init__(self) -> None:
        super().__init__(SMALL, CLASSES)

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        return self.change(super().dense(images, intrinsic), images)

    def change(self, dense: Dense, images: Tensor) -> Dense:
        """Of what `dense` gives."""
        return dense

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        return [self.alter(one, images) for one in super().predict(images, intrinsic, threshold=threshold)]

    def alter(self, found: Detections, images: Tensor) -> Detections:
        """Of what `predict` gives."""
        return found

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        return self.own(super().assign(dense, truth))

    def own(self, assignment: Assignment) -> Assignment:
        """Of what `assign` gives."""
        return assignment

    def losses(self, dense: Dense, assignment: Assignment, *, reduction: Reduction = "batch") -> dict[str, Tensor]:
        return self.sum(super().losses(dense, assignment, reduction=reduction), assignment, reduction)

    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        """Of what `losses` gives."""
        return values


def test_the_base_of_the_broken_ones_keeps_every_promise() -> None:
    assert find_faults(Base(), size=SIZE) == []


@breaks("it lacks predict, assign, losses of")
def half_a_detector() -> Any:
    return SimpleNamespace(name="half", task="2d", classes=CLASSES, dense=Base().dense)


@breaks("name is a text")
def without_a_name() -> Any:
    detector = Base()
    detector.name = ""
    return detector


@breaks('task is "2d" or "3d"')
def with_another_task() -> Any:
    detector = Base()
    detector.task = "4d"  # type: ignore[assignment]
    return detector


@breaks("distinct names")
def with_a_class_twice() -> Any:
    detector = Base()
    detector.classes = ("car", "car")
    return detector


@breaks("distinct names")
def with_classes_in_a_list() -> Any:
    detector = Base()
    detector.classes = list(CLASSES)  # type: ignore[assignment]
    return detector


@breaks("parameters are frozen outside training")
def that_learns_in_eval_mode() -> Any:
    return Base().requires_grad_(True)


@breaks("C as many as classes")
class WithAColumnTooMany(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, logit=torch.cat([dense.logit, dense.logit[..., :1]], -1))


@breaks("Dense.size is height and width")
class WithASizeTurned(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, size=dense.size[::-1])


@breaks("Dense.stride is [P]")
class WithStridesOfZero(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, stride=torch.zeros_like(dense.stride))


@breaks("Dense.level is [P], whole numbers")
class WithLevelsAsFloats(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, level=dense.level.float())


@breaks("ordered finest first")
class WithFeaturesTurned(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, features=dense.features[::-1])


@breaks("what Dense holds is finite")
class WithAnInfiniteLogit(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, logit=torch.where(dense.level[:, None] == 1, -torch.inf, dense.logit))


@breaks("Dense.maps holds lists of tensors")
class WithMapsThatAreNoLists(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, maps={"raw": dense.maps["raw"][0]})  # type: ignore[dict-item]


@breaks("Dense.logit is differentiable to the images")
class WithTheGradientCut(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, logit=dense.logit.detach())


@breaks("the gradient of Dense.quality reaches the image")
class WithAGradientOfZero(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        assert dense.quality is not None
        return replace(dense, quality=dense.quality.detach() + 0 * dense.quality)


@breaks("the gradient of Dense.box is finite")
class WithAGradientOfNaN(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, box=dense.box + (0 * dense.box).abs().sqrt())


@breaks("Dense.logit of an image does not depend on the others")
class WithNormsOverTheBatch(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, logit=dense.logit - dense.logit.mean(0, keepdim=True))


@breaks("Dense.quality of an image does not depend on its batch")
class ThatCountsTheImages(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        assert dense.quality is not None
        return replace(dense, quality=dense.quality + 0.1 * len(images))


@breaks("Dense.box of an image does not depend on its batch")
class ThatKnowsThePlaceInTheBatch(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, box=dense.box + torch.arange(len(images))[:, None, None])


@breaks("detections of an image do not depend on its batch")
class ThatScoresByTheBatch(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        return replace(found, score=found.score ** (0.9 if len(images) == 1 else 1.0))


@breaks("predict answers for each image")
class ThatAnswersForOneOnly(Base):
    def predict(self, *args: Any, **options: Any) -> list[Detections]:
        return super().predict(*args, **options)[:1]


@breaks("detections come best first")
class WithTheWorstFirst(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        return Detections(found.score.flip(0), found.label.flip(0), found.box.flip(0))


@breaks("labels are within classes")
class WithLabelsFromOne(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        return replace(found, label=found.label + 1)


@breaks("labels are whole numbers")
class WithLabelsAsFloats(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        return replace(found, label=found.label.float())


@breaks("boxes are x1, y1, x2, y2")
class WithBoxesByMiddleAndSize(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        low, high = found.box[:, :2], found.box[:, 2:]
        return replace(found, box=torch.cat([(low + high) / 2, high - low], 1))


@breaks("scores lie between the threshold and 1")
class WithScoresAboveOne(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        return replace(found, score=1 + found.score)


@breaks("no score lies under the threshold")
class ThatKnowsNoThreshold(Base):
    def predict(self, images: Tensor, intrinsic: Tensor | None = None, **options: Any) -> list[Detections]:
        return super().predict(images, intrinsic, threshold=0.0)


@breaks("predict finds something")
class ThatFindsNothing(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        return Detections(found.score[:0], found.label[:0], found.box[:0])


@breaks("the same images give the same detections")
class ThatRollsDice(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        self.dice = getattr(self, "dice", None) or torch.Generator().manual_seed(0)
        return replace(found, box=found.box + torch.rand(1, generator=self.dice) * torch.ones(4))


@breaks("predict keeps no gradient")
class ThatKeepsTheGradient(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        with torch.enable_grad():
            return replace(found, score=found.score.clone().requires_grad_())


@breaks("torch's global random numbers")
class ThatUsesGlobalRandomNumbers(Base):
    def change(self, dense: Dense, images: Tensor) -> Dense:
        return replace(dense, logit=dense.logit + 1e-9 * torch.rand(()))


@breaks("changes torch's global random numbers")
class ThatSeedsGlobally(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        torch.manual_seed(0)
        return found


@breaks("torch's gradient mode")
class ThatLeavesGradientsOff(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        torch._C._set_grad_enabled(False)
        return found


@breaks("predict in training mode changes training mode")
class ThatStaysInEvalMode(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        self.eval()
        return found


@breaks("changes the values of anchors")
class ThatChangesABuffer(Base):
    def alter(self, found: Detections, images: Tensor) -> Detections:
        self.anchors.add_(1e-6)
        return found


@breaks("changes requires_grad or grad")
class ThatUnfreezesItself(Base):
    def own(self, assignment: Assignment) -> Assignment:
        self.requires_grad_(True)
        return assignment


@breaks("places with an owner have a class")
class WithAnOwnerWithoutAClass(Base):
    def own(self, assignment: Assignment) -> Assignment:
        return replace(assignment, label=assignment.label.clamp(max=-1))


@breaks("a place has the class of its owner")
class WithTheWrongClass(Base):
    def own(self, assignment: Assignment) -> Assignment:
        return replace(assignment, label=torch.where(assignment.label >= 0, 1 - assignment.label, assignment.label))


@breaks("some place answers for a large object")
class ThatOwnsNothing(Base):
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        none = super().assign(dense, [Truth(one.label[:0], one.box[:0]) for one in truth])
        super().assign(dense, truth)
        return replace(none, truth=tuple(truth))


@breaks("no gradient flows through assign")
class ThatAssignsWithGradient(Base):
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        found = super().assign(dense, truth)
        return replace(found, extra={**found.extra, "score": dense.logit.sum(-1)})


@breaks("losses have the same names for both reductions")
class WithOtherNames(Base):
    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        return {f"{name}_{reduction}": value for name, value in values.items()}


@breaks('losses are scalars for "batch"')
class WithLossesThatAreNotSummed(Base):
    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        return {name: value.reshape(-1) for name, value in values.items()}


@breaks("losses are [B] for")
class ThatKnowsNoReduction(Base):
    def losses(self, dense: Dense, assignment: Assignment, *, reduction: Reduction = "batch") -> dict[str, Tensor]:
        return super().losses(dense, assignment)


@breaks("losses are finite, also for an image without objects")
class WithNaNForAnImageWithoutObjects(Base):
    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        found = (assignment.label >= 0).sum(1)
        if reduction == "image":
            return {name: value * (found / found) for name, value in values.items()}
        return values


@breaks("losses are finite without any object")
class WithNaNWithoutObjects(Base):
    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        found = (assignment.label >= 0).sum()
        return (
            {name: value * (found / found) for name, value in values.items()} if len(assignment.label) > 1 else values
        )


@breaks('"image" losses are those of each image alone')
class WithImagesOverTheBatch(Base):
    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        if reduction == "image":
            return {name: value / len(value) for name, value in values.items()}
        return values


@breaks('the gradient of the "image" losses reaches every image with objects')
class WithAnImageLeftOut(Base):
    def sum(self, values: dict[str, Tensor], assignment: Assignment, reduction: Reduction) -> dict[str, Tensor]:
        if reduction == "image":
            return {name: torch.cat([value[:-1], value[-1:].detach()]) for name, value in values.items()}
        return values


@breaks("pictures of 67 x 91: no error, but ValueError: not a multiple of 16")
class ThatWantsWholeCells(Base):
    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        if images.ndim == 4 and images.shape[2] % 16:
            raise ValueError("not a multiple of 16")
        return super().dense(images, intrinsic)


@breaks("greyscale images: refused with ConfigError")
class ThatTakesGreyscale(Base):
    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        return super().dense(images.expand(-1, 3, -1, -1) if images.ndim == 4 else images)


@breaks("uint8 images: refused with ConfigError, not TypeError")
class ThatRefusesInAnotherWay(Base):
    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        if images.dtype is torch.uint8:
            raise TypeError("no")
        return super().dense(images)


@breaks("labels that are none of the classes: refused with ConfigError")
class ThatTakesAnyLabel(Base):
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        return super().assign(dense, [replace(one, label=one.label.clamp(max=1)) for one in truth])


@breaks("truth of another number of images: refused with ConfigError")
class ThatFillsUpTheTruth(Base):
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        return super().assign(dense, [*truth][: len(dense.box)])


class Base3D(Mono3D):
    """A small detector of 3D boxes."""

    def __init__(self) -> None:
        super().__init__(TINY)
        self.load_state_dict(lively(TINY).state_dict())

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        found = super().predict(images, intrinsic, threshold=threshold)
        return [replace(one, solid=self.alter(one.solid)) for one in found]

    def alter(self, solid: Any) -> Any:
        """The solids."""
        return solid


@breaks('Detections.solid is there for task "3d"')
class WithoutSolids(Base3D):
    def alter(self, solid: Any) -> Any:
        return None


@breaks("sizes are above 0")
class WithFlatSolids(Base3D):
    def alter(self, solid: Any) -> Any:
        return replace(solid, size_lhw=solid.size_lhw * torch.tensor([1.0, 0.0, 1.0]))


@breaks("Solids.centre is ['N', 3]")
class WithPlanarCentres(Base3D):
    def alter(self, solid: Any) -> Any:
        return replace(solid, centre=solid.centre[:, [0, 2]])


@breaks("attributes are within")
class WithAttributesFromOne(Base3D):
    def alter(self, solid: Any) -> Any:
        return replace(solid, attribute=solid.attribute + 9)


@breaks("images without an intrinsic: refused with ConfigError")
class ThatGuessesTheLens(Base3D):
    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        lens = torch.eye(3).expand(len(images), 3, 3) if intrinsic is None and images.ndim == 4 else intrinsic
        return super().predict(images, lens, threshold=threshold)


@pytest.fixture
def torch_state() -> Iterator[None]:
    """Puts back what the broken ones change in torch itself."""
    threads, grad, draws = torch.get_num_threads(), torch.is_grad_enabled(), torch.get_rng_state()
    yield
    torch.set_grad_enabled(grad)
    torch.set_num_threads(threads)
    torch.set_rng_state(draws)


@pytest.mark.parametrize("name", WRONG)
def test_it_names_the_broken_promise(name: str, torch_state: None) -> None:
    """Up to the part that finds it; the whole check in the slow test below."""
    make, promise = WRONG[name]
    said = []
    for fault in each_fault(make(), size=SIZE):
        said.append(fault)
        if promise in fault:
            return
    pytest.fail(f"not named; {said}")


QUICK_WRONG = ["half_a_detector", "WithAColumnTooMany"]


@pytest.mark.parametrize("name", others_slow(WRONG, QUICK_WRONG))
def test_the_whole_check_tells_all_broken_promises(name: str, torch_state: None) -> None:
    make, promise = WRONG[name]
    with pytest.raises(DetectorCheckError) as caught:
        check_detector(make(), size=SIZE)
    lines = str(caught.value).splitlines()
    assert any(promise in line for line in lines[1:]), lines
    assert lines[0] == f"{len(lines) - 1} broken promises:"
    if name == "WithAColumnTooMany":
        assert len(lines) > 2, "parts after the first that finds something are tried too"


def test_an_error_in_a_detector_is_one_of_its_faults() -> None:
    class Broken(Base):
        def predict(self, *args: Any, **options: Any) -> list[Detections]:
            raise RuntimeError("several\nlines")

    faults = find_faults(Broken(), size=SIZE)
    assert any(fault.startswith("predict: no error, but RuntimeError: several lines (") for fault in faults)
