"""`ssad train detector`: from a recipe and a data set to weights with a card, on the CPU or on GPUs of this machine."""

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
from ssad.core.checkpoints import Card, hash_state, load_weights, save_weights, start_from
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.images import read_image
from ssad.core.seeding import digest
from ssad.datasets.coco import CocoSet, read_coco
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors import make_detector
from ssad.detectors.on_scenes import score_2d, score_3d
from ssad.training.batches import Item, PictureSet, fill
from ssad.training.data import nuscenes_items
from ssad.training.loop import LAST, LOG, Share, read_last, read_rows, train, write_row
from ssad.training.recipe import Recipe, find_recipe, recipe_data, set_words

Say = Callable[[str], None]
VAL_SCENES = 4  # of a data set in the nuScenes schema, while training; at the end all are used


@dataclass(frozen=True, slots=True)
class Plan:
    """A training run.

    Attributes:
        recipe: Name of the recipe.
        data: Folders of data.
        out: Folder to write to.
        split: Split to train on.
        val: Split to validate on.
        changes: Changed values of the recipe.
        weights: First weights; None: fresh ones. Layers of another shape start fresh.
        device: auto, cpu or cuda.
        gpus: How many GPUs to train on.
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


def parse_changes(texts: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """Names and values from key=value pairs, values as YAML.

    Raises:
        ConfigError: A pair has no "=".
    """
    found = []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: expected key=value")
        parsed = safeio.parse_yaml(value, text)
        found.append((key.strip(), tuple(parsed) if isinstance(parsed, list) else parsed))
    return tuple(found)


def coco_truth(data: CocoSet, *, target: bool = False) -> list[Truth]:
    """The truth of each picture.

    Args:
        data: The set.
        target: Whether only the object that the set is about counts; all others are then crowd.
    """
    return [
        Truth(
            torch.from_numpy(image.label.astype(np.int64)),
            torch.from_numpy(image.box.astype(np.float32)),
            crowd=torch.from_numpy(~image.target if target else image.crowd.copy()),
        )
        for image in data.images
    ]


def coco_items(folder: Path, split: str) -> tuple[tuple[str, ...], list[Item]]:
    """Classes and pictures of a split of clips.

    Raises:
        ConfigError: There is no such split.
    """
    path = folder / "annotations" / f"{split}.json"
    if not path.is_file():
        raise ConfigError(f"{folder}: no annotations/{split}.json; record it with: ssad record {folder} --clips drive")
    data = read_coco(path)
    truths = coco_truth(data)
    return data.classes, [
        Item(partial(read_image, image.file), truth) for image, truth in zip(data.images, truths, strict=True)
    ]


def run_training(plan: Plan, *, say: Say = print) -> Iterator[str]:
    """Train a detector, and write OUT/NAME.safetensors with its card.

    Args:
        plan: What to train.
        say: Called with a line about progress.

    Yields:
        Lines about what was written.

    Raises:
        ConfigError: The plan does not fit the data or this machine.
        FormatError: Data, weights or an interrupted training are broken.
    """
    recipe = find_recipe(plan.recipe, **dict(plan.changes))
    device = _device(plan.device)
    if plan.gpus > 1:
        if device != "cuda" or torch.cuda.device_count() < plan.gpus:
            raise ConfigError(f"--gpus {plan.gpus}: this machine has {torch.cuda.device_count()} usable GPUs")
        safeio.make_folder(plan.out)
        with _one_line():
            spawn(_worker, (plan, recipe, _free_port(), "nccl"), nprocs=plan.gpus)  # type: ignore[no-untyped-call]
    else:
        _run(plan, recipe, device, Share(), say)
    log = safeio.read_text(plan.out / LOG).splitlines()
    yield f"{plan.out / f'{recipe.detector}.safetensors'}: {len(log)} epochs; card, {LOG} and curves.png beside it"


@contextmanager
def _one_line() -> Iterator[None]:
    """The SSADError of a process, which comes as the text of its traceback, as what it was."""
    try:
        yield
    except ProcessRaisedException as error:
        last = str(error).strip().splitlines()[-1]
        kind, _, text = last.partition(": ")
        module, _, name = kind.rpartition(".")
        if module != errors.__name__ or not hasattr(errors, name):
            raise
        raise getattr(errors, name)(text) from None


def _device(wanted: str) -> str:
    if wanted not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device {wanted}: expected auto, cpu or cuda")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda: no CUDA device is usable here (see: ssad doctor); use --device cpu")
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _worker(rank: int, plan: Plan, recipe: Recipe, port: int, backend: str) -> None:
    """One of several processes."""
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    world = plan.gpus
    distributed.init_process_group(backend, rank=rank, world_size=world)
    try:
        device = f"cuda:{rank}" if backend == "nccl" else "cpu"
        if backend == "nccl":
            torch.cuda.set_device(rank)
        _run(plan, recipe, device, Share(rank, world), partial(print, flush=True))
    finally:
        distributed.destroy_process_group()


def _run(plan: Plan, recipe: Recipe, device: str, share: Share, say: Say) -> None:
    """Data, detector, training, weights. What can be wrong is looked at before pictures are read."""
    items, options = _items(plan, three=recipe.three)
    detector = make_detector(recipe.detector, weights="random", device="cpu", **options | recipe.options)
    if plan.weights is not None:
        fresh = start_from(detector, load_weights(plan.weights), str(plan.weights))
        if fresh:
            say(f"{plan.weights}: {len(fresh)} weights do not fit and start fresh: {', '.join(fresh)}")
    about = digest("training", share.world, hash_state(detector.state_dict()), _hash_items(items))[:16]
    last = read_last(plan.out / LAST, recipe, about)
    validate = _validation(plan, device, three=recipe.three)
    before = _before(plan.weights)
    weights = plan.out / f"{recipe.detector}.safetensors"
    done, ends = (last["epoch"], recipe.last_epoch(last["epoch"], last["spent"], last["quickest"])) if last else (0, 1)
    if done >= ends and _card_epochs(weights) == done:
        say(f"all {done} epochs are done, and {weights.name} is there")
        return
    del last
    mine = items[share.rank :: share.world][: len(items) // share.world]
    say(f"{len(items)} pictures to learn from, {sum(len(i.truth.label) for i in items)} objects")
    final = train(
        detector,
        fill(mine, device=device),
        recipe,
        out=plan.out,
        device=device,
        validate=lambda d: validate(d, quick=True),
        say=say,
        share=share,
        seconds=plan.seconds,
        about=about,
    )
    if share.rank:
        return
    metrics = validate(final, quick=False)
    row = read_rows(plan.out)[-1]
    write_row(plan.out, row | metrics)
    say("  ".join(f"{name} {value:.4f}" for name, value in metrics.items()))
    if row["epoch"] < row["of"]:
        say(f"stopped after {row['epoch']} of {row['of']} epochs; run it again to go on")
    folders = [*plan.data, *([plan.val_data] if plan.val_data else [])]
    card = Card(
        data="; ".join(map(describe_data, folders)),
        command=command_of(plan),
        seed=recipe.seed,
        metrics=metrics,
        classes=tuple(final.classes),
        config=recipe_data(recipe) | {"epochs_done": row["epoch"]} | before,
    )
    save_weights(weights, final.state_dict(), card=card, half=True)
    draw_curves(plan.out)


def _before(weights: Path | None) -> dict[str, Any]:
    """How the first weights were made, and what they were made from in turn, by the card beside them.

    The file beside the weights may not be a card of ours; what it lacks is left out.

    Raises:
        FormatError: The card is not JSON.
    """
    if weights is None:
        return {}
    path = weights.with_suffix(".json")
    card = safeio.read_json(path) if path.is_file() else {}
    card = card if isinstance(card, dict) else {}
    config = card["config"] if isinstance(card.get("config"), dict) else {}
    about = {name: card[name] for name in ("data", "command", "hash") if name in card}
    about |= {name: config[name] for name in ("epochs_done", "first_weights") if name in config}
    return {"first_weights": {"file": weights.name, **about}}


def _card_epochs(weights: Path) -> int:
    """Epochs that the card of weights tells of; 0 without a card."""
    path = weights.with_suffix(".json")
    return int(safeio.read_json(path).get("config", {}).get("epochs_done", 0)) if path.is_file() else 0


def _items(plan: Plan, *, three: bool) -> tuple[list[Item], dict[str, Any]]:
    """Pictures of all folders, and options of the detector. ConfigError: none, or options that do nothing."""
    options: dict[str, Any] = {}
    if not three and plan.val_data is not None:
        raise ConfigError("--val-data is for 3D detectors; clips have a split of their own to validate on")
    if three:
        items = [item for folder in plan.data for item in nuscenes_items(folder, None, plan.split)]
    else:
        items = []
        for folder in plan.data:
            names, found = coco_items(folder, plan.split)
            if options and options["classes"] != names:
                raise ConfigError(f"{folder}: other classes than {plan.data[0]}")
            options["classes"] = names
            items += found
    if not items:
        raise ConfigError(f"{', '.join(map(str, plan.data))}: no picture to learn from in the split '{plan.split}'")
    return items, options


def _hash_items(items: Sequence[Item]) -> str:
    """Of what is to be learned: labels and boxes of all pictures, in their order."""
    whole = hashlib.sha256()
    for item in items:
        whole.update(item.truth.label.numpy().tobytes() + b"|" + item.truth.box.numpy().tobytes())
    return whole.hexdigest()


def describe_data(folder: Path) -> str:
    """The command that records a folder anew, for data that SSAD recorded; else the folder's name."""
    clips = folder / "annotations" / "all.json"
    if clips.is_file():
        about = safeio.read_json(clips, limit=1 << 30).get("info", {}).get("recording", {})
        if "clips" not in about:
            return folder.name
        towns, counts = zip(*about["images"], strict=True)
        words = ["--clips", about["clips"], "--towns", ",".join(towns), "--images", ",".join(map(str, counts))]
        target = about.get("target")
        # of a car style, paint and seed, of a sign kind, style and seed
        named = [str(target[key]) for key in ("kind", "style", "paint", "seed") if key in target] if target else []
        words += ["--target", ":".join(named)] if named else []
    elif (folder / ".parts" / "recording.json").is_file():
        about = safeio.read_json(folder / ".parts" / "recording.json")
        words = ["--towns", ",".join(about["towns"]), "--scenes", str(about["scenes"])]
        words += ["--seconds", f"{about['seconds']:g}", "--width", str(about["width"])]
    else:
        return folder.name
    words += ["--streets", about["streets"]] if about.get("streets", "town") != "town" else []
    words += ["--device", about["device"]] if about.get("device", "cpu") != "cpu" else []
    held = ",".join(about["held_out"])
    words += ["--held-out", held or '""', *(["--seed", str(about["seed"])] if about["seed"] else [])]
    return " ".join(["ssad record", folder.name, *words])


def command_of(plan: Plan) -> str:
    """The command that trains this anew, with the names of the folders."""
    words = ["ssad", "train", "detector", plan.recipe, "--data", plan.data[0].name]
    for folder in plan.data[1:]:
        words += ["--more", folder.name]
    for option, value, usual in (
        ("--val-data", plan.val_data and plan.val_data.name, None),
        ("--split", plan.split, "train"),
        ("--val", plan.val, "val"),
        ("--weights", plan.weights and plan.weights.name, None),
        ("--gpus", plan.gpus, 1),
        ("--seconds", plan.seconds, None),
    ):
        words += [option, str(value)] if value != usual else []
    return shlex.join([*words, *set_words(plan.changes)])


def _validation(plan: Plan, device: str, *, three: bool) -> Callable[..., dict[str, float]]:
    """Metrics of a detector on the validation split."""
    if three:
        root = plan.val_data or plan.data[0]
        with NuScenes(root) as data:
            version = data.version
            scenes = scenes_of(data, plan.val)
        few = scenes[:: max(len(scenes) // VAL_SCENES, 1)][:VAL_SCENES]

        def check_3d(detector: Any, *, quick: bool) -> dict[str, float]:
            return score_3d(detector, root, version, few if quick else scenes, device=device)

        return check_3d
    split = "test" if plan.val == "val" else plan.val
    if len({folder.name for folder in plan.data}) < len(plan.data):
        raise ConfigError("two folders of data have the same name, and metrics are named by it; rename one")
    for folder in plan.data:
        if not coco_items(folder, split)[1]:
            raise ConfigError(f"{folder}: no picture to validate on in annotations/{split}.json")
    banks: dict[str, PictureSet] = {}

    def check_2d(detector: Any, *, quick: bool) -> dict[str, float]:
        found: dict[str, float] = {}
        for folder in plan.data:
            if folder.name not in banks:
                banks[folder.name] = fill(coco_items(folder, split)[1], device=device)
            bank = banks[folder.name]
            data = read_coco(folder / "annotations" / f"{split}.json")
            scores = score_2d(detector, bank, classes=data.classes, device=device)
            found |= {f"{folder.name}_{name}": value for name, value in scores.items()}
            aimed = PictureSet(bank.pictures, tuple(coco_truth(data, target=True)))
            found[f"{folder.name}_target_AP50"] = score_2d(detector, aimed, classes=data.classes, device=device)["AP50"]
        return found

    return check_2d


def draw_curves(out: Path) -> None:
    """OUT/curves.png: losses and metrics over epochs."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    rows = [safeio.parse_json(line) for line in safeio.read_text(out / LOG).splitlines()]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4))
    for name in rows[0]:
        if name.startswith("loss_"):
            left.plot([r["epoch"] for r in rows], [r[name] for r in rows], label=name[5:])
    names = sorted({n for r in rows for n in r if n.split("_")[-1] in ("mAP", "NDS", "AP50", "car")})
    for name in names:
        points = [(r["epoch"], r[name]) for r in rows if name in r]
        right.plot(*zip(*points, strict=True), marker="o", label=name)
    left.set(xlabel="epoch", ylabel="loss", yscale="log")
    right.set(xlabel="epoch", ylabel="validation", ylim=(0, 1))
    left.legend(fontsize=7)
    if names:
        right.legend(fontsize=7)
    figure.tight_layout()
    with safeio.atomic_path(out / "curves.png") as path:
        figure.savefig(path, dpi=110, format="png")
    pyplot.close(figure)
