"""Which object an attack is about, where a suite chooses one: the nearest of each moment, or one of a whole drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssad.core.nuscenes_names import CATEGORY_TO_CLASS, MMDET3D_CLASSES
from ssad.core.types import F64
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.scene import Annotations, SceneData, SensorFrame

NEAREST = "nearest"


def chosen_object(scene: SceneData, sample: str, choice: str, classes: Sequence[str] = ()) -> int | None:
    """The object of a moment that an attack is about.

    Args:
        scene: The scene.
        sample: Token of the sample.
        choice: "nearest": the object nearest the ego that a camera sees. Otherwise the token of an instance.
        classes: Names of the classes that are meant; empty: all that are scored.

    Returns:
        Its row in the annotations of the sample; None: there is none.
    """
    found = scene.annotations(sample)
    if choice != NEAREST:
        return found.instance.index(choice) if choice in found.instance else None
    names = classes or MMDET3D_CLASSES
    frames = [f for f in scene.frames if f.sample_token == sample and f.modality == "camera" and f.key_frame]
    rows = [k for k, category in enumerate(found.category) if CATEGORY_TO_CLASS.get(category) in names]
    if not frames or not rows:
        return None
    gap = np.linalg.norm(found.centre[rows, :2] - frames[0].ego_to_world[:2, 3], axis=1)
    ordered = (rows[k] for k in np.argsort(gap, kind="stable"))
    return next((row for row in ordered if any(_seen(frame, found, row) for frame in frames)), None)


def chosen_first(scene: SceneData, frame: SensorFrame, choice: str, classes: Sequence[str] = ()) -> Annotations:
    """The annotations of a frame's sample, the chosen object first; none if the frame does not show it.

    Args:
        scene: The scene.
        frame: A camera frame of a key frame.
        choice: See `chosen_object`.
        classes: See `chosen_object`.
    """
    found = scene.annotations(frame.sample_token)
    row = chosen_object(scene, frame.sample_token, choice, classes)
    if row is None or not _seen(frame, found, row):
        return found.take(np.arange(0))
    return found.take(np.array([row, *(k for k in range(len(found)) if k != row)]))


def chosen_places(scene: SceneData, choice: str, classes: Sequence[str] = ()) -> dict[str, F64]:
    """Where the chosen object is: its middle [3], m, by the token of each sample that has it.

    Args:
        scene: The scene.
        choice: See `chosen_object`.
        classes: See `chosen_object`.
    """
    rows = {one.token: chosen_object(scene, one.token, choice, classes) for one in scene.samples}
    return {token: scene.annotations(token).centre[row] for token, row in rows.items() if row is not None}


def _seen(frame: SensorFrame, found: Annotations, row: int) -> bool:
    """Whether a camera should find an object."""
    return len(camera_truth(frame, found.take(np.array([row]))).label) > 0
