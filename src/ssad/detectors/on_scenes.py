"""Detectors on data sets: from images to boxes in the world and their scores; 2D boxes and their AP."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from ssad.core.detections import Detections, Truth, to_images
from ssad.core.nuscenes_names import ATTRIBUTES, CLASSES, MMDET3D_CLASSES
from ssad.core.protocols import Detector
from ssad.core.types import F64, U8
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.results import add_ego_distance
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.detectors.image_scores import gather_images
from ssad.detectors.mono3d.multi_camera import DetectedBoxes, merge_cameras
from ssad.metrics.detection import DetectionScores, Matches, filter_boxes, match
from ssad.metrics.detection2d import Boxes2D, average_precision
from ssad.metrics.detection_boxes import BoxTable

ImageLoader = Callable[[Sequence[SensorFrame]], Sequence[U8]]
LABEL = np.array([CLASSES.index(name) for name in MMDET3D_CLASSES])
_ATTRIBUTE = {"": -1} | {name: k for k, name in enumerate(ATTRIBUTES)}
AT_ONCE = 6  # samples that a GPU is shown at once
MIN_SCORE = 0.001  # least score that counts for AP of 2D boxes
ERRORS: Mapping[str, str] = {
    "mATE": "trans_err",
    "mASE": "scale_err",
    "mAOE": "orient_err",
    "mAVE": "vel_err",
    "mAAE": "attr_err",
}


@dataclass(frozen=True, slots=True)
class SampleBoxes:
    """Detected boxes of one sample."""

    token: str
    boxes: DetectedBoxes


def detect_scene(
    detector: Detector, root: Path, scene: SceneData, *, device: str = "cpu", load_images: ImageLoader | None = None
) -> list[SampleBoxes]:
    """Return the boxes in the world for each sample of a scene.

    Args:
        detector: The detector.
        root: The nuScenes root.
        scene: The scene.
        device: Device of the detector.
        load_images: Returns the images of camera frames; None: reads the files.
    """
    return detect_with([detector], root, scene, device=device, load_images=load_images)[0]


def detect_with(
    detectors: Sequence[Detector],
    root: Path,
    scene: SceneData,
    *,
    device: str = "cpu",
    load_images: ImageLoader | None = None,
    ahead: bool = True,
    at_once: int = AT_ONCE,
) -> list[list[Any]]:
    """Return the results of `detect_scene` for several detectors on the same images.

    Args:
        detectors: The detectors.
        root: The nuScenes root.
        scene: The scene.
        device: Device of the detectors.
        load_images: Returns the images of camera frames; None: reads the files.
        ahead: Whether the next pictures are made while these are looked at; False if `load_images` needs a detector for
            itself.
        at_once: Samples that a GPU is shown at once.

    Returns:
        Boxes of each sample, one list for each detector; `SamplePictures` of 2D detectors, which have no place in the
        world.
    """
    frames_by_sample: dict[str, list[SensorFrame]] = {}
    for frame in scene.frames:
        if frame.modality == "camera" and frame.key_frame:
            frames_by_sample.setdefault(frame.sample_token, []).append(frame)
    results: list[list[Any]] = [[] for _ in detectors]
    samples_per_call = at_once if device != "cpu" else 1
    with ThreadPoolExecutor(4) as pool:

        def read(frames: Sequence[SensorFrame]) -> Sequence[U8]:
            if load_images is not None:
                return load_images(frames)
            return list(pool.map(lambda frame: read_frame_image(root, frame), frames))

        with ThreadPoolExecutor(1) as producer:
            sample_blocks = [
                scene.samples[start : start + samples_per_call]
                for start in range(0, len(scene.samples), samples_per_call)
            ]
            block_frames = [
                [camera_frame for sample in samples for camera_frame in frames_by_sample.get(sample.token, [])]
                for samples in sample_blocks
            ]
            # Two blocks in flight: one is detected while the next is read.
            pending = [producer.submit(read, frames) for frames in (block_frames[:2] if ahead else [])]
            for block_index, samples in enumerate(sample_blocks):
                images = pending[block_index].result() if ahead else read(block_frames[block_index])
                pending += [
                    producer.submit(read, frames)
                    for frames in (block_frames[block_index + 2 : block_index + 3] if ahead else [])
                ]
                detections = _predict(detectors, block_frames[block_index], images, device)
                for detector_results, detector, image_boxes in zip(results, detectors, detections, strict=True):
                    is_2d = detector.task == "2d"
                    detector_results.extend(
                        gather_images(samples, frames_by_sample, image_boxes, detector.classes)
                        if is_2d
                        else _merge_samples(samples, frames_by_sample, image_boxes)
                    )
    return results


def _predict(
    detectors: Sequence[Detector], frames: Sequence[SensorFrame], images: Sequence[U8], device: str
) -> list[list[Detections]]:
    """Return the detections in each image, in order, by detector; images of one size in one call."""
    by_detector: list[dict[int, Detections]] = [{} for _ in detectors]
    for image_size in sorted({image.shape[:2] for image in images}):
        rows = [row for row, image in enumerate(images) if image.shape[:2] == image_size]
        intrinsics = torch.from_numpy(np.stack([np.asarray(frames[row].intrinsic, np.float32) for row in rows])).to(
            device
        )
        tensor = to_images([images[row] for row in rows], device)
        for detector_results, detector in zip(by_detector, detectors, strict=True):
            for row, detections in zip(
                rows, Detections.cpu(_predict_in_parts(detector, tensor, intrinsics)), strict=True
            ):
                detector_results[row] = detections
    return [[detector_results[row] for row in range(len(frames))] for detector_results in by_detector]


def _predict_in_parts(detector: Detector, images: torch.Tensor, intrinsics: torch.Tensor) -> list[Detections]:
    """Call `predict`, on half as many images at a time if memory does not suffice."""
    try:
        return list(detector.predict(images, intrinsics, threshold=MIN_SCORE if detector.task == "2d" else None))
    except torch.OutOfMemoryError:
        if len(images) == 1:
            raise
    # After the except block: the traceback would keep the tensors of the failed call alive.
    torch.cuda.empty_cache()
    half = len(images) // 2
    return [
        *_predict_in_parts(detector, images[:half], intrinsics[:half]),
        *_predict_in_parts(detector, images[half:], intrinsics[half:]),
    ]


def _merge_samples(
    samples: Sequence[Any], frames_by_sample: Mapping[str, Sequence[SensorFrame]], boxes: Sequence[Detections]
) -> list[SampleBoxes]:
    sample_boxes, start = [], 0
    for sample in samples:
        frames = frames_by_sample.get(sample.token, [])
        sample_detections = boxes[start : start + len(frames)]
        start += len(frames)
        merged = merge_cameras(
            sample_detections, [frame.sensor_to_ego for frame in frames], [frame.ego_to_world for frame in frames]
        )
        sample_boxes.append(SampleBoxes(sample.token, merged))
    return sample_boxes


def detect(
    detector: Detector, root: Path, version: str, scenes: Sequence[str], *, device: str = "cpu"
) -> list[SampleBoxes]:
    """Return boxes for each sample of the scenes."""
    with NuScenes(root, version) as dataset:
        return [
            sample_boxes
            for name in scenes
            for sample_boxes in detect_scene(detector, root, dataset.scene(name), device=device)
        ]


def box_table(detections: Sequence[SampleBoxes], truth: GroundTruth) -> BoxTable:
    """Return detected boxes as rows in the order of the truth's samples."""
    sample_index = {token: index for index, token in enumerate(truth.samples)}
    known_samples = sorted(
        (sample_boxes for sample_boxes in detections if sample_boxes.token in sample_index),
        key=lambda sample_boxes: sample_index[sample_boxes.token],
    )
    boxes_by_sample = [sample_boxes.boxes for sample_boxes in known_samples]
    if not boxes_by_sample:
        return BoxTable.empty()

    def column(name: str) -> F64:
        return np.concatenate([np.asarray(getattr(table_boxes, name), np.float64) for table_boxes in boxes_by_sample])

    attributes = [_ATTRIBUTE[name] for boxes in boxes_by_sample for name in boxes.attribute]
    table = BoxTable(
        sample=np.repeat(
            [sample_index[sample_boxes.token] for sample_boxes in known_samples],
            [len(boxes) for boxes in boxes_by_sample],
        ).astype(np.int32),
        label=LABEL[column("label").astype(int)].astype(np.int8),
        centre=column("centre"),
        size_lwh=column("size_lwh"),
        rotation=column("rotation"),
        velocity=column("velocity"),
        attribute=np.array(attributes, np.int8),
        score=column("score"),
        ego_distance=np.full(len(attributes), np.nan),
    )
    return add_ego_distance(table, truth.ego)


def match_boxes(detections: Sequence[SampleBoxes], truth: GroundTruth) -> Matches:
    """Match detected boxes with the truth as the official evaluation does."""
    return match(
        filter_boxes(truth.boxes, points=truth.points, racks=truth.racks),
        filter_boxes(box_table(detections, truth), racks=truth.racks),
        samples=len(truth.samples),
    )


def score_3d(
    detector: Detector, root: Path, version: str, scenes: Sequence[str], *, device: str = "cpu"
) -> dict[str, float]:
    """Return `score_figures` over some scenes."""
    truth = read_truth(root, version, scenes=frozenset(scenes))
    return score_figures(match_boxes(detect(detector, root, version, scenes, device=device), truth).scores())


def score_figures(scores: DetectionScores, *, summary_only: bool = False) -> dict[str, float]:
    """Return the figures of scores: mAP, NDS, AP of each class and true-positive errors, without NaN.

    Args:
        scores: The scores.
        summary_only: Return only mAP, NDS and the AP of cars.
    """
    figures = {"mAP": scores.mean_ap, "NDS": scores.nd_score, "AP_car": scores.mean_dist_aps["car"]}
    if not summary_only:
        figures |= {f"AP_{name}": value for name, value in scores.mean_dist_aps.items()}
        figures |= {short_name: scores.tp_errors[name] for short_name, name in ERRORS.items()}
    return {name: round(float(value), 6) for name, value in figures.items() if np.isfinite(value)}


class AnnotatedImages(Protocol):
    """Images, uint8 [N, H, W, 3], by slices, and the truth of each."""

    @property
    def pictures(self) -> Any:
        """Images, uint8 [N, H, W, 3], by slices."""

    @property
    def truth(self) -> Sequence[Truth]:
        """The truth of each picture."""


def detect_2d(detector: Detector, batches: Iterable[torch.Tensor], *, device: str = "cpu") -> Boxes2D:
    """Return all detections of a detector in images, one row per detection.

    Args:
        detector: The detector.
        batches: Images, uint8 [N, H, W, 3], in batches.
        device: Device of the detector.

    Returns:
        The rows, in the order of the images; labels are the detector's own.
    """
    detections: list[Detections] = []
    for batch in batches:
        tensor = batch.to(device).permute(0, 3, 1, 2).float() / 255
        detections += detector.predict(tensor, threshold=MIN_SCORE)
    return Boxes2D(
        np.repeat(np.arange(len(detections)), [len(single.score) for single in detections]).astype(np.int32),
        _concatenate([single.label for single in detections]).astype(np.int32),
        _concatenate([single.box for single in detections], 4),
        _concatenate([single.score for single in detections]),
    )


def _concatenate(values: Sequence[torch.Tensor], width: int | None = None) -> F64:
    """Concatenate tensors [N] or [N, width] on the CPU."""
    empty = np.zeros((0,) if width is None else (0, width))
    return np.concatenate([empty, *(tensor.detach().cpu().double().numpy() for tensor in values)])


def score_2d(
    detector: Detector,
    data: AnnotatedImages,
    *,
    classes: Sequence[str] | None = None,
    device: str = "cpu",
    batch: int = 32,
) -> dict[str, float]:
    """Return AP50 of each class of the detector that occurs in annotated images, and their mean.

    Args:
        detector: Detector to score. Objects of classes that it does not know are left out.
        data: Images and their truth.
        classes: Names of the labels of the truth; those of the detector if None.
        device: Device of the detector.
        batch: Images at once.

    Returns:
        AP50 (the mean) and AP50_NAME.
    """
    names = detector.classes
    label_of = {name: label_index for label_index, name in enumerate(names)}
    detector_labels = np.array([label_of.get(name, -1) for name in (names if classes is None else classes)], np.int32)
    batches = (data.pictures[start : start + batch] for start in range(0, len(data.truth), batch))
    detections = detect_2d(detector, batches, device=device)
    crowd_flags = [
        torch.zeros(len(truth.label), dtype=torch.bool) if truth.crowd is None else truth.crowd for truth in data.truth
    ]
    image = np.repeat(np.arange(len(data.truth)), [len(truth.label) for truth in data.truth]).astype(np.int32)
    label = detector_labels[_concatenate([truth.label for truth in data.truth]).astype(np.int32)]
    is_known = label >= 0
    truth_boxes = Boxes2D(
        image[is_known],
        label[is_known],
        _concatenate([truth.box for truth in data.truth], 4)[is_known],
        ignore=_concatenate(crowd_flags).astype(bool)[is_known],
    )
    ap = average_precision(truth_boxes, detections, labels=len(names))
    class_ap = {f"AP50_{name}": float(value) for name, value in zip(names, ap, strict=True) if np.isfinite(value)}
    return {"AP50": float(np.mean(list(class_ap.values()))) if class_ap else 0.0} | class_ap
