"""What a detector finds in pictures of one's own, or in a data set: drawn, and as the official results file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ssad.core.detections import Detections
from ssad.core.errors import ConfigError, SSADError
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
from ssad.detectors.on_scenes import SampleBoxes, detect_scene, to_host

MODALITIES = dict.fromkeys(("use_lidar", "use_radar", "use_map", "use_external"), False)


@dataclass(frozen=True, slots=True)
class Marked:
    """A picture with what was found in it.

    Attributes:
        path: Where the drawn picture is.
        count: Number of boxes.
        notes: What was assumed, each in a few words.
    """

    path: Path
    count: int
    notes: tuple[str, ...]


def draw_found(picture: U8, found: Detections, classes: Sequence[str], intrinsic: F64) -> U8:
    """A picture with boxes, each with its class and score.

    Args:
        picture: RGB [H, W, 3].
        found: What was found in it.
        classes: Names of the labels.
        intrinsic: Camera matrix [3, 3], for boxes in space.
    """
    canvas = np.ascontiguousarray(picture).copy()
    width = max(1, round(picture.shape[1] / 640))
    if found.solid is None:
        draw_flat(canvas, found.box, 1.0, colour=FOUND, width=width)
    else:
        draw_solids(canvas, found.solid, intrinsic, 1.0, colour=FOUND, width=width)
    size = 0.4 * max(1.0, picture.shape[1] / 960)
    for box, label, score in zip(found.box.tolist(), found.label.tolist(), found.score.tolist(), strict=True):
        x, y = (round(min(max(v, 0), limit - 1)) for v, limit in zip(box[:2], picture.shape[1::-1], strict=True))
        words = f"{classes[label]} {score:.2f}"
        (w, h), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
        x, top = min(x, max(picture.shape[1] - w - 4, 0)), max(y - h - 6, 0)
        cv2.rectangle(canvas, (x, top), (x + w + 4, top + h + 6), (0, 0, 0), -1)
        cv2.putText(canvas, words, (x + 2, top + h + 2), cv2.FONT_HERSHEY_SIMPLEX, size, FOUND, 1, cv2.LINE_AA)
    return canvas


def detect_pictures(
    detector: Detector,
    files: Sequence[Path],
    out: Path,
    *,
    threshold: float = 0.3,
    focal: float | None = None,
    device: str = "cpu",
) -> list[Marked]:
    """Draw what a detector finds in pictures, and write all boxes to OUT/detections.json.

    Args:
        detector: On the device.
        files: The pictures, of any size.
        out: Folder of the drawn pictures.
        threshold: Least score.
        focal: Focal length in pixels, for a 3D detector; None: that of a typical camera, which is noted.
        device: Where the detector is.

    Returns:
        One entry a picture.

    Raises:
        FormatError: A file is no picture.
        ConfigError: Two pictures have one name.
        StoreError: A file cannot be written.
    """
    names = [file.stem for file in files]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"two pictures are called {twice}; give them to two commands with two OUT folders")
    make_folder(out)
    marked, listed = [], {}
    for file in files:
        read = as_images(file)
        height, width = read.tensor.shape[-2:]
        camera = Camera.typical(width, height)
        intrinsic = camera.intrinsic.copy()
        assumed = (f"focal length {intrinsic[0, 0]:.0f} pixels assumed (--focal)",) if focal is None else ()
        intrinsic[[0, 1], [0, 1]] = focal or intrinsic[0, 0]
        lens = torch.from_numpy(intrinsic.astype(np.float32))[None].to(device) if detector.task == "3d" else None
        (found,) = to_host(detector.predict(read.tensor.to(device), lens, threshold=threshold))
        picture = (read.tensor[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        path = out / f"{file.stem}.jpg"
        if path.exists() and path.samefile(file):
            raise ConfigError(f"{path} would be written over the picture that is looked at; give another OUT")
        save_picture(path, draw_found(picture, found, detector.classes, intrinsic))
        listed[file.name] = _rows(found, detector.classes)
        marked.append(Marked(path, len(found.score), (*read.notes, *(assumed if lens is not None else ()))))
    write_atomic(out / "detections.json", dump_json(listed, indent=1) + "\n")
    return marked


def _rows(found: Detections, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Boxes as plain data: x0, y0, x1, y1 in pixels; in space centre (m, camera frame), size l, h, w (m), yaw."""
    rows: list[dict[str, Any]] = []
    for n, (box, label, score) in enumerate(
        zip(found.box.tolist(), found.label.tolist(), found.score.tolist(), strict=True)
    ):
        row = {"class": classes[label], "score": round(score, 4), "box": [round(v, 2) for v in box]}
        if found.solid is not None:
            row |= {"centre": found.solid.centre[n].tolist(), "size_lhw": found.solid.size_lhw[n].tolist()}
            row["yaw"] = float(found.solid.yaw[n])
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
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[Path, int, int]:
    """Write the official results file of the nuScenes detection task for a data set: OUT/results.json.

    Args:
        detector: A 3D detector of the ten classes, on the device.
        data: The data set.
        out: Folder.
        split: Only the scenes of this split; None: all scenes.
        manifest: What `ssad score` knows the data by; see `ssad.recorders.shifted.manifest.manifest_digest`.
        device: Where the detector is.
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
    for number, name in enumerate(names):
        for one in detect_scene(detector, data.root, data.scene(name), device=device):
            results[one.token] = results_rows(one)
        progress(number + 1, len(names))
    make_folder(out)
    meta = MODALITIES | {"use_camera": True, "ssad_manifest": manifest, "ssad_detector": detector.name}
    path = out / "results.json"
    write_atomic(path, dump_json({"meta": meta, "results": results}))
    return path, len(results), sum(map(len, results.values()))


def results_rows(found: SampleBoxes) -> list[dict[str, Any]]:
    """The boxes of a sample as the official file has them."""
    boxes = found.boxes
    return [
        {
            "sample_token": found.token,
            "translation": boxes.centre[n].tolist(),
            "size": boxes.size_wlh[n].tolist(),
            "rotation": boxes.rotation[n].tolist(),
            "velocity": np.nan_to_num(boxes.velocity[n, :2]).tolist(),
            "detection_name": MMDET3D_CLASSES[int(boxes.label[n])],
            "detection_score": float(boxes.score[n]),
            "attribute_name": boxes.attribute[n],
        }
        for n in range(len(boxes.score))
    ]


def is_dataset(path: Path) -> bool:
    """Whether a path is a folder in the nuScenes schema: one with a version in it.

    Raises:
        SSADError: There is nothing there.
    """
    if not path.exists():
        raise SSADError(f"{path}: no such file or folder")
    return path.is_dir() and any(path.glob("*/sample_data.json"))
