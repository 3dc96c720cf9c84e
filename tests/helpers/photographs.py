"""Small stand-ins for annotated photographs in the forms of COCO, KITTI, BDD100K and of lists."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ssad.core.detections import Dense, Detections

SIZES = ((160, 96), (96, 96))
CARS = ((20, 30, 68, 70), (40, 20, 88, 62))
"""Width and height of each photograph, and its one car: orange on grey."""
ORANGE = (250, 120, 20)
INTRINSIC = [[100.0, 0.0, 80.0], [0.0, 100.0, 48.0], [0.0, 0.0, 1.0]]


def write_image(path: Path, number: int) -> Path:
    """Write a photograph: noise, and its car."""
    width, height = SIZES[number]
    pixels = np.random.default_rng(number).integers(100, 156, (height, width, 3), np.uint8)
    x1, y1, x2, y2 = CARS[number]
    pixels[y1:y2, x1:x2] = ORANGE
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def write_coco(folder: Path, splits: Sequence[str] = ("train2017", "val2017")) -> Path:
    """Write COCO: a car, a person that is a crowd, a train and a dining table in each photograph."""
    names = {1: "person", 3: "car", 7: "train", 67: "dining table"}
    for split in splits:
        images, annotations = [], []
        for number, (width, height) in enumerate(SIZES):
            write_image(folder / split / f"{number:012d}.png", number)
            images.append({"id": number, "file_name": f"{number:012d}.png", "width": width, "height": height})
            x1, y1, x2, y2 = CARS[number]
            boxes = {3: [x1, y1, x2 - x1, y2 - y1], 1: [0, 0, 12, 30], 7: [70, 0, 20, 20], 67: [0, 80, 30, 10]}
            annotations += [
                {
                    "id": 10 * number + category,
                    "image_id": number,
                    "category_id": category,
                    "bbox": box,
                    "area": box[2] * box[3],
                    "iscrowd": int(category == 1),
                }
                for category, box in boxes.items()
            ]
        categories = [{"id": number, "name": name} for number, name in names.items()]
        data = {"images": images, "annotations": annotations, "categories": categories}
        path = folder / "annotations" / f"instances_{split}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data))
        path.with_name(f"captions_{split}.json").write_text("{}")
    return folder


def write_kitti(folder: Path) -> Path:
    """Write KITTI: a car with a 3D box, a van and a region without labels; calibration and a split."""
    for number, (x1, y1, x2, y2) in enumerate(CARS):
        write_image(folder / "training" / "image_2" / f"{number:06d}.png", number)
        rows = [
            f"Car 0.00 0 0.0 {x1} {y1} {x2} {y2} 1.60 1.92 4.20 -1.44 1.88 6.00 -1.5708",
            "Van 0.00 0 0.0 0 0 10 20 2.0 2.0 5.0 0.0 2.0 30.0 0.0",
            "DontCare -1 -1 -10 80 5 90 15 -1 -1 -1 -1000 -1000 -1000 -10",
        ]
        values = " ".join(str(value) for row in INTRINSIC for value in [*row, 0.0])
        for part, text in (("label_2", "\n".join(rows)), ("calib", f"P0: {values}\nP2: {values}\n")):
            path = folder / "training" / part / f"{number:06d}.txt"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
    (folder / "ImageSets").mkdir()
    (folder / "ImageSets" / "val.txt").write_text("000001\n")
    return folder


def write_bdd100k(folder: Path, splits: Sequence[str] = ("train", "val")) -> Path:
    """Write BDD100K: a car, a rider and a lane without a box in each photograph."""
    for split in splits:
        frames = []
        for number, box in enumerate(CARS):
            write_image(folder / "images" / "100k" / split / f"{number}.png", number)
            labels = [
                {"category": "car", "box2d": dict(zip(("x1", "y1", "x2", "y2"), map(float, box), strict=True))},
                {"category": "rider", "box2d": {"x1": 1.0, "y1": 1.0, "x2": 9.0, "y2": 20.0}},
                {"category": "lane", "poly2d": []},
            ]
            frames.append({"name": f"{number}.png", "labels": labels})
        path = folder / "labels" / "det_20" / f"det_{split}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(frames))
    return folder


def write_list(folder: Path, images: Sequence[int] = (0, 1), **changes: Any) -> Path:
    """Write a list of photographs, with a 3D box of the first car."""
    entries: dict[str, Any] = {}
    for number in images:
        write_image(folder / f"{number}.png", number)
        scene_object = {"name": "car", "bbox": list(CARS[number]), "velocity": [float("nan"), 0.0]}
        if number == 0:
            scene_object["box3d_camera"] = [-1.44, 1.08, 6.0, 4.2, 1.6, 1.92, -1.5708]
        entries[f"{number}.png"] = {"intrinsics": INTRINSIC, "objects": [scene_object]} | changes
    (folder / "photographs.json").write_text(json.dumps({"images": entries}))
    return folder


class OrangeDetector:
    """A detector that finds the box around all orange pixels; the score is their share of it."""

    name, task, classes = "orange", "2d", ("car", "pedestrian")

    def predict(self, images: Any, intrinsic: Any = None, *, threshold: float | None = None) -> list[Detections]:
        detections = []
        for image in images:
            is_orange = (image[0] > 0.9) & (image[1] > 0.4) & (image[1] < 0.55) & (image[2] < 0.2)
            rows, columns = is_orange.nonzero(as_tuple=True)
            if not len(rows):
                detections.append(Detections(torch.zeros(0), torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4)))
                continue
            corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            box = torch.tensor([[float(corner) for corner in corners]])
            share = len(rows) / (box[0, 2:] - box[0, :2]).prod()
            detections.append(Detections(share[None], torch.zeros(1, dtype=torch.int64), box))
        return detections

    def dense(self, images: Any, intrinsic: Any = None) -> Dense:
        raise NotImplementedError

    assign = losses = dense
