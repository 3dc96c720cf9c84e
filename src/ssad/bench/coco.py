"""COCO annotations of a folder of pictures: written in a fixed order, read with checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ssad import safeio
from ssad.errors import FormatError
from ssad.types import F64, I32, Bool


@dataclass(frozen=True, slots=True)
class CocoImage:
    """One picture: its file, width and height, what is known about it, and its N boxes (x1, y1, x2, y2 pixels) with
    labels (index into the set's classes), crowd (counts neither way), and target (the object that the set is about)."""

    file: Path
    width: int
    height: int
    about: Mapping[str, Any]
    box: F64
    label: I32
    crowd: Bool
    target: Bool


@dataclass(frozen=True, slots=True)
class CocoSet:
    """Pictures of an annotation file and the names of its classes, in the order of their ids."""

    classes: tuple[str, ...]
    images: tuple[CocoImage, ...]


def coco_data(classes: Sequence[str], images: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> dict[str, Any]:
    """The content of an annotation file. Each image: file_name, width, height, anything else, and `objects`, each
    with label (index), box (x1, y1, x2, y2), pixels, crowd and anything else."""
    rows: list[dict[str, Any]] = []
    boxes: list[dict[str, Any]] = []
    for number, image in enumerate(images, 1):
        rows.append({"id": number} | {k: v for k, v in image.items() if k != "objects"})
        for thing in image["objects"]:
            x1, y1, x2, y2 = thing["box"]
            extra = {k: v for k, v in thing.items() if k not in ("label", "box", "pixels", "crowd")}
            boxes.append(
                {"id": len(boxes) + 1, "image_id": number, "category_id": thing["label"] + 1,
                 "bbox": [x1, y1, x2 - x1, y2 - y1], "area": thing["pixels"], "iscrowd": int(thing["crowd"])} | extra
            )  # fmt: skip
    kinds = [{"id": k + 1, "name": name, "supercategory": "road"} for k, name in enumerate(classes)]
    return {"info": dict(about), "images": rows, "annotations": boxes, "categories": kinds}


def read_coco(path: Path, *, images: Path | None = None) -> CocoSet:
    """An annotation file; images: folder of the pictures (default: `images` beside the file's folder, else the file's
    own folder). FormatError: something is missing, or points into nowhere."""
    data = safeio.read_json(path)
    lists = ("images", "annotations", "categories")
    if not isinstance(data, dict) or any(not isinstance(data.get(k), list) for k in lists):
        raise FormatError(f"{path}: no COCO annotations (lists `images`, `annotations` and `categories`)")
    beside = path.parent.parent / "images"
    folder = images or (beside if beside.is_dir() else path.parent)
    try:
        ids = sorted((int(c["id"]), str(c["name"])) for c in data["categories"])
        label_of = {number: k for k, (number, _) in enumerate(ids)}
        found: dict[Any, list[Mapping[str, Any]]] = {row["id"]: [] for row in data["images"]}
        for n, row in enumerate(data["annotations"]):
            if row["image_id"] not in found or row["category_id"] not in label_of:
                raise FormatError(f"{path}: annotation {n} belongs to no image or category of the file")
            found[row["image_id"]].append(row)
        pictures = []
        for row in data["images"]:
            own = found[row["id"]]
            corner = np.array([r["bbox"] for r in own], np.float64).reshape(-1, 4)
            if not np.isfinite(corner).all() or (corner[:, 2:] <= 0).any():
                raise FormatError(f"{path}: image {row['id']}: a box without width, height or number")
            pictures.append(
                CocoImage(
                    folder / str(row["file_name"]), int(row["width"]), int(row["height"]),
                    {k: v for k, v in row.items() if k not in ("id", "file_name", "width", "height")},
                    np.concatenate([corner[:, :2], corner[:, :2] + corner[:, 2:]], 1),
                    np.array([label_of[r["category_id"]] for r in own], np.int32),
                    np.array([bool(r.get("iscrowd", 0)) for r in own], bool),
                    np.array([bool(r.get("target", False)) for r in own], bool),
                )
            )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: broken COCO annotations ({type(error).__name__}: {error})") from None
    return CocoSet(tuple(name for _, name in ids), tuple(pictures))
