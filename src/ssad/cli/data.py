"""Commands on data sets: shift, score, record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ssad.cli import paths
from ssad.cli.options import Ray, Workers
from ssad.core.errors import ConfigError
from ssad.core.wording import counted


def shift(
    source: Annotated[
        Path, typer.Argument(metavar="DATAROOT", help="nuScenes folder, folder of pictures, or an image file.")
    ],
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="Folder for the shifted nuScenes roots, or FILE.png for a contact sheet."),
    ],
    shifts: Annotated[
        str, typer.Option(help="Comma-separated names (ssad list shifts), or all: the paper's 11.")
    ] = "all",
    severity: Annotated[str, typer.Option(help="Comma-separated severities from 1 to 5, or random.")] = "random",
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    calibration: Annotated[
        str, typer.Option(help="physical: severities in units. paper: the published severities, image by image.")
    ] = "physical",
    labels: Annotated[
        str, typer.Option(help="Boxes in the annotation table: original, or transformed with the objects.")
    ] = "original",
    version: Annotated[
        str | None, typer.Option(help="Dataset version, such as v1.0-mini.  [default: the only one in DATAROOT]")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only the scenes of this split, such as mini_val.")] = None,
    scenes: Annotated[
        str, typer.Option(help="Only these scenes, comma-separated. A contact sheet shows one scene.")
    ] = "",
    sweeps: Annotated[bool, typer.Option(help="Also shift the frames between keyframes.")] = True,
    lidar: Annotated[bool, typer.Option(help="Also shift the LiDAR points.")] = True,
    quality: Annotated[int, typer.Option(min=1, max=100, help="JPEG quality.")] = 95,
    subsampling: Annotated[
        str, typer.Option(help="JPEG chroma subsampling: auto (444 for sensor noise, else 420), 444, 422 or 420.")
    ] = "auto",
    workers: Workers = None,
    ray: Ray = None,
    channel: Annotated[str, typer.Option(help="Camera that a contact sheet shows.")] = "CAM_FRONT",
    box: Annotated[
        list[str] | None,
        typer.Option(metavar="X0,Y0,X1,Y1", help="2D box of an object in the image file, pixels; can be repeated."),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Write nothing; compare every file in OUT with the manifests.")
    ] = False,
) -> None:
    """Apply distribution shifts to a nuScenes folder (nuScenes-N), or to one image as a contact sheet.

    In any other folder, such as KITTI's or COCO's, each picture is shifted by itself (docs/how-to/shift-data.md).

    To resume, repeat the command. Exit code 1: some files failed, or --verify found files that differ.
    """
    is_sheet = source.is_file() or out.suffix.lower() in (".png", ".jpg", ".jpeg")
    if not verify:
        paths.check_exists(source)
        if not (is_sheet or source.resolve() in (out.resolve(), *out.resolve().parents)):
            paths.check_out(out, paths.SHIFTED, option="OUT")
    from ssad.cli.shift import shift_folder, shift_picture_folder, verify_folder, write_contact_sheets

    if verify:
        raise typer.Exit(verify_folder(out))
    names = [name.strip() for name in shifts.split(",") if name.strip()]
    scene_names = [name.strip() for name in scenes.split(",") if name.strip()]
    if is_sheet:
        write_contact_sheets(
            source,
            out,
            shifts=names,
            version=version,
            channel=channel,
            split=split,
            scenes=scene_names,
            boxes=box or [],
            severity=severity,
            seed=seed,
            calibration=calibration,
        )
        return
    if source.is_dir() and not any(source.glob("*/sample_data.json")):
        for name, option_value in (("--version", version), ("--split", split), ("--scenes", scenes)):
            if option_value:
                raise ConfigError(f"{name} is for a nuScenes folder; {source} has no VERSION/sample_data.json")
        raise typer.Exit(
            shift_picture_folder(
                source,
                out,
                shifts=names,
                severity=severity,
                workers=workers,
                ray=ray,
                settings={
                    "seed": seed,
                    "calibration": calibration,
                    "quality": quality,
                    "subsampling": subsampling,
                    "lidar": lidar,
                },
            )
        )
    code = shift_folder(
        source,
        out,
        shifts=names,
        severity=severity,
        version=version,
        split=split,
        scenes=scene_names,
        workers=workers,
        ray=ray,
        settings={
            "seed": seed,
            "calibration": calibration,
            "labels": labels,
            "sweeps": sweeps,
            "lidar": lidar,
            "quality": quality,
            "subsampling": subsampling,
        },
    )
    raise typer.Exit(code)


def score(
    results: Annotated[Path, typer.Argument(metavar="RESULTS.json", help="Detections in the nuScenes results format.")],
    dataroot: Annotated[Path, typer.Option(help="nuScenes or nuScenes-N folder.")],
    version: Annotated[str, typer.Option(help="Dataset version, such as v1.0-trainval.")],
    split: Annotated[str, typer.Option(help="val, mini_val, or a split that the folder's splits.json defines.")],
    file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write all numbers to this file.")
    ] = None,
    intervals: Annotated[int, typer.Option(min=0, help="Bootstrap replicates for 95 % intervals; 0: none.")] = 0,
) -> None:
    """Compute mAP, NDS and the true-positive errors of the official nuScenes evaluation.

    A shifted folder is first checked against its manifest, so that clean data cannot be scored as shifted.
    """
    paths.check_exists(dataroot / version, results)
    from rich.console import Console

    from ssad.cli.shift import checked
    from ssad.datasets.nuscenes.score import score_results, tables, write_summary

    scores = score_results(
        results, dataroot=dataroot, version=version, split=split, replicates=intervals, check=checked(dataroot)
    )
    if file is not None:
        write_summary(file, scores)
    console = Console()
    for table in tables(scores):
        console.print(table)


def record(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the dataset.")],
    towns: Annotated[
        str, typer.Option(help="Comma-separated towns (see: ssad list towns; also Random0, Random1, ...).")
    ] = "Twinford,Crossgate,Oldmarket,Larkhill",
    held_out: Annotated[str, typer.Option(help="Towns of the split val; all others are train.")] = "Oldmarket,Larkhill",
    scenes: Annotated[int, typer.Option(min=1, help="Scenes per town.")] = 2,
    seconds: Annotated[float, typer.Option(min=0.5, max=3600, help="Length of a scene, s.")] = 20.0,
    width: Annotated[int, typer.Option(min=64, help="Image width in pixels (16:9).")] = 1600,
    sweeps: Annotated[int, typer.Option(min=0, max=4, help="Frames between two keyframes.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    clips: Annotated[
        str | None,
        typer.Option(help="Record images of one target car with COCO annotations instead: drive or orbit."),
    ] = None,
    streets: Annotated[
        str, typer.Option(help="town: the town's own buildings. any: new ones for each drive, for training data.")
    ] = "town",
    images: Annotated[
        str, typer.Option(help="With --clips: images per town, one number for each town or one for all.")
    ] = "600,400,400,400",
    target: Annotated[
        str | None,
        typer.Option(
            help="With --clips: the target car, STYLE[:PAINT[:SEED]]; with orbit also stop_sign[:STYLE[:SEED]].  "
            "[default: another car in each part]"
        ),
    ] = None,
    randomise: Annotated[
        str,
        typer.Option(
            metavar="none|all|NAME,...|FILE.yaml",
            help="For training data: vary paint, dirt, cameras, colours, noise and compression.",
        ),
    ] = "none",
    effects: Annotated[
        str,
        typer.Option(
            metavar="default|all|none|NAME,...",
            help="Effects of the rendering. Only lit-signals was on in earlier versions.",
        ),
    ] = "default",
    device: Annotated[str, typer.Option(help="Where to render: auto, cpu or cuda.")] = "cpu",
    workers: Workers = None,
    ray: Ray = None,
) -> None:
    """Record drives with the nuScenes sensors as a dataset in the nuScenes schema. To resume, repeat the command."""
    paths.check_out(out, paths.RECORDING, option="OUT")
    from rich.console import Console

    from ssad.core.machine import pick_device
    from ssad.engine.progress import LiveProgress
    from ssad.recorders.nuscenes import Recording, record_nuscenes
    from ssad.recorders.randomisation import parse_randomisation
    from ssad.rendering.camera.effects import select_effects

    def names(text: str) -> tuple[str, ...]:
        return tuple(name.strip() for name in text.split(",") if name.strip())

    unusable = ("scenes", "seconds", "width", "sweeps") if clips is not None else ("images", "target")
    for name in unusable:
        # Defaults cannot be told from given values otherwise: only an option on the command line is an error.
        parameter_source = context.get_parameter_source(name)
        if parameter_source is not None and parameter_source.name == "COMMANDLINE":
            raise ConfigError(f"--{name} {'cannot be used' if clips is not None else 'can only be used'} with --clips")
    randomisation, shown_effects = parse_randomisation(randomise), select_effects(*names(effects))
    unit = "parts" if clips is not None else "scenes"
    with LiveProgress("record", 1, 0, console=Console(stderr=True), unit=unit) as progress:
        if clips is not None:
            from ssad.recorders.target_images import record_target_images
            from ssad.recorders.target_recording import TargetRecording, pair_images
            from ssad.rendering.target import parse_target

            images_per_town = pair_images(names(towns), names(images))
            target_recording = TargetRecording(
                out,
                images_per_town,
                names(held_out),
                clips,  # type: ignore[arg-type]
                target=parse_target(target) if target else None,
                seed=seed,
                device=pick_device(device),
                streets=streets,
                randomisation=randomisation,
                effects=shown_effects,
            )
            record_target_images(target_recording, workers=workers, ray=ray, progress=progress.show)
            message = (
                f"{out}: {counted(sum(image_count for _, image_count in images_per_town), 'image')}, "
                f"annotations train.json, test.json and all.json"
            )
        else:
            recording = Recording(
                out,
                names(towns),
                names(held_out),
                scenes=scenes,
                seconds=seconds,
                width=width,
                sweeps=sweeps,
                seed=seed,
                device=pick_device(device),
                streets=streets,
                randomisation=randomisation,
                effects=shown_effects,
            )
            record_nuscenes(recording, workers=workers, ray=ray, progress=progress.show)
            scene_count = counted(len(recording.towns) * scenes, "scene")
            message = f"{out}: {scene_count}, version {recording.version}, splits train and val"
    print(message)
