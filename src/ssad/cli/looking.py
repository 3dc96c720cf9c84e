"""Commands to look at data with: detect and show."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ssad.cli import paths
from ssad.cli.importing import show_report
from ssad.cli.options import Device
from ssad.core.errors import ConfigError
from ssad.core.wording import counted


def detect(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="PICTURE...|FOLDER", help="Image files, or a folder: of the nuScenes schema, or of pictures."
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Output folder.")],
    detector: Annotated[
        str | None,
        typer.Option(
            help="Name, onnx:FILE or module:object (see: ssad list detectors).  [default: yolov5n, or fcos3d-light]"
        ),
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="File of weights.  [default: the shipped ones]")] = None,
    threshold: Annotated[float, typer.Option(min=0.0, max=1.0, help="Least score of a box that is drawn.")] = 0.3,
    focal: Annotated[
        float | None, typer.Option(min=1.0, help="3D detectors: focal length of PICTURE, pixels.  [default: assumed]")
    ] = None,
    version: Annotated[str | None, typer.Option(help="DATAROOT: version.  [default: the only one]")] = None,
    split: Annotated[str | None, typer.Option(help="DATAROOT: only the scenes of this split.  [default: all]")] = None,
    device: Device = "auto",
) -> None:
    """Find objects: boxes drawn into OUT/PICTURE.jpg, listed in OUT/detections.json; of a folder: OUT/results.json.

    OUT/results.json is the results file of the official nuScenes detection task, which `ssad score` reads too.
    """
    paths.check_exists(*sources, weights)
    paths.check_out(out, paths.DETECTIONS, option="OUT")
    from rich.console import Console

    from ssad.core.machine import pick_device
    from ssad.datasets.picture_folders import list_folder
    from ssad.detectors import make_detector
    from ssad.detectors.detect import detect_dataset, detect_images, is_dataset
    from ssad.engine.progress import LiveProgress

    folders = [source for source in sources if is_dataset(source)]
    if folders and len(sources) > 1:
        raise ConfigError(f"{folders[0]}: give one nuScenes folder, or pictures, not both")
    directory = next((source for source in sources if source.is_dir()), None)
    files, refusals, picture_root = list(sources), list[str](), None
    if directory is not None and not folders:
        if len(sources) > 1:
            raise ConfigError(f"{directory}: give one folder, or pictures, not both")
        listing = list_folder(directory)
        files, picture_root = [file.path for file in listing if file.kind == "image"], directory.resolve()
        refusals = [f"{file.key}: {file.target}" for file in listing if file.kind == "refused"]
        if not files:
            raise ConfigError(f"{directory}: no nuScenes folder (no VERSION/sample_data.json), and no picture in it")
    unusable = {"--focal": focal} if folders else {"--version": version, "--split": split}
    for name, value in unusable.items():
        if value is not None:
            raise ConfigError(f"{name} cannot be used with {'a nuScenes folder' if folders else 'pictures'}")
    compute_device = pick_device(device)
    network = make_detector(
        detector or ("fcos3d-light" if folders else "yolov5n"), weights=weights, device=compute_device
    )
    if not folders:
        pictures = detect_images(
            network, files, out, root=picture_root, threshold=threshold, focal=focal, device=compute_device
        )
        for picture in pictures:
            if picture.problem:
                refusals.append(picture.problem)
            else:
                print("; ".join([f"{picture.path}: {counted(picture.count, 'box')}", *picture.notes]))
        print(f"boxes: {out / 'detections.json'}")
        for refusal in refusals:
            print(f"not read: {refusal}")
        if refusals:
            raise typer.Exit(1)
        return
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.recorders.shifted.manifest import manifest_digest, read_manifest

    root = folders[0]
    manifest = "clean" if read_manifest(root) is None else manifest_digest(root)
    with (
        NuScenes(root, version) as data,
        LiveProgress("detect", 1, 0, console=Console(stderr=True), unit="scenes") as progress,
    ):
        path, samples, boxes = detect_dataset(
            network, data, out, split=split, manifest=manifest, device=compute_device, progress=progress.show
        )
        version = data.version
    print(f"{path}: {boxes} boxes in {samples} samples")
    print(f"to score it: ssad score {path} --dataroot {root} --version {version} --split {split or 'SPLIT'}")


def show(
    root: Annotated[
        Path, typer.Argument(metavar="FOLDER|PICTURE", help="nuScenes or nuScenes-N folder, or pictures of any layout.")
    ],
    out: Annotated[Path, typer.Argument(metavar="[OUT]", help="Folder for index.html and its pictures.")] = Path(
        "show"
    ),
    version: Annotated[str | None, typer.Option(help="Version.  [default: the only one in DATAROOT]")] = None,
    scenes: Annotated[str, typer.Option(help="Only these scenes, comma-separated.  [default: the first ten]")] = "",
    samples: Annotated[int, typer.Option(min=1, help="Moments of each scene, spread over it.")] = 3,
) -> None:
    """Write a page to look at a data set: pictures with their boxes, and the LiDAR from above; name what is not read.

    Of pictures that are no nuScenes folder, the page shows each upright. Exit code 1: some cannot be read.
    """
    paths.check_exists(root)
    paths.check_out(out, paths.PAGE, option="OUT")
    from rich.console import Console

    from ssad.datasets.browse import check_scenes, write_page
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.datasets.picture_folders import folder_report
    from ssad.datasets.picture_page import pictures_of, write_picture_page
    from ssad.engine.progress import LiveProgress

    is_plain = root.is_file() or (root.is_dir() and not any(root.glob("*/sample_data.json")))
    if is_plain and version is None and (files := pictures_of(root)):
        if scenes:
            raise ConfigError(f"--scenes is for a nuScenes folder; {root} has no VERSION/sample_data.json")
        with LiveProgress("show", 1, 0, console=Console(stderr=True), unit="pictures") as progress:
            picture_page = write_picture_page(root.resolve().name, files, out, progress=progress.show)
        first_line = (
            f"page: {picture_page.path} ({picture_page.shown} of {picture_page.total} pictures and point clouds)"
        )
        if root.is_dir():
            show_report(folder_report(root), first_line, picture_page.path)
        else:
            print(first_line)
        for problem in picture_page.problems:
            print(f"not read: {problem}")
        if picture_page.problems:
            raise typer.Exit(1)
        return
    names = [name.strip() for name in scenes.split(",") if name.strip()]
    with NuScenes(root, version) as data:
        check_scenes(data, names)
        with LiveProgress("show", 1, 0, console=Console(stderr=True), unit="scenes") as progress:
            page = write_page(data, out, scenes=names, moments=samples, progress=progress.show)
        report = data.report()
    show_report(report, f"page: {page}", page)
