"""From a camera's truth through the merging of cameras to the official scores: what goes in must come out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.detections import Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import read_truth
from ssad.detectors import make_detector
from ssad.detectors.on_scenes import detect_scene, joined, match_boxes, score_2d, to_host
from ssad.metrics.detection_boxes import TP_METRICS
from ssad.training.batches import PictureSet
from ssad.training.data import nuscenes_items


class Oracle:
    """Says what is true, camera by camera in the order of the frames."""

    name, task, classes = "oracle", "3d", ()

    def __init__(self, truths: Iterator[Truth]) -> None:
        self.truths = truths

    def predict(self, images: torch.Tensor, intrinsic: torch.Tensor | None = None, **_: object) -> list[Detections]:
        assert intrinsic is None or len(intrinsic) == len(images)
        found = [next(self.truths) for _ in images]
        return [Detections(torch.linspace(1, 0.5, len(t.label)), t.label, t.box, t.solid) for t in found]


def test_perfect_cameras_score_one(recorded: Path) -> None:
    """All that the cameras see, six of them merged, is found again: AP 1 but for what only the LiDAR hits."""
    found = []
    with NuScenes(recorded) as data:
        for record in data.scenes():
            scene = data.scene(record.name)
            truths = [
                camera_truth(f, scene.annotations(f.sample_token))
                for f in scene.frames
                if f.modality == "camera" and f.key_frame
            ]
            # frames come by time: put those of a sample together, as the detector is shown them
            keys = [f.sample_token for f in scene.frames if f.modality == "camera" and f.key_frame]
            ordered = [t for s in scene.samples for t, k in zip(truths, keys, strict=True) if k == s.token]
            found += detect_scene(Oracle(iter(ordered)), recorded, scene)  # type: ignore[arg-type]
    scores = match_boxes(found, read_truth(recorded, "v1.0-ssad")).scores()
    there = scores.truth > 0
    assert there.sum() >= 3
    each = scores.ap.mean(1)
    assert np.average(each[there], weights=scores.truth[there]) > 0.9
    # what is there in one sample alone has no velocity, what only the LiDAR hits was not found
    several = (scores.truth > 1) & (each > 0)
    assert several.sum() >= 3
    errors = dict(zip(TP_METRICS, np.nanmean(scores.errors[several], axis=0), strict=True))
    assert errors["trans_err"] < 0.4, "cameras fire up to 43 ms before the sweep"
    assert errors["scale_err"] < 1e-3
    assert errors["orient_err"] < 0.02
    assert errors["vel_err"] < 0.1
    assert errors["attr_err"] < 0.01


def test_2d_truth_scores_one_and_noise_does_not(recorded: Path) -> None:
    truths = tuple(item.truth for item in nuscenes_items(recorded, None, "all"))
    bank = PictureSet(torch.zeros(len(truths), 90, 160, 3, dtype=torch.uint8), truths)
    perfect = Oracle(iter(truths))
    perfect.classes = tuple(str(k) for k in range(10))  # type: ignore[assignment]
    assert score_2d(perfect, bank)["AP50"] == pytest.approx(1.0)  # type: ignore[arg-type]
    moved = [Truth(t.label, t.box + 40, t.solid) for t in truths]
    wrong = Oracle(iter(moved))
    wrong.classes = perfect.classes
    assert score_2d(wrong, bank)["AP50"] < 0.3  # type: ignore[arg-type]


def test_2d_classes_are_matched_by_name() -> None:
    """The truth has a class in front that the detector does not know: it is left out, the others keep their names."""
    box = torch.tensor([[10.0, 10.0, 40.0, 40.0], [60.0, 20.0, 90.0, 50.0], [100.0, 5.0, 140.0, 60.0]])
    truth = (Truth(torch.tensor([0, 1, 2]), box),)
    bank = PictureSet(torch.zeros(1, 90, 160, 3, dtype=torch.uint8), truth)

    def scored(classes: tuple[str, ...] | None) -> dict[str, float]:
        oracle = Oracle(iter([Truth(torch.tensor([0, 1]), box[1:])]))
        oracle.classes = ("car", "bus")  # type: ignore[assignment]
        return score_2d(oracle, bank, classes=classes)  # type: ignore[arg-type]

    assert scored(("stop_sign", "car", "bus")) == pytest.approx({"AP50": 1.0, "AP50_car": 1.0, "AP50_bus": 1.0})
    assert scored(("stop_sign", "bus", "car"))["AP50"] == pytest.approx(0.0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", ["fcos3d-light", "pgd-det-light"])
def test_a_gpu_finds_the_same_boxes(recorded: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    with NuScenes(recorded) as data:
        scene = data.scene("scene-oldmarket-000")
        here, there = (
            detect_scene(make_detector(name, device=device), recorded, scene, device=device)
            for device in ("cpu", "cuda")
        )
    assert sum(int((one.boxes.score > 0.1).sum()) for one in here) > 3
    for one, other in zip(here, there, strict=True):
        sure, same = one.boxes.score > 0.1, other.boxes.score > 0.1
        assert abs(int(sure.sum()) - int(same.sum())) <= 1, "but for one at the threshold"
        for k in np.flatnonzero(sure):
            alike = other.boxes.label == one.boxes.label[k]
            alike &= np.linalg.norm(other.boxes.centre - one.boxes.centre[k], axis=1) < 0.05
            alike &= np.abs(other.boxes.score - one.boxes.score[k]) < 0.01
            assert alike.any()


def test_fewer_pictures_at_a_time_where_memory_is_short(recorded: Path) -> None:
    class Small(Oracle):
        """A detector on a small device."""

        calls: list[int] = []  # noqa: RUF012
        room = 2

        def predict(self, images: torch.Tensor, intrinsic: torch.Tensor | None = None, **_: object) -> list[Detections]:
            if len(images) > self.room:
                raise torch.OutOfMemoryError("CUDA out of memory")
            self.calls.append(len(images))
            return super().predict(images, intrinsic)

    with NuScenes(recorded) as data:
        scene = data.scene("scene-oldmarket-000")
        key = [f for f in scene.frames if f.modality == "camera" and f.key_frame]
        ordered = [
            camera_truth(f, scene.annotations(f.sample_token))
            for s in scene.samples
            for f in key
            if f.sample_token == s.token
        ]
        whole = detect_scene(Oracle(iter(ordered)), recorded, scene)  # type: ignore[arg-type]
        parts = detect_scene(Small(iter(ordered)), recorded, scene)  # type: ignore[arg-type]
        assert set(Small.calls) <= {1, 2}
        assert sum(Small.calls) == len(key)
        for one, other in zip(whole, parts, strict=True):
            assert (one.boxes.centre == other.boxes.centre).all()
        Small.room = 0
        with pytest.raises(torch.OutOfMemoryError):
            detect_scene(Small(iter(ordered)), recorded, scene)  # type: ignore[arg-type]


def test_tensors_are_changed_together_where_they_are_of_a_kind() -> None:
    calls = []

    def twice(value: torch.Tensor) -> torch.Tensor:
        calls.append(value.shape)
        return 2 * value

    alike = [torch.rand(n, 3) for n in (2, 0, 5)]
    for before, after in zip(alike, joined(alike, twice), strict=True):
        assert (after == 2 * before).all()
    assert calls == [(7, 3)]
    for mixed in ([torch.rand(2, 3), torch.rand(2, 4)], [torch.rand(2), torch.arange(2)], [torch.tensor(1.0)]):
        calls.clear()
        for before, after in zip(mixed, joined(mixed, twice), strict=True):
            assert (after == 2 * before).all()
        assert len(calls) == len(mixed)


def test_detections_come_to_the_host_as_they_are() -> None:
    def some(count: int, *, three: bool) -> Detections:
        score, label, box = torch.rand(count), torch.arange(count), torch.rand(count, 4)
        solid = Solids(torch.rand(count, 3), torch.rand(count, 3), torch.rand(count), torch.rand(count, 2), label)
        return Detections(score, label, box, solid if three else None)

    before = [some(3, three=True), some(0, three=True), some(5, three=False), some(2, three=True)]
    after = to_host(before)
    assert [len(one.score) for one in after] == [3, 0, 5, 2]
    assert [one.solid is None for one in after] == [False, False, True, False]
    assert after[3].solid is not None
    assert before[3].solid is not None
    assert (after[3].solid.yaw == before[3].solid.yaw).all(), "solids stay with their detections"
    assert not to_host([])
    with pytest.raises(ConfigError, match="holds tensors"):
        to_host([Detections(np.zeros(1), torch.zeros(1), torch.zeros(1, 4))])  # type: ignore[arg-type]
