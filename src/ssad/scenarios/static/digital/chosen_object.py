"""Selection of the object of an attack: the nearest of each moment, or one of a whole drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssad.core.nuscenes_names import CATEGORY_TO_CLASS, MMDET3D_CLASSES
from ssad.core.types import F64
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.scene import Annotations, SceneData, SensorFrame

NEAREST = "nearest"


def chosen_object(scene: SceneData, sample: str, choice: str, classes: Sequence[str] = ()) -> int | None:
    """Return the object of a moment that an attack is about.

    Args:
        scene: The scene.
        sample: Token of the sample.
        choice: "nearest": the object nearest the ego that a camera sees. Otherwise the token of an instance.
        classes: Names of the eligible classes; empty: all that are scored.

    Returns:
        Its row in the annotations of the sample; None without such an object.
    """
    sample_annotations = scene.annotations(sample)
    if choice != NEAREST:
        return sample_annotations.instance.index(choice) if choice in sample_annotations.instance else None
    names = classes or MMDET3D_CLASSES
    frames = [
        scene_frame
        for scene_frame in scene.frames
        if scene_frame.sample_token == sample and scene_frame.modality == "camera" and scene_frame.key_frame
    ]
    rows = [
        matching_row
        for matching_row, category in enumerate(sample_annotations.category)
        if CATEGORY_TO_CLASS.get(category) in names
    ]
    if not frames or not rows:
        return None
    distances = np.linalg.norm(sample_annotations.centre[rows, :2] - frames[0].ego_to_world[:2, 3], axis=1)
    nearest_first = (rows[matching_row] for matching_row in np.argsort(distances, kind="stable"))
    return next(
        (
            row
            for row in nearest_first
            if any(_is_visible(camera_frame, sample_annotations, row) for camera_frame in frames)
        ),
        None,
    )


def chosen_first(scene: SceneData, frame: SensorFrame, choice: str, classes: Sequence[str] = ()) -> Annotations:
    """Return the annotations of a frame's sample, the selected object first; none if the frame does not show it.

    Args:
        scene: The scene.
        frame: A camera frame of a key frame.
        choice: See `chosen_object`.
        classes: See `chosen_object`.
    """
    sample_annotations = scene.annotations(frame.sample_token)
    row = chosen_object(scene, frame.sample_token, choice, classes)
    if row is None or not _is_visible(frame, sample_annotations, row):
        return sample_annotations.take(np.arange(0))
    return sample_annotations.take(
        np.array([row, *(other_row for other_row in range(len(sample_annotations)) if other_row != row)])
    )


def chosen_places(scene: SceneData, choice: str, classes: Sequence[str] = ()) -> dict[str, F64]:
    """Return the middle [3] of the selected object, m, by the token of each sample that has it.

    Args:
        scene: The scene.
        choice: See `chosen_object`.
        classes: See `chosen_object`.
    """
    rows = {sample.token: chosen_object(scene, sample.token, choice, classes) for sample in scene.samples}
    return {token: scene.annotations(token).centre[row] for token, row in rows.items() if row is not None}


def _is_visible(frame: SensorFrame, annotations: Annotations, row: int) -> bool:
    """Return True if a camera should find an object."""
    return len(camera_truth(frame, annotations.take(np.array([row]))).label) > 0
