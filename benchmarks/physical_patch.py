"""What makes an adversarial patch strong: python benchmarks/physical_patch.py WIDTH HEIGHT BOXES [--epochs N]

Trains Adv. Patch of a size (m) on the rear of the target against YOLOv5n, on 25 pictures of a drive in Twinford and the
part around the target, with so many of the best boxes on it hidden at once; then shows it, and a random patch of the
same size, in 25 pictures of a drive in Oldmarket. A row is added to benchmarks/results/physical_patch.json. Pictures
are recorded once, in the folder --home.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from ssad.detectors import make_detector
from ssad.evaluation.target_scores import sightings, target_scores
from ssad.jobs.machine import quiet_warp
from ssad.recording.clip_recorder import record_clips
from ssad.recording.clips import Clips
from ssad.recording.target import TargetCar
from ssad.recording.target_views import TargetClips
from ssad.scenarios.static.digital.objectives import Hide
from ssad.scenarios.static.physical import Patch, albedo_of, control, make_physical, train_texture

RESULTS = Path(__file__).parent / "results" / "physical_patch.json"
COUNT, WINDOW = 25, 192


def clips(home: Path, town: str, classes: tuple[str, ...]) -> TargetClips:
    """Pictures of a town, recorded if they are not there."""
    record_clips(Clips(home / town, ((town, COUNT),), (), target=TargetCar()), workers=0)
    return TargetClips(home / town, COUNT, classes)


def measure(width: float, height: float, boxes: int, *, epochs: int, home: Path) -> dict[str, Any]:
    """One row."""
    detector = make_detector("yolov5n")
    classes = tuple(detector.classes)
    surface = Patch(width=width, height=height).on(TargetCar().mesh())
    views = [view for _, view in clips(home, "Twinford", classes).wearing(surface)]
    attack = make_physical("adv-patch", objective=Hide(others=boxes), epochs=epochs, window=WINDOW)
    begin = time.process_time()
    trained = train_texture(attack, detector, surface, views, start=control("grey", surface.size))
    seconds = time.process_time() - begin
    tested = list(clips(home, "Oldmarket", classes).wearing(surface))
    found: dict[str, Any] = {
        "width": width,
        "height": height,
        "boxes": boxes,
        "epochs": epochs,
        "cpu_s": round(seconds),
    }
    for name, colour in (("attack", trained.colour), ("random", control("random", surface.size))):
        with torch.no_grad():
            shown = [(drive, view.picture.show({0: albedo_of(colour)}), view.truth) for drive, view in tested]
            metrics = target_scores(list(sightings(detector, shown)), replicates=0)["metrics"]
        found[name] = {key: metrics[key] for key in ("AP50", "found_25", "confidence")}
    return found


def main() -> None:
    """Measure, and add the row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("width", type=float)
    parser.add_argument("height", type=float)
    parser.add_argument("boxes", type=int)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--home", type=Path, default=Path("runs/physical-patch"))
    given = parser.parse_args()
    quiet_warp()
    torch.set_num_threads(1)
    row = measure(given.width, given.height, given.boxes, epochs=given.epochs, home=given.home)
    rows = json.loads(RESULTS.read_text()) if RESULTS.is_file() else []
    same = ("width", "height", "boxes", "epochs")
    rows = [one for one in rows if any(one[key] != row[key] for key in same)] + [row]
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
    print(json.dumps(row))


if __name__ == "__main__":
    main()
