"""Detections in a user's images, drawn, or in a data set, as the official results file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ssad.core.detections import Detections
from ssad.core.errors import ConfigError, FormatError, SSADError
from ssad.core.frames import Camera
from ssad.core.images import save_picture
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.protocols import Detector
from ssad.core.safeio import dump_json, make_folder, write_atomic
from ssad.core.types import F64, U8
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors.drawing import FOUND, draw_flat, draw_solids
from ssad.detectors.images import as_images
from ssad.detectors.on_scenes import SampleBoxes, detect_scene

MODALITIES = dict.fromkeys(("use_lidar", "use_radar", "use_map", "use_external"), False)


@dataclass(frozen=True, slots=True)
class DrawnImage:
    """Image with its detections.

    Attributes:
        path: Path of the drawn image.
        count: Number of boxes.
        notes: Assumptions, each in a few words.
        problem: File and reason, where the image could not be read.
    """

    path: Path
    count: int
    notes: tuple[str, ...]
    problem: str = ""


def draw_detections(image: U8, detections: Detections, classes: Sequence[str], intrinsic: F64) -> U8:
    """Return an image with boxes, each with its class and score.

    Args:
        image: RGB [H, W, 3].
        detections: Detections in the image.
        classes: Names of the labels.
        intrinsic: Camera matrix [3, 3], for boxes in space.
    """
    canvas = np.ascontiguousarray(image).copy()
    width = max(1, round(image.shape[1] / 640))
    if detections.solid is None:
        draw_flat(canvas, detections.box, 1.0, colour=FOUND, width=width)
    else:
        draw_solids(canvas, detections.solid, intrinsic, 1.0, colour=FOUND, width=width)
    font_scale = 0.4 * max(1.0, image.shape[1] / 960)
    for box, label, score in zip(
        detections.box.tolist(), detections.label.tolist(), detections.score.tolist(), strict=True
    ):
        left, box_top = (
            round(min(max(coordinate, 0), limit - 1))
            for coordinate, limit in zip(box[:2], image.shape[1::-1], strict=True)
        )
        caption = f"{classes[label]} {score:.2f}"
        (text_width, text_height), _ = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, font_scale, 1)
        left, top = min(left, max(image.shape[1] - text_width - 4, 0)), max(box_top - text_height - 6, 0)
        cv2.rectangle(canvas, (left, top), (left + text_width + 4, top + text_height + 6), (0, 0, 0), -1)
        cv2.putText(
            canvas,
            caption,
            (left + 2, top + text_height + 2),
            cv2.FONT_HERSHEY_SIMPLEX,
            font_scale,
            FOUND,
            1,
            cv2.LINE_AA,
        )
    return canvas


def detect_images(
    detector: Detector,
    files: Sequence[Path],
    out: Path,
    *,
    root: Path | None = None,
    threshold: float = 0.3,
    focal: float | None = None,
    device: str = "cpu",
) -> list[DrawnImage]:
    """Draw the detections in images, and write all boxes to OUT/detections.json.

    Images are upright by their EXIF orientation, and so are the boxes.

    Args:
        detector: Detector on the device.
        files: The images, of any size.
        out: Folder of the drawn images.
        root: Folder of the images, whose layout OUT repeats; an unreadable file is then reported and the others go
            on. None: images from anywhere.
        threshold: Minimum score.
        focal: Focal length in pixels, for a 3D detector; None: that of a typical camera, which is noted.
        device: Device of the detector.

    Returns:
        One entry per image.

    Raises:
        FormatError: A file is not an image, and no root is given.
        ConfigError: Two images have the same name.
        StoreError: A file cannot be written.
    """
    keys = [file.name if root is None else file.relative_to(root).as_posix() for file in files]
    # Drawn images are named after the stem, so a.png and a.jpg would overwrite each other.
    stems = [key.removesuffix(file.suffix) for key, file in zip(keys, files, strict=True)]
    counts = Counter(stems)
    duplicate = next((stem for stem, count in counts.items() if count > 1), None)
    if duplicate is not None and root is None:
        raise ConfigError(f"two pictures are called {duplicate}; give them to two commands with two OUT folders")
    # First, so that the folder of a stopped command is known as its own.
    write_atomic(make_folder(out) / "detections.json", "{}\n")
    annotated_images, rows_by_file = [], {}
    for file, key, stem in zip(files, keys, stems, strict=True):
        path = out / f"{stem if counts[stem] == 1 else key}.jpg"
        try:
            loaded = as_images(file)
        except FormatError as error:
            if root is None:
                raise
            problem = f"{key}: {str(error).removeprefix(f'{file}: ')}"
            annotated_images.append(DrawnImage(path, 0, (), problem))
            continue
        height, width = loaded.tensor.shape[-2:]
        camera = Camera.typical(width, height)
        intrinsic = camera.intrinsic.copy()
        assumptions = (f"focal length {intrinsic[0, 0]:.0f} pixels assumed (--focal)",) if focal is None else ()
        intrinsic[[0, 1], [0, 1]] = focal or intrinsic[0, 0]
        intrinsic_batch = (
            torch.from_numpy(intrinsic.astype(np.float32))[None].to(device) if detector.task == "3d" else None
        )
        (detections,) = Detections.cpu(detector.predict(loaded.tensor.to(device), intrinsic_batch, threshold=threshold))
        image = (loaded.tensor[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        if path.exists() and path.samefile(file):
            raise ConfigError(f"{path} would be written over the picture that is looked at; give another OUT")
        save_picture(path, draw_detections(image, detections, detector.classes, intrinsic))
        rows_by_file[key] = _rows(detections, detector.classes)
        annotated_images.append(
            DrawnImage(
                path, len(detections.score), (*loaded.notes, *(assumptions if intrinsic_batch is not None else ()))
            )
        )
    write_atomic(out / "detections.json", dump_json(rows_by_file, indent=1) + "\n")
    return annotated_images


def _rows(detections: Detections, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Return boxes as plain data: x0, y0, x1, y1 (pixels); for 3D centre (m, camera frame), size l, h, w (m), yaw."""
    rows: list[dict[str, Any]] = []
    for index, (box, label, score) in enumerate(
        zip(detections.box.tolist(), detections.label.tolist(), detections.score.tolist(), strict=True)
    ):
        row = {"class": classes[label], "score": round(score, 4), "box": [round(coordinate, 2) for coordinate in box]}
        if detections.solid is not None:
            row |= {
                "centre": detections.solid.centre[index].tolist(),
                "size_lhw": detections.solid.size_lhw[index].tolist(),
            }
            row["yaw"] = float(detections.solid.yaw[index])
        rows.append(row)
    return rows


def detect_dataset(
    detector: Detector,
    data: NuScenes,
    out: Path,
    *,
    split: str | None = None,
    manifest: str = "clean",
    device: str = "cpu",
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> tuple[Path, int, int]:
    """Write the official results file of the nuScenes detection task for a data set: OUT/results.json.

    Args:
        detector: A 3D detector of the ten classes, on the device.
        data: The data set.
        out: Folder.
        split: Only the scenes of this split; None: all scenes.
        manifest: Identity of the data for `ssad score`; see `ssad.recorders.shifted.manifest.manifest_digest`.
        device: Device of the detector.
        progress: Called with the number of scenes that are done, and of all.

    Returns:
        Path of the file, number of samples, number of boxes.

    Raises:
        ConfigError: The detector finds no boxes in space, or there is no such split.
        FormatError: The data set or a picture is broken.
    """
    if detector.task != "3d":
        raise ConfigError(
            f"{detector.name} finds boxes in the picture, and the results of a data set are boxes in space; "
            "take a 3D detector such as fcos3d-light, or give it pictures"
        )
    names = scenes_of(data, split) if split else tuple(scene.name for scene in data.scenes())
    results: dict[str, list[dict[str, Any]]] = {}
    for scene_index, name in enumerate(names):
        for sample_boxes in detect_scene(detector, data.root, data.scene(name), device=device):
            results[sample_boxes.token] = results_rows(sample_boxes)
        progress(scene_index + 1, len(names))
    make_folder(out)
    meta = MODALITIES | {"use_camera": True, "ssad_manifest": manifest, "ssad_detector": detector.name}
    path = out / "results.json"
    write_atomic(path, dump_json({"meta": meta, "results": results}))
    return path, len(results), sum(map(len, results.values()))


def results_rows(sample: SampleBoxes) -> list[dict[str, Any]]:
    """Return the boxes of a sample as rows of the official file."""
    boxes = sample.boxes
    return [
        {
            "sample_token": sample.token,
            "translation": boxes.centre[row_index].tolist(),
            "size": boxes.size_wlh[row_index].tolist(),
            "rotation": boxes.rotation[row_index].tolist(),
            "velocity": np.nan_to_num(boxes.velocity[row_index, :2]).tolist(),
            "detection_name": MMDET3D_CLASSES[int(boxes.label[row_index])],
            "detection_score": float(boxes.score[row_index]),
            "attribute_name": boxes.attribute[row_index],
        }
        for row_index in range(len(boxes.score))
    ]


def is_dataset(path: Path) -> bool:
    """Return True for a folder in the nuScenes schema, which has a version in it.

    Raises:
        SSADError: The path does not exist.
    """
    if not path.exists():
        raise SSADError(f"{path}: no such file or folder")
    return path.is_dir() and any(path.glob("*/sample_data.json"))
