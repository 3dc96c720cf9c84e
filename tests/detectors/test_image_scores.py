"""AP50 of 2D detectors over the camera images of a data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.detections import Detections
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors.image_scores import (
    ImageMatches,
    gather_images,
    image_figures,
    match_images,
    read_image_truth,
)
from ssad.metrics.detection2d import Boxes2D, average_precision


@pytest.fixture(scope="module")
def matched(tiny_set: Path) -> tuple[ImageMatches, float]:
    """Every second box, shaken and scored at random, and false ones; beside AP50 of all images as one list."""
    chance = np.random.default_rng(0)
    with NuScenes(tiny_set) as data:
        names = tuple(scene.name for scene in data.scenes())
        scenes = [data.scene(name) for name in names]
    found, tokens, flat = [], [], []
    for scene in scenes:
        by_sample = {}
        for frame in scene.frames:
            if frame.modality == "camera" and frame.key_frame:
                by_sample.setdefault(frame.sample_token, []).append(frame)
        own = []
        for sample in scene.samples:
            tokens.append(sample.token)
            for frame in by_sample[sample.token]:
                truth = camera_truth(frame, scene.annotations(frame.sample_token))
                kept = chance.random(len(truth.label)) < 0.7
                box = truth.box.numpy()[kept] + chance.normal(0, 1.0, (int(kept.sum()), 4))
                label = truth.label.numpy()[kept]
                box = np.concatenate([box, [[0, 0, 9, 9]]])
                label = np.append(label, 0)
                score = chance.random(len(label))
                flat.append((truth, label, box, score))
                own.append(Detections(torch.from_numpy(score), torch.from_numpy(label), torch.from_numpy(box).double()))
        found += gather_images(scene.samples, by_sample, own, MMDET3D_CLASSES)
    real = Boxes2D(
        np.repeat(np.arange(len(flat)), [len(t.label) for t, *_ in flat]).astype(np.int32),
        np.concatenate([t.label.numpy() for t, *_ in flat]).astype(np.int32),
        np.concatenate([t.box.double().numpy() for t, *_ in flat]),
    )
    boxes = Boxes2D(
        np.repeat(np.arange(len(flat)), [len(label) for _, label, *_ in flat]).astype(np.int32),
        np.concatenate([label for _, label, *_ in flat]).astype(np.int32),
        np.concatenate([box for *_, box, _ in flat]),
        np.concatenate([score for *_, score in flat]),
    )
    truth = read_image_truth(tiny_set, "v1.0-mini", names, tuple(tokens))
    expected = float(np.nanmean(average_precision(real, boxes, labels=len(MMDET3D_CLASSES))))
    return match_images(found, truth, MMDET3D_CLASSES), expected


def test_it_is_the_ap_of_all_images_as_one_list(matched: tuple[ImageMatches, float]) -> None:
    matches, expected = matched
    assert 0.2 < expected < 0.9
    assert matches.scores().mean_ap == pytest.approx(expected, abs=1e-12)
    figures = image_figures(matches.scores())
    assert figures["mAP"] == pytest.approx(expected, abs=1e-6)
    assert set(image_figures(matches.scores(), is_summary=True)) <= {"mAP", "AP_car"}


def test_weights_repeat_samples(matched: tuple[ImageMatches, float]) -> None:
    matches, expected = matched
    assert matches.scores(np.full(matches.samples, 2)).mean_ap == pytest.approx(expected, abs=0.02)
    first = np.zeros(matches.samples, np.int64)
    first[0] = 1
    alone = matches.scores(first)
    there = matches.truth_counts[:, 0] > 0
    assert (np.isfinite(alone.ap) == there).all(), "classes that are not in the sample have no AP"
    assert matches.scores(np.zeros(matches.samples, np.int64)).mean_ap == 0.0


def test_classes_are_told_by_names_and_strangers_are_left_out() -> None:
    class Sample:
        token = "a"

    one = Detections(torch.tensor([0.9, 0.8, 0.7]), torch.tensor([0, 1, 2]), torch.zeros(3, 4))
    (found,) = gather_images([Sample()], {"a": [None]}, [one], ("kiosk", "pedestrian", "car"))  # type: ignore[list-item]
    assert [MMDET3D_CLASSES[k] for k in found.boxes.label] == ["pedestrian", "car"]
    assert found.boxes.score.tolist() == pytest.approx([0.8, 0.7])
