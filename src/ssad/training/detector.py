"""`ssad train detector`: from a recipe and data to weights with a card, on the CPU or local GPUs."""

from __future__ import annotations

import hashlib
import os
import shlex
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import distributed
from torch.multiprocessing.spawn import ProcessRaisedException, spawn

from ssad.core import errors, safeio
from ssad.core.checkpoints import WeightsCard, copy_matching_weights, hash_state, load_weights, save_weights
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.images import read_annotated_image
from ssad.core.import_report import ImportReport
from ssad.core.seeding import digest
from ssad.datasets.coco import CocoSet, read_coco
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors import make_detector
from ssad.detectors.on_scenes import score_2d, score_3d
from ssad.training.batches import ImageSet, TrainingImage, load_images
from ssad.training.data import nuscenes_items, photograph_items
from ssad.training.loop import LAST_CHECKPOINT, LOG, ProcessRank, read_last, read_rows, train, write_row
from ssad.training.recipe import Recipe, command_line_changes, find_recipe, recipe_data

Say = Callable[[str], None]
VAL_SCENES = 4  # scenes of a nuScenes data set for validation during training; the final validation uses all


@dataclass(frozen=True, slots=True)
class DetectorPlan:
    """Plan of a detector training.

    Attributes:
        recipe: Name of the recipe.
        data: Folders of data.
        out: Folder to write to.
        split: Split to train on.
        val: Split to validate on.
        changes: Changed values of the recipe.
        weights: Initial weights; None: random ones. Layers of another shape start at random.
        device: auto, cpu or cuda.
        gpus: Number of GPUs.
        seconds: Time limit, s; None: none.
        val_data: Another data set in the nuScenes schema to validate on.
    """

    recipe: str
    data: tuple[Path, ...]
    out: Path
    split: str = "train"
    val: str = "val"
    changes: tuple[tuple[str, Any], ...] = ()
    weights: Path | None = None
    device: str = "auto"
    gpus: int = 1
    seconds: float | None = None
    val_data: Path | None = None


def parse_changes(settings: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """Parse key=value pairs, values as YAML.

    Raises:
        ConfigError: A pair has no "=".
    """
    changes = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: expected key=value")
        parsed = safeio.parse_yaml(value, setting)
        changes.append((key.strip(), tuple(parsed) if isinstance(parsed, list) else parsed))
    return tuple(changes)


def coco_truth(data: CocoSet, *, target: bool = False) -> list[Truth]:
    """Return the truth of each image.

    Args:
        data: The set.
        target: Only the target object counts; all others become crowd.
    """
    return [
        Truth(
            torch.from_numpy(image.label.astype(np.int64)),
            torch.from_numpy(image.box.astype(np.float32)),
            crowd=torch.from_numpy(~image.target if target else image.crowd.copy()),
        )
        for image in data.images
    ]


def coco_items(
    folder: Path, split: str, report: ImportReport | None = None
) -> tuple[tuple[str, ...], list[TrainingImage]]:
    """Return classes and images of a split of recordings.

    Args:
        folder: The folder.
        split: Name of the split.
        report: Filled with what came in, what is not read, and what is doubtful.

    Raises:
        ConfigError: The split does not exist.
    """
    path = folder / "annotations" / f"{split}.json"
    if not path.is_file():
        raise ConfigError(f"{folder}: no annotations/{split}.json; record it with: ssad record {folder} --clips drive")
    data = read_coco(path, report=ImportReport(str(path)) if report is None else report)
    truths = coco_truth(data)
    return data.classes, [
        TrainingImage(partial(read_annotated_image, image.file, width=image.width, height=image.height), truth)
        for image, truth in zip(data.images, truths, strict=True)
    ]


def is_recording(folder: Path, split: str) -> bool:
    """Return whether SSAD recorded a folder, or its annotations have the layout of SSAD's recordings."""
    annotations = folder / "annotations"
    return (annotations / "all.json").is_file() or (annotations / f"{split}.json").is_file() or not folder.is_dir()


def flat_items(
    folder: Path, split: str, recipe: Recipe, report: ImportReport | None = None
) -> tuple[tuple[str, ...], list[TrainingImage]]:
    """Return classes and images of a split for 2D detectors: of recordings, or of photographs.

    Args:
        folder: The folder.
        split: Name of the split.
        recipe: The recipe, which says the size of photographs.
        report: Filled with what came in, what is not read, and what is doubtful.

    Raises:
        ConfigError: The split does not exist.
    """
    if is_recording(folder, split):
        return coco_items(folder, split, report)
    return photograph_items(folder, split, recipe.photo_size, report)


def learned_from(plan: DetectorPlan) -> str:
    """Return the kind of images that a training learns from, in words, for the card."""
    is_rendered = {
        folder: (folder / "annotations" / "all.json").is_file() or (folder / ".parts").is_dir() for folder in plan.data
    }
    rendered = ", ".join(folder.name for folder in plan.data if is_rendered[folder])
    other = ", ".join(folder.name for folder in plan.data if not is_rendered[folder])
    texts = [f"images that SSAD rendered ({rendered})"] if rendered else []
    texts += [f"other data ({other})" if other else "no photographs"]
    return "; ".join(texts)


def run_training(plan: DetectorPlan, *, report: Say = print) -> Iterator[str]:
    """Train a detector, and write OUT/NAME.safetensors with its card.

    Args:
        plan: Plan of the training.
        report: Called with progress messages.

    Yields:
        Lines about what was written.

    Raises:
        ConfigError: The plan does not fit the data or this machine.
        FormatError: Data, weights or the checkpoint are broken.
    """
    recipe = find_recipe(plan.recipe, **dict(plan.changes))
    device = _device(plan.device)
    if plan.gpus > 1:
        if device != "cuda" or torch.cuda.device_count() < plan.gpus:
            raise ConfigError(f"--gpus {plan.gpus}: this machine has {torch.cuda.device_count()} usable GPUs")
        safeio.make_folder(plan.out)
        with _rewrap_worker_errors():
            spawn(_worker, (plan, recipe, _free_port(), "nccl"), nprocs=plan.gpus)  # type: ignore[no-untyped-call]
    else:
        _run(plan, recipe, device, ProcessRank(), report)
    log_lines = safeio.read_text(plan.out / LOG).splitlines()
    yield (
        f"{plan.out / f'{recipe.detector}.safetensors'}: {len(log_lines)} epochs; card, {LOG} and curves.png beside it"
    )


@contextmanager
def _rewrap_worker_errors() -> Iterator[None]:
    """Re-raise an SSADError of a worker process, which arrives as the text of its traceback."""
    try:
        yield
    except ProcessRaisedException as error:
        last_line = str(error).strip().splitlines()[-1]
        qualified_name, _, text = last_line.partition(": ")
        module, _, name = qualified_name.rpartition(".")
        if module != errors.__name__ or not hasattr(errors, name):
            raise
        raise getattr(errors, name)(text) from None


def _device(requested: str) -> str:
    if requested not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device {requested}: expected auto, cpu or cuda")
    if requested == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda: no CUDA device is usable here (see: ssad doctor); use --device cpu")
    return "cuda" if requested != "cpu" and torch.cuda.is_available() else "cpu"


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def _worker(rank: int, plan: DetectorPlan, recipe: Recipe, port: int, backend: str) -> None:
    """Run the training in one of several processes."""
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    process_count = plan.gpus
    distributed.init_process_group(backend, rank=rank, world_size=process_count)
    try:
        device = f"cuda:{rank}" if backend == "nccl" else "cpu"
        if backend == "nccl":
            torch.cuda.set_device(rank)
        _run(plan, recipe, device, ProcessRank(rank, process_count), partial(print, flush=True))
    finally:
        distributed.destroy_process_group()


def _run(plan: DetectorPlan, recipe: Recipe, device: str, share: ProcessRank, report: Say) -> None:
    """Run data loading, training and validation. All settings are checked before images are read."""
    sources, options = _items(plan, recipe, report=report)
    detector = make_detector(recipe.detector, weights="random", device="cpu", **options | recipe.options)
    if plan.weights is not None:
        unmatched_weights = copy_matching_weights(detector, load_weights(plan.weights), str(plan.weights))
        if unmatched_weights:
            report(
                f"{plan.weights}: {len(unmatched_weights)} weights do not fit and start fresh: "
                f"{', '.join(unmatched_weights)}"
            )
    fingerprint = digest("training", share.world, hash_state(detector.state_dict()), _hash_items(sources))[:16]
    checkpoint = read_last(plan.out / LAST_CHECKPOINT, recipe, fingerprint)
    validate = _validation(plan, device, recipe)
    initial_weights = _weights_origin(plan.weights)
    weights = plan.out / f"{recipe.detector}.safetensors"
    completed, last_epoch = (
        (checkpoint["epoch"], recipe.last_epoch(checkpoint["epoch"], checkpoint["spent"], checkpoint["quickest"]))
        if checkpoint
        else (0, 1)
    )
    if completed >= last_epoch and _card_epochs(weights) == completed:
        report(f"all {completed} epochs are done, and {weights.name} is there")
        return
    del checkpoint
    # Equal shares: all processes must take the same number of steps.
    own_sources = sources[share.rank :: share.world][: len(sources) // share.world]
    report(f"{len(sources)} pictures to learn from, {sum(len(source.truth.label) for source in sources)} objects")
    trained = train(
        detector,
        load_images(own_sources, device=device),
        recipe,
        out=plan.out,
        device=device,
        validate=lambda candidate: validate(candidate, quick=True),
        report=report,
        share=share,
        seconds=plan.seconds,
        metadata=fingerprint,
    )
    if share.rank:
        return
    metrics = validate(trained, quick=False)
    row = read_rows(plan.out)[-1]
    write_row(plan.out, row | metrics)
    report("  ".join(f"{name} {value:.4f}" for name, value in metrics.items()))
    if row["epoch"] < row["of"]:
        report(f"stopped after {row['epoch']} of {row['of']} epochs; run it again to go on")
    folders = [*plan.data, *([plan.val_data] if plan.val_data else [])]
    card = WeightsCard(
        data="; ".join(map(describe_data, folders)),
        command=command_of(plan),
        seed=recipe.seed,
        metrics=metrics,
        classes=tuple(trained.classes),
        config=recipe_data(recipe) | {"epochs_done": row["epoch"]} | initial_weights,
        learned_from=learned_from(plan),
    )
    save_weights(weights, trained.state_dict(), card=card, half=True)
    draw_curves(plan.out)


def _weights_origin(weights: Path | None) -> dict[str, Any]:
    """Return the origin of the initial weights, recursively, from the card beside them.

    The file beside the weights may not be an SSAD card; missing entries are omitted.

    Raises:
        FormatError: The card is not JSON.
    """
    if weights is None:
        return {}
    path = weights.with_suffix(".json")
    card = safeio.read_json(path) if path.is_file() else {}
    card = card if isinstance(card, dict) else {}
    config = card["config"] if isinstance(card.get("config"), dict) else {}
    provenance = {name: card[name] for name in ("data", "command", "hash") if name in card}
    provenance |= {name: config[name] for name in ("epochs_done", "first_weights") if name in config}
    return {"first_weights": {"file": weights.name, **provenance}}


def _card_epochs(weights: Path) -> int:
    """Return the epochs in the card of weights; 0 without a card."""
    path = weights.with_suffix(".json")
    return int(safeio.read_json(path).get("config", {}).get("epochs_done", 0)) if path.is_file() else 0


def _items(plan: DetectorPlan, recipe: Recipe, *, report: Say = print) -> tuple[list[TrainingImage], dict[str, Any]]:
    """Pictures of all folders, and options of the detector. ConfigError: none, or options that do nothing."""
    options: dict[str, Any] = {}
    if not recipe.is_3d and plan.val_data is not None:
        raise ConfigError("--val-data is for 3D detectors; clips have a split of their own to validate on")
    if recipe.is_3d:
        sources = [source for folder in plan.data for source in nuscenes_items(folder, None, plan.split)]
    else:
        sources = []
        for folder in plan.data:
            account = ImportReport(str(folder))
            class_names, folder_items = flat_items(folder, plan.split, recipe, account)
            if account.omissions or account.doubts:
                report(account.text(f"data {folder}, split {plan.split}:"))
            if options and options["classes"] != class_names:
                raise ConfigError(f"{folder}: other classes than {plan.data[0]}")
            options["classes"] = class_names
            sources += folder_items
    if not sources:
        raise ConfigError(f"{', '.join(map(str, plan.data))}: no picture to learn from in the split '{plan.split}'")
    return sources, options


def _hash_items(items: Sequence[TrainingImage]) -> str:
    """Of what is to be learned: labels and boxes of all pictures, in their order."""
    digest_state = hashlib.sha256()
    for source in items:
        digest_state.update(source.truth.label.numpy().tobytes() + b"|" + source.truth.box.numpy().tobytes())
    return digest_state.hexdigest()


def describe_data(folder: Path) -> str:
    """Return the command that repeats a recording by SSAD, else the name of the folder."""
    coco_index = folder / "annotations" / "all.json"
    if coco_index.is_file():
        recording = safeio.read_json(coco_index, limit=1 << 30).get("info", {}).get("recording", {})
        if "clips" not in recording:
            return folder.name
        towns, counts = zip(*recording["images"], strict=True)
        arguments = ["--clips", recording["clips"], "--towns", ",".join(towns), "--images", ",".join(map(str, counts))]
        target = recording.get("target")
        # a car has style, paint and seed; a sign has kind, style and seed
        target_parts = (
            [str(target[target_key]) for target_key in ("kind", "style", "paint", "seed") if target_key in target]
            if target
            else []
        )
        arguments += ["--target", ":".join(target_parts)] if target_parts else []
    elif (folder / ".parts" / "recording.json").is_file():
        recording = safeio.read_json(folder / ".parts" / "recording.json")
        arguments = ["--towns", ",".join(recording["towns"]), "--scenes", str(recording["scenes"])]
        arguments += ["--seconds", f"{recording['seconds']:g}", "--width", str(recording["width"])]
    else:
        return folder.name
    arguments += ["--streets", recording["streets"]] if recording.get("streets", "town") != "town" else []
    arguments += ["--device", recording["device"]] if recording.get("device", "cpu") != "cpu" else []
    held_out = ",".join(recording["held_out"])
    arguments += ["--held-out", held_out or '""', *(["--seed", str(recording["seed"])] if recording["seed"] else [])]
    return " ".join(["ssad record", folder.name, *arguments])


def command_of(plan: DetectorPlan) -> str:
    """Return the command that repeats the training, with the names of the folders."""
    arguments = ["ssad", "train", "detector", plan.recipe, "--data", plan.data[0].name]
    for folder in plan.data[1:]:
        arguments += ["--more", folder.name]
    for option, value, default_value in (
        ("--val-data", plan.val_data and plan.val_data.name, None),
        ("--split", plan.split, "train"),
        ("--val", plan.val, "val"),
        ("--weights", plan.weights and plan.weights.name, None),
        ("--gpus", plan.gpus, 1),
        ("--seconds", plan.seconds, None),
    ):
        arguments += [option, str(value)] if value != default_value else []
    return shlex.join([*arguments, *command_line_changes(plan.changes)])


def _validation(plan: DetectorPlan, device: str, recipe: Recipe) -> Callable[..., dict[str, float]]:
    """Metrics of a detector on the validation split."""
    if recipe.is_3d:
        root = plan.val_data or plan.data[0]
        with NuScenes(root) as dataset:
            version = dataset.version
            scenes = scenes_of(dataset, plan.val)
        quick_scenes = scenes[:: max(len(scenes) // VAL_SCENES, 1)][:VAL_SCENES]

        def check_3d(detector: Any, *, quick: bool) -> dict[str, float]:
            return score_3d(detector, root, version, quick_scenes if quick else scenes, device=device)

        return check_3d
    if len({folder.name for folder in plan.data}) < len(plan.data):
        raise ConfigError("two folders of data have the same name, and metrics are named by it; rename one")
    items_by_folder = {folder: flat_items(folder, _val_split(plan, folder), recipe) for folder in plan.data}
    for folder, (_, folder_items) in items_by_folder.items():
        if not folder_items:
            raise ConfigError(f"{folder}: no picture to validate on in annotations/{_val_split(plan, folder)}.json")
    images_by_folder: dict[str, ImageSet] = {}

    def check_2d(detector: Any, *, quick: bool) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for folder in plan.data:
            class_names, folder_items = items_by_folder[folder]
            if folder.name not in images_by_folder:
                images_by_folder[folder.name] = load_images(folder_items, device=device)
            image_set = images_by_folder[folder.name]
            scores = score_2d(detector, image_set, classes=class_names, device=device)
            metrics |= {f"{folder.name}_{name}": value for name, value in scores.items()}
            path = folder / "annotations" / f"{_val_split(plan, folder)}.json"
            if not path.is_file():  # photographs have no target
                continue
            coco_set = read_coco(path, report=ImportReport(str(path)))
            target_set = ImageSet(image_set.pictures, tuple(coco_truth(coco_set, target=True)))
            metrics[f"{folder.name}_target_AP50"] = score_2d(
                detector, target_set, classes=coco_set.classes, device=device
            )["AP50"]
        return metrics

    return check_2d


def _val_split(plan: DetectorPlan, folder: Path) -> str:
    """Return the split of a folder to validate on: recordings call that of the default test."""
    return "test" if plan.val == "val" and is_recording(folder, "test") else plan.val


def draw_curves(out: Path) -> None:
    """Draw OUT/curves.png: losses and metrics over epochs."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    rows = [safeio.parse_json(line) for line in safeio.read_text(out / LOG).splitlines()]
    figure, (loss_axes, metric_axes) = pyplot.subplots(1, 2, figsize=(11, 4))
    for name in rows[0]:
        if name.startswith("loss_"):
            loss_axes.plot([row["epoch"] for row in rows], [row[name] for row in rows], label=name[5:])
    names = sorted({column for row in rows for column in row if column.split("_")[-1] in ("mAP", "NDS", "AP50", "car")})
    for name in names:
        points = [(row["epoch"], row[name]) for row in rows if name in row]
        metric_axes.plot(*zip(*points, strict=True), marker="o", label=name)
    loss_axes.set(xlabel="epoch", ylabel="loss", yscale="log")
    metric_axes.set(xlabel="epoch", ylabel="validation", ylim=(0, 1))
    loss_axes.legend(fontsize=7)
    if names:
        metric_axes.legend(fontsize=7)
    figure.tight_layout()
    with safeio.atomic_path(out / "curves.png") as path:
        figure.savefig(path, dpi=110, format="png")
    pyplot.close(figure)
