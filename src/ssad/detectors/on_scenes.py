"""Detectors on data sets: from pictures to boxes in the world and their scores; 2D boxes and their AP."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from ssad.core.detections import Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.images import read_image
from ssad.core.nuscenes_names import ATTRIBUTES, CLASSES, MMDET3D_CLASSES
from ssad.core.protocols import Detector
from ssad.core.types import F64, U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.results import with_ego
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.detectors.image_scores import gather_pictures
from ssad.detectors.mono3d.multi_camera import DetectedBoxes, merge_cameras
from ssad.metrics.detection import DetectionScores, Matches, filter_boxes, match
from ssad.metrics.detection2d import Boxes2D, average_precision
from ssad.metrics.detection_boxes import BoxTable

Look = Callable[[Sequence[SensorFrame]], Sequence[U8]]
LABEL = np.array([CLASSES.index(name) for name in MMDET3D_CLASSES])
_ATTRIBUTE = {"": -1} | {name: k for k, name in enumerate(ATTRIBUTES)}
AT_ONCE = 6  # samples that a GPU is shown at once
FLOOR = 0.001  # least score that counts for AP of 2D boxes
ERRORS: Mapping[str, str] = {
    "mATE": "trans_err",
    "mASE": "scale_err",
    "mAOE": "orient_err",
    "mAVE": "vel_err",
    "mAAE": "attr_err",
}


@dataclass(frozen=True, slots=True)
class SampleBoxes:
    """What was found in one sample."""

    token: str
    boxes: DetectedBoxes


def to_images(pictures: Sequence[U8], device: torch.device | str) -> torch.Tensor:
    """uint8 RGB [H, W, 3] of one size as float [B, 3, H, W] in [0, 1] on the device."""
    stacked = torch.from_numpy(np.stack(pictures)).to(device)
    return stacked.permute(0, 3, 1, 2).float() / 255


def to_host(found: Sequence[Detections]) -> list[Detections]:
    """Detections of a batch on the CPU, in one copy for each column, since each copy waits for the device.

    Raises:
        ConfigError: They are not tensors.
    """
    flat = zip(*(_host([getattr(one, name) for one in found]) for name in ("score", "label", "box")), strict=True)
    solids = [one.solid for one in found if one.solid is not None]
    names = ("centre", "size_lhw", "yaw", "velocity", "attribute")
    moved = zip(*(_host([getattr(one, name) for one in solids]) for name in names), strict=True)
    rows = [None if one.solid is None else Solids(*next(moved)) for one in found]
    return [Detections(score, label, box, solid) for (score, label, box), solid in zip(flat, rows, strict=True)]


def _host(parts: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Tensors on the CPU."""
    if not all(isinstance(part, torch.Tensor) for part in parts):
        raise ConfigError("broken promise: Detections holds tensors")
    if all(part.device.type == "cpu" for part in parts):
        return list(parts)
    return joined(parts, torch.Tensor.cpu)


def joined(parts: Sequence[torch.Tensor], change: Callable[[torch.Tensor], torch.Tensor]) -> list[torch.Tensor]:
    """`change`, which works on each row by itself, of all tensors [N, ...] at once where they are of a kind."""
    if len({(part.dtype, part.shape[1:], part.device, part.ndim) for part in parts}) > 1 or not parts[0].ndim:
        return [change(part) for part in parts]
    return list(torch.split(change(torch.cat(list(parts))), [len(part) for part in parts]))


def detect_scene(
    detector: Detector, root: Path, scene: SceneData, *, device: str = "cpu", look: Look | None = None
) -> list[SampleBoxes]:
    """Boxes in the world for each sample of a scene.

    Args:
        detector: The detector.
        root: The nuScenes root.
        scene: The scene.
        device: Where the detector is.
        look: Gives the pictures of camera frames; None: reads the files.
    """
    return detect_with([detector], root, scene, device=device, look=look)[0]


def detect_with(
    detectors: Sequence[Detector],
    root: Path,
    scene: SceneData,
    *,
    device: str = "cpu",
    look: Look | None = None,
    ahead: bool = True,
    at_once: int = AT_ONCE,
) -> list[list[Any]]:
    """As `detect_scene`, for several detectors that are shown the same pictures.

    Args:
        detectors: The detectors.
        root: The nuScenes root.
        scene: The scene.
        device: Where the detectors are.
        look: Gives the pictures of camera frames; None: reads the files.
        ahead: Whether the next pictures are made while these are looked at; False where `look` needs a detector for
            itself.
        at_once: Samples that a GPU is shown at once.

    Returns:
        Boxes of each sample, one list for each detector; `SamplePictures` of 2D detectors, which have no place in the
        world.
    """
    by_sample: dict[str, list[SensorFrame]] = {}
    for frame in scene.frames:
        if frame.modality == "camera" and frame.key_frame:
            by_sample.setdefault(frame.sample_token, []).append(frame)
    found: list[list[Any]] = [[] for _ in detectors]
    step = at_once if device != "cpu" else 1
    with ThreadPoolExecutor(4) as pool:

        def read(frames: Sequence[SensorFrame]) -> Sequence[U8]:
            if look is not None:
                return look(frames)
            return list(pool.map(lambda frame: read_image(root / frame.filename), frames))

        with ThreadPoolExecutor(1) as maker:
            blocks = [scene.samples[k : k + step] for k in range(0, len(scene.samples), step)]
            flat = [[f for s in block for f in by_sample.get(s.token, [])] for block in blocks]
            waiting = [maker.submit(read, frames) for frames in (flat[:2] if ahead else [])]
            for number, block in enumerate(blocks):
                pictures = waiting[number].result() if ahead else read(flat[number])
                waiting += [maker.submit(read, frames) for frames in (flat[number + 2 : number + 3] if ahead else [])]
                seen = _predict(detectors, flat[number], pictures, device)
                for kept, detector, boxes in zip(found, detectors, seen, strict=True):
                    two = detector.task == "2d"
                    kept.extend(
                        gather_pictures(block, by_sample, boxes, detector.classes)
                        if two
                        else _merged(block, by_sample, boxes)
                    )
    return found


def _predict(
    detectors: Sequence[Detector], frames: Sequence[SensorFrame], pictures: Sequence[U8], device: str
) -> list[list[Detections]]:
    """Detections of each picture, in order, by detector; pictures of one size in one call."""
    found: list[dict[int, Detections]] = [{} for _ in detectors]
    for size in sorted({p.shape[:2] for p in pictures}):
        rows = [k for k, p in enumerate(pictures) if p.shape[:2] == size]
        lens = torch.from_numpy(np.stack([np.asarray(frames[k].intrinsic, np.float32) for k in rows])).to(device)
        images = to_images([pictures[k] for k in rows], device)
        for own, detector in zip(found, detectors, strict=True):
            for k, one in zip(rows, to_host(_fitting(detector, images, lens)), strict=True):
                own[k] = one
    return [[own[k] for k in range(len(frames))] for own in found]


def _fitting(detector: Detector, images: torch.Tensor, lens: torch.Tensor) -> list[Detections]:
    """`predict`, of half as many pictures at a time where memory does not suffice."""
    try:
        return list(detector.predict(images, lens, threshold=FLOOR if detector.task == "2d" else None))
    except torch.OutOfMemoryError:
        if len(images) == 1:
            raise
    torch.cuda.empty_cache()
    half = len(images) // 2
    return [*_fitting(detector, images[:half], lens[:half]), *_fitting(detector, images[half:], lens[half:])]


def _merged(
    samples: Sequence[Any], by_sample: Mapping[str, Sequence[SensorFrame]], boxes: Sequence[Detections]
) -> list[SampleBoxes]:
    found, start = [], 0
    for sample in samples:
        frames = by_sample.get(sample.token, [])
        own = boxes[start : start + len(frames)]
        start += len(frames)
        merged = merge_cameras(own, [f.sensor_to_ego for f in frames], [f.ego_to_world for f in frames])
        found.append(SampleBoxes(sample.token, merged))
    return found


def detect(
    detector: Detector, root: Path, version: str, scenes: Sequence[str], *, device: str = "cpu"
) -> list[SampleBoxes]:
    """Boxes for each sample of the scenes."""
    with NuScenes(root, version) as data:
        return [one for name in scenes for one in detect_scene(detector, root, data.scene(name), device=device)]


def box_table(found: Sequence[SampleBoxes], truth: GroundTruth) -> BoxTable:
    """Found boxes as rows in the order of the truth's samples."""
    place = {token: k for k, token in enumerate(truth.samples)}
    chosen = sorted((one for one in found if one.token in place), key=lambda one: place[one.token])
    parts = [one.boxes for one in chosen]
    if not parts:
        return BoxTable.empty()

    def column(name: str) -> F64:
        return np.concatenate([np.asarray(getattr(p, name), np.float64) for p in parts])

    attributes = [_ATTRIBUTE[name] for p in parts for name in p.attribute]
    table = BoxTable(
        sample=np.repeat([place[one.token] for one in chosen], [len(p) for p in parts]).astype(np.int32),
        label=LABEL[column("label").astype(int)].astype(np.int8),
        centre=column("centre"),
        size_lwh=column("size_lwh"),
        rotation=column("rotation"),
        velocity=column("velocity"),
        attribute=np.array(attributes, np.int8),
        score=column("score"),
        ego_distance=np.full(len(attributes), np.nan),
    )
    return with_ego(table, truth.ego)


def match_boxes(found: Sequence[SampleBoxes], truth: GroundTruth) -> Matches:
    """Found boxes against the truth, as the official evaluation matches them."""
    return match(
        filter_boxes(truth.boxes, points=truth.points, racks=truth.racks),
        filter_boxes(box_table(found, truth), racks=truth.racks),
        samples=len(truth.samples),
    )


def score_3d(
    detector: Detector, root: Path, version: str, scenes: Sequence[str], *, device: str = "cpu"
) -> dict[str, float]:
    """`numbers` over some scenes."""
    truth = read_truth(root, version, scenes=frozenset(scenes))
    return numbers(match_boxes(detect(detector, root, version, scenes, device=device), truth).scores())


def numbers(scores: DetectionScores, *, few: bool = False) -> dict[str, float]:
    """The figures of scores: mAP, NDS, AP of each class and true-positive errors; those that are NaN are left out.

    Args:
        scores: The scores.
        few: Whether only mAP, NDS and the AP of cars are wanted.
    """
    found = {"mAP": scores.mean_ap, "NDS": scores.nd_score, "AP_car": scores.mean_dist_aps["car"]}
    if not few:
        found |= {f"AP_{name}": value for name, value in scores.mean_dist_aps.items()}
        found |= {short: scores.tp_errors[name] for short, name in ERRORS.items()}
    return {name: round(float(value), 6) for name, value in found.items() if np.isfinite(value)}


class Annotated(Protocol):
    """Pictures, uint8 [N, H, W, 3], by slices, and the truth of each."""

    @property
    def pictures(self) -> Any:
        """Pictures, uint8 [N, H, W, 3], by slices."""

    @property
    def truth(self) -> Sequence[Truth]:
        """The truth of each picture."""


def detect_2d(detector: Detector, batches: Iterable[torch.Tensor], *, device: str = "cpu") -> Boxes2D:
    """All detections of a detector in pictures, one row a detection.

    Args:
        detector: What looks at them.
        batches: Pictures, uint8 [N, H, W, 3], some at a time.
        device: Where the detector is.

    Returns:
        The rows, in the order of the pictures; labels are the detector's own.
    """
    found: list[Detections] = []
    for pictures in batches:
        images = pictures.to(device).permute(0, 3, 1, 2).float() / 255
        found += detector.predict(images, threshold=FLOOR)
    return Boxes2D(
        np.repeat(np.arange(len(found)), [len(one.score) for one in found]).astype(np.int32),
        _rows([one.label for one in found]).astype(np.int32),
        _rows([one.box for one in found], 4),
        _rows([one.score for one in found]),
    )


def _rows(values: Sequence[torch.Tensor], width: int | None = None) -> F64:
    """Tensors [N] or [N, width] one after the other, on the CPU."""
    empty = np.zeros((0,) if width is None else (0, width))
    return np.concatenate([empty, *(v.detach().cpu().double().numpy() for v in values)])


def score_2d(
    detector: Detector, data: Annotated, *, classes: Sequence[str] | None = None, device: str = "cpu", batch: int = 32
) -> dict[str, float]:
    """AP50 of each class of the detector that there is in annotated pictures, and their mean.

    Args:
        detector: What is scored. Objects of classes that it does not know are left out.
        data: Pictures and their truth.
        classes: Names of the labels of the truth; those of the detector if None.
        device: Where the detector is.
        batch: Pictures at once.

    Returns:
        AP50 (the mean) and AP50_NAME.
    """
    names = detector.classes
    index = {name: k for k, name in enumerate(names)}
    own = np.array([index.get(name, -1) for name in (names if classes is None else classes)], np.int32)
    batches = (data.pictures[start : start + batch] for start in range(0, len(data.truth), batch))
    predicted = detect_2d(detector, batches, device=device)
    crowd = [torch.zeros(len(t.label), dtype=torch.bool) if t.crowd is None else t.crowd for t in data.truth]
    image = np.repeat(np.arange(len(data.truth)), [len(t.label) for t in data.truth]).astype(np.int32)
    label = own[_rows([t.label for t in data.truth]).astype(np.int32)]
    known = label >= 0
    real = Boxes2D(
        image[known],
        label[known],
        _rows([t.box for t in data.truth], 4)[known],
        ignore=_rows(crowd).astype(bool)[known],
    )
    ap = average_precision(real, predicted, labels=len(names))
    each = {f"AP50_{name}": float(value) for name, value in zip(names, ap, strict=True) if np.isfinite(value)}
    return {"AP50": float(np.mean(list(each.values()))) if each else 0.0} | each
