"""From a camera's truth through the merging of cameras to the official scores: what goes in must come out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.detections import Detections, Truth
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import read_truth
from ssad.detectors import make_detector
from ssad.detectors.on_scenes import detect_scene, match_boxes, score_2d
from ssad.metrics.detection_boxes import TP_METRICS
from ssad.training.batches import ImageSet
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
    bank = ImageSet(torch.zeros(len(truths), 90, 160, 3, dtype=torch.uint8), truths)
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
    bank = ImageSet(torch.zeros(1, 90, 160, 3, dtype=torch.uint8), truth)

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
