"""What a light attack has to work with: python benchmarks/physical_lights.py [--pictures N] [--device cuda]

A shadow can only take the sun's light where the sun shines, and a lamp only shows beside the light that is there. For
each hour, over pictures of drives of Oldmarket: how much of the light on the target's rear is the sun's, what is left
of YOLOv5n's score when all of the sun is kept off the whole target (no card can do more), how many lux there are, how
many the lamps of the suite physical-lights give at full power, and what the brightest of them leaves when it lights the
whole rear. Writes benchmarks/results/physical_lights.json. Pictures are recorded once, in the folder --home.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from ssad.core.machine import start_warp_quietly
from ssad.detectors import make_detector
from ssad.experiments.perception.physical.lit_images import RelightableImage, RelightableTargetImages
from ssad.experiments.perception.physical.target_views import drive_of
from ssad.metrics.target_attacks import sightings, target_scores
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import render
from ssad.rendering.camera.scene_edit import NO_EDIT, SceneEdit
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.physical.lights import Flashlight, Laser
from ssad.scenarios.static.physical.lights.lit_image import BLIND

RESULTS = Path(__file__).parent / "results" / "physical_lights.json"
TOWN, HOURS = "Oldmarket", ("noon", "low_sun", "sun_behind", "night")
SUNLIT = 0.2  # share of the sun in the light on the rear, from which on a shadow could be seen


def rear(clip: RelightableImage) -> tuple[float, float]:
    """Share of the sun in the light on the target's rear, and lux there; medians over its pixels."""
    picture = clip.lit()
    back = -0.5 * clip.target.length
    on_it = ((picture.position[..., 0] - back).abs() < 0.3) & (picture.normal[..., 0] < -0.7)
    surface = render(clip.scene, [clip.view.view], quality=clip.view.quality, surface=True).surface
    assert surface is not None
    (top, left), (high, wide) = picture.corner, picture.radiance.shape[:2]
    light = surface.irradiance[0, top : top + high, left : left + wide][on_it.numpy()].mean(-1)
    whole = picture.radiance[on_it].mean(-1)
    sun = picture.sun[on_it].mean(-1) / whole.clamp_min(1e-9)
    return float(sun.median()), float(np.median(light)) / per_lux(clip.view.view.weather)


def flood(clip: RelightableImage) -> SceneEdit:
    """The brightest lamp on the whole rear, white."""
    values = {
        "lumens": 3000.0,
        "distance": 4.0,
        "height": 1.0,
        "aside": 0.0,
        "aim_left": 0.0,
        "aim_up": 0.5 * clip.target.height,
        "beam": 0.3,
        "red": 1.0,
        "green": 1.0,
        "blue": 1.0,
    }
    return Flashlight().edit(values, clip.target)


def scores(
    pictures: RelightableTargetImages, clips: list[RelightableImage], detector: Any, edit: Any
) -> dict[str, float | None]:
    """AP50 and mean score of the target under an edit of each picture."""

    def shown() -> Any:
        for clip in clips:
            image = torch.from_numpy(clip.render(edit(clip))).to(pictures.device).permute(2, 0, 1)[None].float() / 255
            yield drive_of(clip.view.row), image, pictures.lit_truth(clip)

    metrics = target_scores(list(sightings(detector, shown())), replicates=0)["metrics"]
    return {name: metrics[name] for name in ("AP50", "confidence")}


def main() -> None:
    """Measure, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--pictures", type=int, default=75, help="recorded, 25 of each drive")
    parser.add_argument("--every", type=int, default=5, help="each which of them is looked at")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--home", type=Path, default=Path("runs/physical-lights/data"))
    given = parser.parse_args()
    start_warp_quietly()
    torch.set_num_threads(1)
    home = given.home / TOWN
    if not (home / "annotations").is_dir():
        record_target_images(
            TargetRecording(home, ((TOWN, given.pictures),), (), target=TargetCar(), device=given.device), workers=0
        )
    detector = make_detector("yolov5n", device=given.device)
    rows = []
    for hour in HOURS:
        pictures = RelightableTargetImages(home, given.pictures, tuple(detector.classes), given.device)
        clips = list(pictures.images_at(hour))[:: given.every]
        sun, lux = np.array([rear(clip) for clip in clips]).T
        none = SceneEdit(cards=(BLIND,))
        row: dict[str, Any] = {
            "hour": hour,
            "pictures": len(clips),
            "drives": len({drive_of(clip.view.row) for clip in clips}),
            "sunlit": float((sun > SUNLIT).mean()),
            "sun": float(sun.max()),
            "lux": float(np.median(lux)),
            "clean": scores(pictures, clips, detector, lambda _: NO_EDIT),
            "flooded": scores(pictures, clips, detector, flood),
        }
        if hour != "night":
            row["no_sun"] = scores(pictures, clips, detector, lambda _, none=none: none)
        rows.append(row)
        print(json.dumps(row), flush=True)
    laser, lamp = Laser(), Flashlight()
    line = 2.0 * laser.fan * laser.distance
    lamps = {
        "laser": [laser.watts * 683.0 / (line * width) for width in laser.width[::-1]],
        "flashlight": [lamp.lumens / (np.pi * (away * lamp.beam[1]) ** 2) for away in lamp.distance[::-1]],
    }
    RESULTS.write_text(json.dumps({"rows": rows, "lux": lamps}, indent=1) + "\n")


if __name__ == "__main__":
    main()
