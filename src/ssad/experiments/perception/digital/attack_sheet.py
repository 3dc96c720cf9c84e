"""Sheet of digital attacks: one moment, the change of its image, and the boxes before and after."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ssad.core.types import U8
from ssad.datasets.drawing import title_on
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors.monitored import MonitoredDetector
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition, detector_of, recorded_scene
from ssad.experiments.perception.sheets import WIDTH, draw_tile, frame_with_most_objects
from ssad.scenarios.static.digital.scene_attacker import SceneAttacker
from ssad.scenarios.static.digital.spec import AttackSpec


def attack_sheet(examination: Examination, split: str, specs: Sequence[AttackSpec]) -> U8:
    """Draw a row for the clean moment and for each attack: the image, its change, and the detections in it.

    Args:
        examination: data, detector, device, seed.
        split: split that provides the moment with most objects.
        specs: the attacks; an attack without a usable gradient has no row.

    Returns:
        Image [H, W, 3], RGB.

    Raises:
        FormatError: an image cannot be read.
    """
    name, weights = examination.detectors[0]
    detector = detector_of(name, weights, examination.device)
    rows = []
    with NuScenes(examination.root, examination.version) as dataset:
        scene, frame = frame_with_most_objects(dataset, scenes_of(dataset, split))
        clean_image = read_frame_image(examination.root, frame)
        for spec in [None, *specs]:
            monitored, image = MonitoredDetector(detector), clean_image
            if spec is not None:
                recorded = recorded_scene(examination, dataset, SceneCondition(scene.record.name))
                (image,) = SceneAttacker(spec, recorded, monitored).look([frame])
                if monitored.reason:
                    continue
            title = "clean" if spec is None else f"{spec.attack}, loss {spec.loss}, {spec.radius:g} px {spec.norm}"
            title += f", {spec.target}" if spec and spec.target else ""
            detection_tile = draw_tile((monitored, examination.device), scene, frame, image, title="what it finds")
            change = magnified(image, clean_image)
            rows.append(
                np.concatenate([_shrunk(image, title), _shrunk(change, "change, magnified"), detection_tile], 1)
            )
    return np.concatenate(rows)


def magnified(image: U8, clean_image: U8) -> U8:
    """The change of a picture around middle grey, its largest value made black or white.

    Args:
        image: [H, W, 3].
        clean_image: [H, W, 3].

    Returns:
        [H, W, 3].
    """
    difference = image.astype(np.float64) - clean_image
    return np.asarray(np.rint(127.5 + 127.5 * difference / max(float(np.abs(difference).max()), 1.0)), np.uint8)


def _shrunk(image: U8, title: str) -> U8:
    """A picture at the width of a tile, with its name; not averaged, so that noise stays noise."""
    size = (WIDTH, round(image.shape[0] * WIDTH / image.shape[1]))
    canvas = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))
    title_on(canvas, title)
    return canvas
