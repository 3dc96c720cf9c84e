"""What limits an adversarial patch on the rear of a car: python benchmarks/physical_patch.py [NAME...] [--device cuda]

Adv. Patch is trained against YOLOv5n on pictures of Twinford and shown in Oldmarket, once for each of `VARIANTS`: as it
is, with one thing after the other made easier for the attack (no changes of print and place, no regularisers, colours
that nothing can have, more epochs, other rates, whole pictures, one picture alone), and on more of the rear. `own` is
the score in the pictures that it was trained on, printed exactly: the most that a variant can reach. A row is added to
benchmarks/results/physical_patch.json; --join adds the rows of other files. Pictures are recorded once, in the folder
--home.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.machine import start_warp_quietly
from ssad.detectors import make_detector
from ssad.experiments.perception.physical.target_views import RecordedTargetImages
from ssad.metrics.target_attacks import sightings, target_scores
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.camera.texture import to_linear
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.digital.objectives import Hide
from ssad.scenarios.static.physical import Patch, TextureView, albedo_of, control, make_physical, train_texture
from ssad.scenarios.static.physical.textures.inks import printable_colours
from ssad.scenarios.static.physical.textures.printing import NOMINAL

RESULTS = Path(__file__).parent / "results" / "physical_patch.json"
WINDOW, EPOCHS, BATCH = 192, 30, 16
ALONE = 5  # pictures that have a patch of their own
FREE = {"expectation": NOMINAL, "smooth": 0.0, "inks": False, "printed": 0.0}  # nothing but the detector's loss
METRICS = ("AP50", "found_25", "confidence")


def any_light(colour: Tensor) -> Tensor:
    """Albedo from 0 to 1, which no ink has."""
    return to_linear(colour)


@dataclass(frozen=True)
class Variant:
    """What differs from Adv. Patch as it is.

    Attributes:
        about: For the table.
        width: Of the patch, m.
        height: In m.
        settings: Fields of `TextureAttack`.
        longer: How many times the epochs.
        shown: What pictures take of colours.
        alone: A patch for each single picture, judged on that one.
        centre: See `Patch`.
    """

    about: str
    width: float = 1.0
    height: float = 0.5
    settings: dict[str, Any] = field(default_factory=dict)
    longer: int = 1
    shown: Callable[[Tensor], Tensor] = albedo_of
    alone: bool = False
    centre: tuple[float, float] = (0.5, 0.5)


VARIANTS = {
    "as-it-is": Variant("as it is"),
    "exact": Variant("printed and placed exactly (no expectation)", settings={"expectation": NOMINAL}),
    "free": Variant("printed exactly, without total variation and inks", settings=FREE),
    "any-colour": Variant("printed exactly, no total variation, no inks, any albedo", settings=FREE, shown=any_light),
    "longer": Variant("the same as the last, four times the epochs", settings=FREE, shown=any_light, longer=4),
    "slower": Variant("as it is, rate 0.01", settings={"rate": 0.01}),
    "faster": Variant("as it is, rate 0.1", settings={"rate": 0.1}),
    "small-steps": Variant("as it is, 4 pictures a step", settings={"batch": 4}),
    "one-box": Variant("as it is, the best box alone", settings={"objective": Hide()}),
    "whole-picture": Variant("as it is, trained on whole pictures", settings={"window": None}),
    "alone": Variant(
        "any colour, one patch for each picture, four times the epochs",
        settings=FREE,
        shown=any_light,
        longer=4,
        alone=True,
    ),
    "wider": Variant("as it is, 1.4 x 0.6 m", 1.4, 0.6),
    "low": Variant("as it is, 1.9 x 0.5 m, the lower half", 1.9, 0.5, centre=(0.5, 0.7)),
    "rear": Variant("as it is, 1.9 x 0.86 m, the whole rear", 1.9, 0.86),
    "rear-longer": Variant("the whole rear, four times the epochs", 1.9, 0.86, longer=4),
    "rear-any-colour": Variant("the whole rear, any albedo, exact", 1.9, 0.86, settings=FREE, shown=any_light),
    "rear-slower": Variant("the whole rear, rate 0.01, four times the epochs", 1.9, 0.86, {"rate": 0.01}, longer=4),
}
ORDER = {name: number for number, name in enumerate(VARIANTS)}


def clips(home: Path, town: str, count: int, classes: tuple[str, ...], device: str) -> RecordedTargetImages:
    """Pictures of a town, recorded if they are not there."""
    if not (home / town / "annotations").is_dir():
        record_target_images(
            TargetRecording(home / town, ((town, count),), (), target=TargetCar(), device=device), workers=0
        )
    return RecordedTargetImages(home / town, count, classes, device)


def shown(
    views: Sequence[tuple[str, TextureView]], colours: Sequence[Tensor], look: Callable[[Tensor], Tensor], device: str
) -> Iterator[tuple[str, Tensor, Truth]]:
    """Drive, picture and truth, each under its texture."""
    with torch.no_grad():
        for (drive, view), colour in zip(views, colours, strict=True):
            yield drive, view.picture.together([view.picture], {0: look(colour.to(device))[None]}), view.truth


def measure(name: str, *, count: int, epochs: int, batch: int, home: Path, device: str) -> dict[str, Any]:
    """One row."""
    variant = VARIANTS[name]
    detector = make_detector("yolov5n", device=device)
    classes = tuple(detector.classes)
    surface = Patch(width=variant.width, height=variant.height, centre=variant.centre).on(TargetCar().mesh())
    views = list(clips(home, "Twinford", count, classes, device).wearing(surface))
    settings = {"epochs": variant.longer * epochs, "window": WINDOW, "batch": batch} | variant.settings
    attack = make_physical("adv-patch", **settings)
    begin = time.perf_counter()

    def train(pictures: list[TextureView]) -> Tensor:
        return train_texture(
            attack,
            detector,
            surface,
            pictures,
            start=control("grey", surface.size),
            printable=printable_colours(),
            appearance=variant.shown,
            key=("patch", name),
            device=device,
        ).colour

    if variant.alone:
        views = views[:: max(1, len(views) // ALONE)]
        own = [train([view]) for _, view in views]
    else:
        own = [train([view for _, view in views])] * len(views)
    worn: list[Any] = [view.picture for _, view in views]
    pixels = [len(torch.unique(picture.taps[0].pixel)) for picture in worn]
    boxes = [view.truth.box[0] for _, view in views]
    area = [float((box[2] - box[0]) * (box[3] - box[1])) for box in boxes]
    found: dict[str, Any] = {
        "name": name,
        "about": variant.about,
        "pictures": count,
        "epochs": epochs,
        "batch": batch,
        "device": device,
        "covers": sum(pixels) / sum(area),
        "seconds": round(time.perf_counter() - begin),
    }

    def scores(pictures: Iterator[tuple[str, Tensor, Truth]]) -> dict[str, float | None]:
        metrics = target_scores(list(sightings(detector, pictures)), replicates=0)["metrics"]
        return {key: metrics[key] for key in METRICS}

    found["own"] = scores(shown(views, own, variant.shown, device))
    if not variant.alone:
        tested = list(clips(home, "Oldmarket", count, classes, device).wearing(surface))
        found["test"] = scores(shown(tested, own[:1] * len(tested), variant.shown, device))
        random = [control("random", surface.size)] * len(tested)
        found["random"] = scores(shown(tested, random, variant.shown, device))
    return found


def main() -> None:
    """Measure, or join, and add the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", default=[], metavar="NAME", help=", ".join(VARIANTS))
    parser.add_argument("--count", type=int, default=25, help="pictures of each town")
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    parser.add_argument("--batch", type=int, default=BATCH, help="pictures a step")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--home", type=Path, default=Path("runs/physical-patch"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--join", type=Path, nargs="*", default=[], metavar="FILE", help="add rows, measure nothing")
    given = parser.parse_args()
    rows = json.loads(given.out.read_text()) if given.out.is_file() else []
    start_warp_quietly()
    torch.set_num_threads(1)

    def add(row: dict[str, Any]) -> None:
        rows[:] = sorted(
            [*(one for one in rows if one["name"] != row["name"]), row], key=lambda one: ORDER[one["name"]]
        )
        given.out.write_text(json.dumps(rows, indent=1) + "\n")

    for path in given.join:
        for row in json.loads(path.read_text()):
            add(row | {"about": VARIANTS[row["name"]].about})
    for name in () if given.join else given.names or VARIANTS:
        budget = {"count": given.count, "epochs": given.epochs, "batch": given.batch}
        add(row := measure(name, **budget, home=given.home, device=given.device))
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
