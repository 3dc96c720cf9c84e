"""Textures of a physical run: trained once and kept, and what detectors find of a car that wears them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssad.bench.kind import Job
from ssad.bench.physical_rows import carrier_of
from ssad.core import safeio
from ssad.core.detections import Truth
from ssad.core.images import read_image, save_picture
from ssad.core.seeding import digest
from ssad.detectors import make_detector
from ssad.evaluation.target_scores import Sighting, sighting
from ssad.evaluation.target_sheet import texture_picture
from ssad.jobs.machine import quiet_warp
from ssad.recording.clip_recorder import clip_rows
from ssad.recording.target import TargetCar, parse_target
from ssad.recording.textured_clips import textured_clips
from ssad.scenarios.static.physical import (
    CONTROLS,
    Surface,
    View,
    albedo_of,
    control,
    make_physical,
    train_texture,
)

THRESHOLD = 0.001  # least score of a box that AP counts


@lru_cache(maxsize=16)
def _surface(target: str, row: str) -> Surface:
    car = parse_target(target)
    assert isinstance(car, TargetCar)
    return carrier_of(safeio.parse_json(row)).on(car.mesh())


def surface_of(job: Job, spec: Mapping[str, Any]) -> Surface:
    """Where the texture of a cell goes."""
    return _surface(job.settings["target"], safeio.dump_json(carried(spec)))


def carried(spec: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the surface."""
    return {"carrier": spec["carrier"], "options": spec["options"]}


def see(task: tuple[str, str, Mapping[str, Any], str]) -> None:
    """In a worker: render what all pictures of a recording see of a carrier, and keep it."""
    folder, target, row, device = task
    quiet_warp()
    surface = _surface(target, safeio.dump_json(row))
    for _ in textured_clips(Path(folder), (surface.layer,), device=device):
        pass


def views_of(job: Job, town: str, spec: Mapping[str, Any], count: int) -> list[tuple[str, View]]:
    """Pictures of a town whose target wears the carrier of a cell, each with the name of its drive."""
    surface = surface_of(job, spec)
    found: list[tuple[str, View]] = []
    for clip in textured_clips(job.folder / "data" / town, (surface.layer,), device=job.device):
        if len(found) == count:
            break
        wearing = clip.prepare({0: surface.size}, masks={0: surface.mask}, device=job.device)
        found.append((_drive(clip.row), View(wearing, _truth(clip.objects))))
    return found


def _drive(row: Mapping[str, Any]) -> str:
    """Name of the drive that a picture is of."""
    return f"{row['part']}/{row['attempt']}"


def _truth(objects: Sequence[Mapping[str, Any]]) -> Truth:
    """What is annotated in a picture, the target first."""
    ordered = sorted(objects, key=lambda one: not one["target"])
    x, y, width, height = np.array([one["bbox"] for one in ordered], np.float64).T
    return Truth(
        torch.tensor([int(one["category_id"]) - 1 for one in ordered]),
        torch.from_numpy(np.stack([x, y, x + width, y + height], 1)).float(),
        crowd=torch.tensor([bool(one["iscrowd"]) for one in ordered]),
    )


def clean_images(job: Job, town: str, count: int) -> Iterator[tuple[str, torch.Tensor, Truth]]:
    """Drive, picture [1, 3, H, W] in 0 to 1 and truth of the pictures of a town, as they were recorded."""
    folder = job.folder / "data" / town
    for row, objects in clip_rows(folder)[:count]:
        image = torch.tensor(read_image(folder / "images" / row["file_name"])).to(job.device)
        yield _drive(row), image.permute(2, 0, 1)[None].float() / 255, _truth(objects)


def texture_name(spec: Mapping[str, Any]) -> str:
    """What the training of a texture depends on."""
    attack = spec["of"] or spec["attack"]
    about = attack, spec["source"], spec["carrier"], safeio.dump_json(spec["options"])
    return (
        f"{attack}-{digest('texture', *about, safeio.dump_json(spec['settings']), safeio.dump_json(spec['pair']))[:12]}"
    )


def texture_path(job: Job, spec: Mapping[str, Any]) -> Path:
    """Where a trained texture is when it is done."""
    return job.folder / "textures" / f"{texture_name(spec)}.npz"


def picture_path(job: Job, spec: Mapping[str, Any]) -> Path:
    """The texture of a cell as a picture."""
    if spec["attack"] in CONTROLS and not spec["source"]:
        where = digest("carrier", safeio.dump_json(carried(spec)))[:8]
        return job.folder / "textures" / f"{spec['attack']}-{spec['carrier']}-{where}-{spec['number']}.png"
    number = f"-shuffled-{spec['number']}" if spec["attack"] == "shuffled" else ""
    return texture_path(job, spec).with_name(f"{texture_name(spec)}{number}.png")


def texture_of(job: Job, spec: Mapping[str, Any]) -> torch.Tensor:
    """The texture of a cell, sRGB [3, H, W]; trained now if it has to be. Written as a picture too."""
    surface = surface_of(job, spec)
    if spec["source"]:
        colour = _trained(job, spec, surface)
        if spec["attack"] == "shuffled":
            colour = control("shuffled", surface.size, seed=spec["number"], trained=colour)
    else:
        colour = control(spec["attack"], surface.size, seed=spec["number"])
    path = picture_path(job, spec)
    if not path.is_file():
        save_picture(path, texture_picture(colour, surface.mask))
    return colour


def _trained(job: Job, spec: Mapping[str, Any], surface: Surface) -> torch.Tensor:
    path = texture_path(job, spec)
    if not path.is_file():
        pair = spec["pair"]
        attack = make_physical(spec["of"] or spec["attack"], **spec["settings"])
        views = [view for _, view in views_of(job, pair["train"], spec, pair["train_images"])]
        detector = make_detector(spec["source"], device=job.device)
        trained = train_texture(
            attack, detector, surface, views, start=control("grey", surface.size), device=job.device,
            key=(job.settings["seed"], texture_name(spec)), checkpoint=path.with_suffix(".checkpoint.npz"),
        )  # fmt: skip
        safeio.save_npz(
            path,
            {"colour": trained.colour.numpy(), "losses": np.array(trained.losses),
             "gradients": np.array(trained.gradients)},
        )  # fmt: skip
    return torch.from_numpy(safeio.load_npz(path)["colour"].copy())


def about(job: Job, spec: Mapping[str, Any]) -> dict[str, Any]:
    """How a texture was trained, for the record."""
    if not spec["source"]:
        return {}
    kept = safeio.load_npz(texture_path(job, spec))
    losses = kept["losses"]
    return {"epochs": len(losses), "loss_before": float(losses[0]), "loss_after": float(losses[-1])}


def sightings_of(job: Job, detector: str, spec: Mapping[str, Any], pair: Mapping[str, Any]) -> list[Sighting]:
    """What a detector finds in the pictures of the test under the texture of a cell."""
    made = make_detector(detector, device=job.device)
    colour = albedo_of(texture_of(job, spec)).to(job.device)  # may be trained now, so gradients are on
    found = []
    with torch.no_grad():
        for drive, view in views_of(job, pair["test"], spec, pair["test_images"]):
            (boxes,) = made.predict(view.picture.show({0: colour}), threshold=THRESHOLD)
            found.append(sighting(drive, boxes, view.truth))
    return found


def clean_sightings(job: Job, detector: str, pair: Mapping[str, Any]) -> tuple[Sighting, ...]:
    """What a detector finds in the pictures of the test as they were recorded; kept, since every cell needs it."""
    return _clean_sightings(job.folder, job.device, detector, pair["test"], pair["test_images"])


@lru_cache(maxsize=8)
def _clean_sightings(folder: Path, device: str, detector: str, town: str, count: int) -> tuple[Sighting, ...]:
    made = make_detector(detector, device=device)
    found = []
    for drive, image, truth in clean_images(Job(folder, device, {}), town, count):
        (boxes,) = made.predict(image, threshold=THRESHOLD)
        found.append(sighting(drive, boxes, truth))
    return tuple(found)


def clip_image(job: Job, town: str, spec: Mapping[str, Any] | None) -> torch.Tensor:
    """The first picture of a town [1, 3, H, W], clean (None) or under the texture of a cell."""
    if spec is None:
        ((_, image, _),) = clean_images(job, town, 1)
        return image
    colour = albedo_of(texture_of(job, spec)).to(job.device)
    ((_, view),) = views_of(job, town, spec, 1)
    with torch.no_grad():
        return view.picture.show({0: colour})
