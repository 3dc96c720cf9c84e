"""Folders of pictures in any layout, such as KITTI's and COCO's: which file is what, and where symbolic links lead."""

from __future__ import annotations

import os
import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from ssad.core.errors import FormatError, StoreError
from ssad.core.folders import is_linkable, link_remedy
from ssad.core.image_files import is_image
from ssad.core.import_report import ImportReport
from ssad.core.wording import counted
from ssad.datasets.point_files import KITTI_COLUMNS, NUSCENES_COLUMNS

Kind = Literal["image", "points", "label", "other", "link", "refused"]
# folders whose images are labels: depth, disparity, flow and masks of KITTI, COCO, Cityscapes and Pascal VOC
_LABEL_FOLDER: Final = re.compile(
    r"annotations?|labels?(_.*)?|semantics?(_.*)?|instances?(_.*)?|panoptic(_.*)?|stuff.*|masks?|gt(fine|coarse|_.*)?|"
    r"disp(arity)?(_.*)?|flow_.*|viz_flow_.*|obj_map|depth(_.*)?|proj_depth|groundtruth|segmentation.*",
    re.IGNORECASE,
)
_POINT_FOLDER: Final = re.compile(r"(velodyne|lidar|points).*", re.IGNORECASE)
_MOMENT_FOLDER: Final = re.compile(r"image_\d+|velodyne(_points|_reduced)?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class FolderFile:
    """A file of a folder of pictures.

    Attributes:
        key: Path below the folder, with "/".
        path: Path of the file.
        kind: "image" (of any format, and videos), "points", "label" (an image in a folder of labels), "other", "link"
            (leads to another file or folder of the same folder) or "refused".
        target: Of a link, the key of what it leads to; of a refused file, the reason.
    """

    key: str
    path: Path
    kind: Kind
    target: str = ""

    @property
    def point_columns(self) -> int:
        """Numbers of a point in a .bin file: nuScenes names its sweeps .pcd.bin."""
        return NUSCENES_COLUMNS if self.key.lower().endswith(".pcd.bin") else KITTI_COLUMNS

    @property
    def moment(self) -> str:
        """Key of the moment: the cameras and the LiDAR of KITTI have files of one number side by side."""
        *folders, name = self.key.split("/")
        return "/".join([folder for folder in folders if not _MOMENT_FOLDER.fullmatch(folder)] + [name.split(".")[0]])


def list_folder(root: Path) -> list[FolderFile]:
    """Return every file below a folder, in the order of the keys.

    A symbolic link that stays inside the folder is not followed but listed as a link, so nothing is listed twice and
    no circle is walked. One that leads out of it is followed once where `SSAD_DATA_LINKS` allows it
    (`ssad.core.folders.is_linkable`), and refused elsewhere, as is one that leads nowhere.

    Args:
        root: The folder; links above it are the user's own.

    Raises:
        StoreError: A folder cannot be read.
    """
    resolved_root = root.resolve()
    files: list[FolderFile] = []
    folders, linked_folders = [resolved_root], set[Path]()
    while folders:
        folder = folders.pop()
        try:
            with os.scandir(folder) as iterator:
                entries = list(iterator)
        except OSError as error:
            raise StoreError(f"{folder}: cannot be read: {error.strerror or error}") from None
        for entry in entries:
            path = Path(entry.path)
            if entry.is_dir(follow_symlinks=False):
                folders.append(path)
                continue
            file = _describe(path, entry, resolved_root)
            if file.kind == "link" and not file.target:
                destination = path.resolve()
                if not any(destination.is_relative_to(folder) for folder in linked_folders):
                    linked_folders.add(destination)
                    folders.append(path)
                    continue
                file = replace(file, kind="refused", target="a symbolic link to a folder that is listed already")
            files.append(file)
    return sorted(files, key=lambda file: file.key)


def folder_report(root: Path) -> ImportReport:
    """Return a report on a folder of pictures: what is read, and files that are not.

    Raises:
        StoreError: A folder cannot be read.
    """
    report = ImportReport(str(root))
    files = list_folder(root)
    counts = Counter(file.kind for file in files)
    report.contents.append(f"{counted(counts['image'], 'picture')}, {counts['points']} point clouds")
    for file in files:
        if file.kind == "label":
            report.omit("pictures in folders of labels", file.key)
        elif file.kind == "other":
            report.omit(f"files that are neither pictures nor point clouds: {_suffix(file)}", file.key)
        elif file.kind == "link":
            report.note("links to files of the folder stand for these", file.key)
        elif file.kind == "refused":
            report.doubt(f"not read: {file.target}", file.key)
    return report


def _suffix(file: FolderFile) -> str:
    return file.path.suffix.lower()[:20] or "without a suffix"


def _describe(path: Path, entry: os.DirEntry[str], root: Path) -> FolderFile:
    key = path.relative_to(root).as_posix()
    if entry.is_symlink():
        destination = Path(os.path.realpath(path))
        if not destination.exists():
            return FolderFile(key, path, "refused", "a symbolic link that leads nowhere; remove it")
        if destination.is_relative_to(root):
            return FolderFile(key, path, "link", destination.relative_to(root).as_posix())
        if not is_linkable(destination):
            reason = f"a symbolic link that leads out of {root}; {link_remedy(destination)}"
            return FolderFile(key, path, "refused", reason)
        if destination.is_dir():
            return FolderFile(key, path, "link")
    if not entry.is_file():
        return FolderFile(key, path, "refused", "neither a file nor a folder; remove it")
    try:
        return FolderFile(key, path, _kind(path, key.split("/")[:-1]))
    except FormatError as error:
        return FolderFile(key, path, "refused", str(error).removeprefix(f"{path}: "))


def _kind(path: Path, folder_names: list[str]) -> Kind:
    suffix = path.suffix.lower()
    is_cloud = suffix in (".pcd", ".ply") or (
        suffix == ".bin"
        and (path.name.lower().endswith(".pcd.bin") or any(_POINT_FOLDER.fullmatch(name) for name in folder_names))
    )
    if is_cloud:
        return "points"
    if not is_image(path):
        return "other"
    return "label" if any(_LABEL_FOLDER.fullmatch(name) for name in folder_names) else "image"
