"""Annotated photographs in the forms of COCO, KITTI, nuScenes and BDD100K, and in lists of single photographs.

Classes are those of nuScenes's detection task, stop signs and traffic lights; each form's names are mapped to them.
Objects that a form leaves open (KITTI's DontCare, vans and cyclists, BDD100K's riders and trains, COCO's crowds) are
ignored: a box on them is neither right nor wrong. Photographs are read in place.

Sources: cocodataset.org, format-data; Geiger et al., Are we ready for autonomous driving? (2012), devkit of the object
benchmark; nuscenes.org, schema of version 1.0; Yu et al., BDD100K (2020), format of the label files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.core.folders import data_path
from ssad.core.images import read_annotated_image
from ssad.core.import_report import ImportReport
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.types import F64, I32, U8, Bool
from ssad.datasets.coco import MAX_FILE_BYTES, read_coco
from ssad.datasets.nuscenes.camera_truth import camera_truth, scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.tables import nuscenes_path

Form = Literal["coco", "kitti", "nuscenes", "bdd100k", "list"]
CLASSES: Final = (*MMDET3D_CLASSES, "stop_sign", "traffic_light")
IGNORED: Final = "ignored"
CLASS_OF_NAME: Final[Mapping[str, str]] = {
    **{name: name for name in CLASSES},
    "person": "pedestrian",
    "bike": "bicycle",
    "motor": "motorcycle",
    "construction vehicle": "construction_vehicle",
    "traffic cone": "traffic_cone",
    "stop sign": "stop_sign",
    "traffic light": "traffic_light",
    **dict.fromkeys(
        ("van", "person_sitting", "cyclist", "tram", "misc", "dontcare", "rider", "train", "other", IGNORED), IGNORED
    ),
}
"""Lower-case name of a form or of a detector -> class of `CLASSES`, or `IGNORED`; other names are left out."""
COCO_NAMES: Final = frozenset({"train"})
"""Names that in COCO mean no road user, and are left out instead of ignored."""
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg")
NO_SOLID: Final = (np.nan,) * 7
NOT_A_NUMBER: Final = re.compile(r"(?<=[\[,:\s])NaN(?=[\],}\s])")  # Python's json writes it, which JSON does not have


@dataclass(frozen=True, slots=True)
class Photograph:
    """Photograph with its N annotated objects.

    Attributes:
        name: Name in records and on pages: the path below its folder.
        file: File of the photograph.
        size: Width and height that the annotations state, pixels; 0, 0 where they state none.
        box: x1, y1, x2, y2 in pixels [N, 4].
        label: Index into `CLASSES` [N]; -1 for ignored objects.
        solid: 3D boxes [N, 7]: centre x, y, z in the camera's frame (x right, y down, z forward), length, height and
            width, m, and yaw, rad; NaN where there is none.
        intrinsic: Camera matrix [3, 3]; None where the form has none.
    """

    name: str
    file: Path
    size: tuple[int, int]
    box: F64
    label: I32
    solid: F64
    intrinsic: F64 | None

    @property
    def ignored(self) -> Bool:
        """Objects that count neither as detected nor as missed [N]."""
        return np.asarray(self.label < 0)

    def read(self) -> U8:
        """Read the photograph as uint8 [H, W, 3] RGB, in the frame of its annotations.

        Raises:
            FormatError: The file cannot be read, or has another size.
        """
        return read_annotated_image(self.file, width=self.size[0], height=self.size[1])


@dataclass(frozen=True, slots=True)
class PhotographSet:
    """Photographs of a folder.

    Attributes:
        form: Form of the annotations.
        photographs: The photographs, in the order of the annotations.
        classes: Classes that the form can annotate, in the order of `CLASSES`.
        report: Contents, what is left out, and what is doubtful.
    """

    form: Form
    photographs: tuple[Photograph, ...]
    classes: tuple[str, ...]
    report: ImportReport

    def thinned(self, limit: int) -> PhotographSet:
        """Return at most `limit` photographs, evenly spread over the set."""
        count = len(self.photographs)
        if count <= limit:
            return self
        indices = [number * count // limit for number in range(limit)]
        return replace(self, photographs=tuple(self.photographs[index] for index in indices))


def class_of(name: str) -> str:
    """Return the class of `CLASSES` that a form or a detector calls by a name, `IGNORED`, or "" for neither."""
    return CLASS_OF_NAME.get(name.strip().lower(), "")


def read_photographs(path: Path, split: str = "") -> PhotographSet:
    """Read the annotations of a folder, or of a JSON file.

    Args:
        path: COCO: folder with annotations/*.json, or such a file. KITTI: folder with image_2 and label_2, or with
            training. nuScenes: root of a data set. BDD100K: folder with labels and images. Else a folder with JSON
            files that list photographs (docs/how-to/test-on-photographs.md).
        split: Split of the photographs, such as val2017; "": all of them, or the only file.

    Raises:
        ConfigError: There are no annotated photographs, no such split, or several files of annotations and no split.
        FormatError: The annotations are broken.
        StoreError: A file leads out of the folder.
    """
    if path.is_file():
        photographs = _read_json_files([path], split)
        if split and photographs.form != "bdd100k":
            raise ConfigError(f"{path}: split {split!r} with a single file of form {photographs.form}; leave one out")
        return photographs
    if not path.is_dir():
        raise ConfigError(f"{path}: no such folder; give a folder of annotated photographs")
    if any(path.glob("*/sample.json")):
        return _read_nuscenes(path, split)
    for kitti_root in (path, path / "training"):
        if (kitti_root / "image_2").is_dir():
            return _read_kitti(kitti_root, split)
    annotations = _annotation_files(path, split)
    if not annotations:
        raise ConfigError(
            f"{path}: no annotated photographs: expected annotations/*.json (COCO), image_2 and label_2 (KITTI), "
            "VERSION/sample.json (nuScenes), labels/**/*.json (BDD100K), or JSON lists of photographs"
        )
    return _read_json_files(annotations, split)


def _annotation_files(folder: Path, split: str) -> list[Path]:
    """Return the JSON files of annotations of a folder, of a split if one is named."""
    for pattern in ("annotations/*.json", "labels/**/*.json", "*.json"):
        files = sorted(folder.glob(pattern))
        if not files:
            continue
        if pattern == "*.json":
            return [file for file in files if not split or split in file.stem]
        matching = [file for file in files if split and (file.stem == split or file.stem.endswith(f"_{split}"))]
        # COCO has files of captions and keypoints beside those of objects.
        matching = [file for file in matching if file.stem.startswith("instances_")] or matching
        candidates = matching or ([] if split else files)
        if len(candidates) == 1:
            return candidates
        names = ", ".join(file.relative_to(folder).as_posix() for file in files[:8])
        problem = f"no split '{split}'" if split and not candidates else "several files of annotations"
        raise ConfigError(f"{folder}: {problem} ({names}); name one as the split, or give the file")
    return []


def _read_json_files(files: Sequence[Path], split: str) -> PhotographSet:
    """Read files of one form; only lists of photographs may be several."""
    sets = [_read_json_file(file, split) for file in files]
    if len({photographs.form for photographs in sets}) > 1 or (len(sets) > 1 and sets[0].form != "list"):
        names = ", ".join(file.name for file in files)
        raise ConfigError(f"{files[0].parent}: several files of annotations ({names}); give one of them as the data")
    report = ImportReport(str(files[0]) if len(files) == 1 else str(files[0].parent))
    for photographs in sets:
        report.extend(photographs.report)
    joined = tuple(photograph for photographs in sets for photograph in photographs.photographs)
    if not joined:
        raise ConfigError(f"{report.source}: no photograph in the annotations; choose another file or split")
    classes = {name for photographs in sets for name in photographs.classes}
    return PhotographSet(sets[0].form, joined, tuple(name for name in CLASSES if name in classes), report)


def _read_json_file(path: Path, split: str) -> PhotographSet:
    text = safeio.read_text(path, limit=MAX_FILE_BYTES)
    content = safeio.parse_json(NOT_A_NUMBER.sub("null", text) if "NaN" in text else text, str(path))
    report = ImportReport(str(path))
    try:
        if isinstance(content, list):
            return _read_bdd100k(path, content, split, report)
        if isinstance(content, dict) and isinstance(content.get("images"), dict):
            return _read_list(path, content["images"], report)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise FormatError(f"{path}: broken annotations ({type(error).__name__}: {error})") from None
    return _read_coco(path, content, report)


def _read_coco(path: Path, content: Any, report: ImportReport) -> PhotographSet:
    """Read COCO annotations; photographs lie in images, in a folder named as the split, or beside the file."""
    entries = content.get("images") if isinstance(content, dict) else None
    first_name = str(entries[0].get("file_name", "")) if isinstance(entries, list) and entries else ""
    folder = path.parent.parent if path.parent.name == "annotations" else path.parent
    split = path.stem.removeprefix("instances_")
    candidates = [folder / "images" / split, folder / split, folder / "images", path.parent, folder]
    images = next((candidate for candidate in candidates if first_name and (candidate / first_name).is_file()), None)
    if images is not None and images != folder:
        data_path(folder, images.relative_to(folder))
    data = read_coco(path, images=images, report=report)
    classes = [_coco_class(name) for name in data.classes]
    photographs = []
    for image in data.images:
        names = [
            IGNORED if crowd and classes[label] else classes[label]
            for label, crowd in zip(image.label, image.crowd, strict=True)
        ]
        name = image.file.relative_to(images or image.file.parent).as_posix()
        photographs.append(_photograph(name, image.file, (image.width, image.height), names, image.box))
    return _of("coco", photographs, classes, report)


def _coco_class(name: str) -> str:
    """Return the class of a category of COCO."""
    return "" if name.strip().lower() in COCO_NAMES else class_of(name)


def _read_list(path: Path, entries: Mapping[str, Any], report: ImportReport) -> PhotographSet:
    """Read a list of photographs beside the file: intrinsics, and objects with name, bbox and box3d_camera."""
    photographs = []
    for file_name, entry in entries.items():
        objects = entry["objects"]
        intrinsic = np.array(entry["intrinsics"], np.float64)[:3, :3] if entry.get("intrinsics") else None
        if intrinsic is not None and (intrinsic.shape != (3, 3) or not np.isfinite(intrinsic).all()):
            raise ValueError(f"{file_name}: intrinsics are no matrix of 3 x 3 numbers")
        photographs.append(
            _photograph(
                str(file_name),
                data_path(path.parent, str(file_name)),
                (0, 0),
                [class_of(str(scene_object["name"])) for scene_object in objects],
                [scene_object["bbox"] for scene_object in objects],
                solids=[scene_object.get("box3d_camera") or NO_SOLID for scene_object in objects],
                intrinsic=intrinsic,
            )
        )
    return _of("list", photographs, _named_classes(photographs), report)


def _read_bdd100k(path: Path, entries: Sequence[Any], split: str, report: ImportReport) -> PhotographSet:
    """Read BDD100K's labels of objects: a list of frames, each with labels of a category and a box2d."""
    parts = path.parts
    folder = Path(*parts[: parts.index("labels")]) if "labels" in parts else path.parent
    split = split or path.stem.rpartition("_")[2]
    candidates = [folder / "images" / "100k" / split, folder / "images" / split, folder / "images", folder]
    photographs = []
    for entry in entries:
        name = str(entry["name"])
        labels = [label_entry for label_entry in entry.get("labels") or [] if label_entry.get("box2d") is not None]
        boxes = [[label_entry["box2d"][side] for side in ("x1", "y1", "x2", "y2")] for label_entry in labels]
        images = next((candidate for candidate in candidates if (candidate / name).is_file()), candidates[0])
        image_file = data_path(folder, (images / name).relative_to(folder))
        names = [class_of(str(label_entry["category"])) for label_entry in labels]
        photographs.append(_photograph(name, image_file, (0, 0), names, boxes))
    classes = ("car", "truck", "bus", "bicycle", "motorcycle", "pedestrian", "traffic_light")
    return _of("bdd100k", photographs, classes, report)


def _read_kitti(kitti_root: Path, split: str) -> PhotographSet:
    """Read KITTI's object benchmark: image_2, label_2 and, for 3D detectors, calib."""
    report = ImportReport(str(kitti_root))
    numbers = None
    if split:
        path = next(
            (
                folder / "ImageSets" / f"{split}.txt"
                for folder in (kitti_root, kitti_root.parent)
                if (folder / "ImageSets" / f"{split}.txt").is_file()
            ),
            None,
        )
        if path is None:
            raise ConfigError(f"{kitti_root}: no split '{split}': there is no ImageSets/{split}.txt")
        numbers = set(safeio.read_text(path).split())
    photographs = []
    for image_file in sorted((kitti_root / "image_2").iterdir()):
        if image_file.suffix.lower() not in IMAGE_SUFFIXES or (numbers is not None and image_file.stem not in numbers):
            continue
        labels = data_path(kitti_root, f"label_2/{image_file.stem}.txt")
        if not labels.is_file():
            report.omit("photographs without a file in label_2", image_file.name)
            continue
        photographs.append(_kitti_photograph(kitti_root, data_path(kitti_root, f"image_2/{image_file.name}"), labels))
    if not photographs:
        raise ConfigError(f"{kitti_root}: no photograph of image_2 has a file in label_2")
    return _of("kitti", photographs, ("car", "truck", "pedestrian"), report)


def _kitti_photograph(kitti_root: Path, image_file: Path, labels: Path) -> Photograph:
    intrinsic, offset = _kitti_camera(data_path(kitti_root, f"calib/{image_file.stem}.txt"))
    names, boxes, solids = [], [], []
    for number, line in enumerate(safeio.read_text(labels).splitlines(), 1):
        words = line.split()
        if not words:
            continue
        try:
            values = [float(word) for word in words[1:15]]
        except ValueError:
            values = []
        if len(values) < 14:
            raise FormatError(f"{labels}, line {number}: no object of KITTI; give a type and 14 numbers")
        names.append(class_of(words[0]))
        boxes.append(values[3:7])
        height, width, length, x, y, z, yaw = values[7:14]
        has_solid = intrinsic is not None and height > 0 and z > 0
        solids.append((x + offset, y - height / 2, z, length, height, width, yaw) if has_solid else NO_SOLID)
    return _photograph(image_file.name, image_file, (0, 0), names, boxes, solids=solids, intrinsic=intrinsic)


def _kitti_camera(path: Path) -> tuple[F64 | None, float]:
    """Return the matrix of the left colour camera and its offset from the reference camera, m; None without a file."""
    if not path.is_file():
        return None, 0.0
    for line in safeio.read_text(path).splitlines():
        name, _, text = line.partition(":")
        if name.strip() == "P2":
            try:
                projection = np.array([float(word) for word in text.split()]).reshape(3, 4)
            except ValueError:
                break
            if projection[0, 0] > 0 and np.isfinite(projection).all():
                return projection[:, :3], float(projection[0, 3] / projection[0, 0])
    raise FormatError(f"{path}: no projection P2 of twelve numbers; give the calib file of the photograph")


def _read_nuscenes(root: Path, split: str) -> PhotographSet:
    """Read the key images of all cameras of a data set in the nuScenes schema."""
    photographs = []
    with NuScenes(root) as data:
        report = data.report()
        scenes = scenes_of(data, split) if split else tuple(scene.name for scene in data.scenes())
        for name in scenes:
            scene = data.scene(name)
            for frame in scene.frames:
                if frame.modality != "camera" or not frame.key_frame:
                    continue
                truth = camera_truth(frame, scene.annotations(frame.sample_token))
                assert truth.solid is not None
                solid_boxes = np.concatenate(
                    [
                        truth.solid.centre.double().numpy(),
                        truth.solid.size_lhw.double().numpy(),
                        truth.solid.yaw.double().numpy()[:, None],
                    ],
                    1,
                )
                photographs.append(
                    Photograph(
                        frame.filename,
                        nuscenes_path(root, frame.filename),
                        (frame.width, frame.height),
                        truth.box.double().numpy(),
                        truth.label.numpy().astype(np.int32),
                        solid_boxes,
                        frame.intrinsic,
                    )
                )
    return PhotographSet("nuscenes", tuple(photographs), MMDET3D_CLASSES, report)


def _photograph(
    name: str,
    image_file: Path,
    size: tuple[int, int],
    names: Sequence[str],
    boxes: Iterable[Any],
    *,
    solids: Iterable[Any] | None = None,
    intrinsic: F64 | None = None,
) -> Photograph:
    """Return a photograph with its objects that have a class or are ignored. Raise ValueError for a broken box."""
    rows = [row for row, class_name in enumerate(names) if class_name]
    box = np.array([list(entry) for entry in boxes], np.float64).reshape(-1, 4)
    solid_boxes = np.array([list(entry) for entry in solids or [NO_SOLID] * len(names)], np.float64).reshape(-1, 7)
    if len(box) != len(names) or len(solid_boxes) != len(names):
        raise ValueError(f"{name}: {len(names)} objects, {len(box)} boxes")
    if not np.isfinite(box).all() or (box[:, 2:] <= box[:, :2]).any():
        raise ValueError(f"{name}: a box without width or height, or not finite")
    labels = [CLASSES.index(names[row]) if names[row] != IGNORED else -1 for row in rows]
    return Photograph(name, image_file, size, box[rows], np.array(labels, np.int32), solid_boxes[rows], intrinsic)


def _named_classes(photographs: Sequence[Photograph]) -> list[str]:
    """Return the classes that occur in photographs, of a form that lists none."""
    labels = {label for photograph in photographs for label in photograph.label.tolist() if label >= 0}
    return [CLASSES[label] for label in sorted(labels)]


def _of(form: Form, photographs: Sequence[Photograph], classes: Iterable[str], report: ImportReport) -> PhotographSet:
    names = set(classes)
    if form != "coco":
        objects = sum(len(photograph.label) for photograph in photographs)
        report.contents.append(f"{len(photographs)} photographs with {objects} objects")
    return PhotographSet(form, tuple(photographs), tuple(name for name in CLASSES if name in names), report)
