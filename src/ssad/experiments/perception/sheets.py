"""Sheet of detections under each shift: one moment, its detected boxes and the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch

from ssad.core.detections import to_images
from ssad.core.machine import start_warp_quietly
from ssad.core.types import U8
from ssad.datasets.drawing import title_on
from ssad.datasets.nuscenes.camera_truth import camera_truth, scenes_of
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame
from ssad.detectors.drawing import FOUND, TRUE, draw_flat, draw_solids
from ssad.detectors.monitored import MonitoredDetector
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition, detector_of, recorded_scene
from ssad.scenarios.static.perturbation import Perturbation
from ssad.scenarios.static.shifts import KNOWN

WIDTH, COLUMNS, LEAST, STRONG = 640, 3, 0.3, 3


def detection_sheet(examination: Examination, split: str, perturbations: Sequence[Perturbation]) -> U8:
    """Draw one moment, clean and under each perturbation, with the boxes of the first detector and the true ones.

    Args:
        examination: data, detector, device.
        split: split that provides the moment with most objects.
        perturbations: of recorded scenes.

    Returns:
        Image [H, W, 3], RGB.

    Raises:
        FormatError: an image cannot be read.
    """
    start_warp_quietly()
    name, weights = examination.detectors[0]
    detector = MonitoredDetector(detector_of(name, weights, examination.device)), examination.device
    with NuScenes(examination.root, examination.version) as dataset:
        scene, frame = frame_with_most_objects(dataset, scenes_of(dataset, split))
        tiles = [draw_tile(detector, scene, frame, read_frame_image(examination.root, frame), title="clean")]
        for perturbation in perturbations:
            condition = SceneCondition(scene.record.name, perturbation)
            recorded = replace(recorded_scene(examination, dataset, condition), folder=None)
            presentation = perturbation.on_scene(recorded, detector[0])
            assert presentation.load_images is not None
            tiles.append(
                draw_tile(detector, scene, frame, presentation.load_images([frame])[0], title=perturbation.name)
            )
    while len(tiles) % COLUMNS:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[start : start + COLUMNS], 1) for start in range(0, len(tiles), COLUMNS)]
    return np.concatenate(rows)


def frame_with_most_objects(data: NuScenes, scenes: tuple[str, ...]) -> tuple[SceneData, SensorFrame]:
    """The camera frame with most objects within 30 m, by day if it can be, among the first of each scene."""
    best_candidate: tuple[float, SceneData, SensorFrame] | None = None
    for name in scenes:
        scene = data.scene(name)
        for frame in [
            candidate for candidate in scene.frames if candidate.modality == "camera" and candidate.key_frame
        ][:6]:
            truth = camera_truth(frame, scene.annotations(frame.sample_token))
            assert truth.solid is not None
            near_count = float((truth.solid.centre[:, 2] < 30).sum())
            brightness = float(np.median(read_frame_image(data.root, frame)))
            # Dark images count less: boxes and changes are hard to see in them.
            rating = near_count * min(max(brightness - 20.0, 1.0) / 60.0, 1.0)
            if best_candidate is None or rating > best_candidate[0]:
                best_candidate = rating, scene, frame
    assert best_candidate is not None
    return best_candidate[1], best_candidate[2]


@torch.no_grad()
def draw_tile(
    detector_and_device: tuple[Any, str], scene: SceneData, frame: SensorFrame, image: U8, *, title: str
) -> U8:
    """A picture with the boxes of a detector (on a device) and the true ones, and its name."""
    detector, device = detector_and_device
    truth = camera_truth(frame, scene.annotations(frame.sample_token))
    assert frame.intrinsic is not None
    assert truth.solid is not None
    intrinsic_batch = torch.from_numpy(np.asarray(frame.intrinsic, np.float32))[None].to(device)
    (detections,) = detector.predict(to_images([image], device), intrinsic_batch, threshold=LEAST)
    scale = WIDTH / image.shape[1]
    canvas = cv2.resize(image, (WIDTH, round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA)
    intrinsic = np.asarray(frame.intrinsic, np.float64)
    if detections.solid is None:
        draw_flat(canvas, truth.box, scale, colour=TRUE, width=1)
        draw_flat(canvas, detections.box, scale, colour=FOUND, width=2)
    else:
        draw_solids(canvas, truth.solid, intrinsic, scale, colour=TRUE, width=1)
        draw_solids(canvas, detections.solid, intrinsic, scale, colour=FOUND, width=2)
    text = f"{title.replace('_', ' ')} ({KNOWN[title][0]})" if title in KNOWN else title
    title_on(canvas, text)
    return np.asarray(canvas)
