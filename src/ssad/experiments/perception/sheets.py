"""What a detector sees under each shift: one moment, its boxes and the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch

from ssad.core.images import read_image
from ssad.core.machine import quiet_warp
from ssad.core.types import U8
from ssad.datasets.drawing import title_on
from ssad.datasets.nuscenes.camera_truth import camera_truth, scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame
from ssad.detectors.drawing import FOUND, TRUE, draw_flat, draw_solids
from ssad.detectors.on_scenes import to_images
from ssad.experiments.perception.scene_boxes import Examination, ShiftedScene, Watched, detector_of, shifter_of
from ssad.scenarios.static.shifts import KNOWN

WIDTH, COLUMNS, LEAST, STRONG = 640, 3, 0.3, 3


def detection_sheet(examination: Examination, split: str, shifts: Sequence[str], severity: int) -> U8:
    """One moment, clean and under each shift, with the boxes of the examination's first detector and the true ones.

    Args:
        examination: data, detector, device.
        split: of which the moment with most to see is taken.
        shifts: names.
        severity: of all of them.

    Returns:
        Picture [H, W, 3], RGB.

    Raises:
        FormatError: a picture cannot be read.
    """
    quiet_warp()
    name, weights = examination.detectors[0]
    detector = Watched(detector_of(name, weights, examination.device)), examination.device
    with NuScenes(examination.root, examination.version) as data:
        scene, frame = richest(data, scenes_of(data, split))
        tiles = [tile(detector, scene, frame, read_image(examination.root / frame.filename), title="clean")]
        for shift in shifts:
            shifter = shifter_of(examination, data, ShiftedScene(shift, severity, scene.record.name))
            assert shifter is not None
            tiles.append(tile(detector, scene, frame, shifter.image(frame)[0], title=shift))
    while len(tiles) % COLUMNS:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    return np.concatenate(rows)


def richest(data: NuScenes, scenes: tuple[str, ...]) -> tuple[SceneData, SensorFrame]:
    """The camera frame with most objects within 30 m, by day if it can be, among the first of each scene."""
    best: tuple[float, SceneData, SensorFrame] | None = None
    for name in scenes:
        scene = data.scene(name)
        for frame in [f for f in scene.frames if f.modality == "camera" and f.key_frame][:6]:
            truth = camera_truth(frame, scene.annotations(frame.sample_token))
            assert truth.solid is not None
            near = float((truth.solid.centre[:, 2] < 30).sum())
            light = float(np.median(read_image(data.root / frame.filename)))
            value = near * min(max(light - 20.0, 1.0) / 60.0, 1.0)
            if best is None or value > best[0]:
                best = value, scene, frame
    assert best is not None
    return best[1], best[2]


@torch.no_grad()
def tile(eye: tuple[Any, str], scene: SceneData, frame: SensorFrame, image: U8, *, title: str) -> U8:
    """A picture with the boxes of a detector (on a device) and the true ones, and its name."""
    detector, device = eye
    truth = camera_truth(frame, scene.annotations(frame.sample_token))
    assert frame.intrinsic is not None
    assert truth.solid is not None
    lens = torch.from_numpy(np.asarray(frame.intrinsic, np.float32))[None].to(device)
    (found,) = detector.predict(to_images([image], device), lens, threshold=LEAST)
    scale = WIDTH / image.shape[1]
    canvas = cv2.resize(image, (WIDTH, round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA)
    intrinsic = np.asarray(frame.intrinsic, np.float64)
    if found.solid is None:
        draw_flat(canvas, truth.box, scale, colour=TRUE, width=1)
        draw_flat(canvas, found.box, scale, colour=FOUND, width=2)
    else:
        draw_solids(canvas, truth.solid, intrinsic, scale, colour=TRUE, width=1)
        draw_solids(canvas, found.solid, intrinsic, scale, colour=FOUND, width=2)
    text = f"{title.replace('_', ' ')} ({KNOWN[title][0]})" if title in KNOWN else title
    title_on(canvas, text)
    return np.asarray(canvas)
