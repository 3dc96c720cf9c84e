"""Images and truth for training and evaluation of detectors, from data sets on disk."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from ssad.datasets.nuscenes.camera_truth import camera_truth, scenes_of
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.training.batches import TrainingImage


def nuscenes_items(root: Path, version: str | None, split: str, *, limit: int | None = None) -> Iterator[TrainingImage]:
    """Yield every key image of every camera of a split.

    Args:
        root: Root folder of the nuScenes data set.
        version: Version of the data set; None: the only one.
        split: Name of the split.
        limit: Maximum number of scenes; None: all.

    Raises:
        ConfigError: The split is unknown.
    """
    with NuScenes(root, version) as dataset:
        names = scenes_of(dataset, split)
        for name in names[:limit]:
            scene = dataset.scene(name)
            for frame in scene.frames:
                if frame.modality == "camera" and frame.key_frame:
                    truth = camera_truth(frame, scene.annotations(frame.sample_token))
                    yield TrainingImage(partial(read_frame_image, root, frame), truth)
