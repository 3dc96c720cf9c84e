"""Where the time of an attack step goes: python benchmarks/physical_speed.py [--images N] [--device cuda] [--out FILE]

A step shows a car at 20 m with a camouflage, runs YOLOv5n on the picture and takes the gradient back to the texture. It
has stages: the print of each picture, the light from it, what lens, sensor and JPEG make of that, the detector forward
and backward, and the gradient back through the sensor and from the light to the texture. Rendering is all but the
detector. Medians over steps of the process's own time (of the wall clock on a GPU), for whole pictures and for the part
around the target that a `window` shows.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from ssad.core.machine import start_warp_quietly
from ssad.detectors import make_detector
from ssad.experiments.perception.physical.target_views import RecordedTargetImages
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.digital.objectives import Situation, make_objective
from ssad.scenarios.static.digital.victim import steady
from ssad.scenarios.static.physical import Camouflage, Expectation, TextureView, albedo_of, control
from ssad.scenarios.static.physical.textures.optimise import TARGET
from ssad.scenarios.static.physical.zoom import around_target

TOWN, WINDOW, BATCH = "Twinford", 192, 8
BUDGET = 600 * 200  # pictures that the paper shows in a training: 600 frames, 200 epochs


def clock(device: str) -> float:
    """Now, ms."""
    if device == "cpu":
        return 1e3 * time.process_time()
    torch.cuda.synchronize()
    return 1e3 * time.perf_counter()


STAGES = ("print", "light", "sensor", "detector", "sensor_back", "texture_back")


def step(
    detector: Any, views: list[TextureView], colour: torch.Tensor, window: int | None, device: str
) -> tuple[float, ...]:
    """Ms of each of `STAGES` in one step."""
    draws, pictures = [torch.Generator().manual_seed(k) for k in range(len(views))], [view.picture for view in views]
    times, truths = [clock(device)], [view.truth for view in views]
    textures = {0: albedo_of(Expectation().draw(colour, draws))}
    times.append(clock(device))
    radiance, read = type(pictures[0]).lit(pictures, textures)
    times.append(clock(device))
    light = radiance.detach().requires_grad_()
    images = type(pictures[0]).developed(pictures, light, read, draws)
    if window is not None:
        parts = [around_target(images[k : k + 1], truth, window, draws[k]) for k, truth in enumerate(truths)]
        images, truths = torch.cat([part for part, _ in parts]), [truth for _, truth in parts]
    times.append(clock(device))
    leaf = images.detach().requires_grad_()
    dense = detector.dense(leaf)
    with torch.no_grad():
        assignment = detector.assign(dense, truths)
    value = make_objective("hide")(dense, Situation(detector, assignment, TARGET)).mean()
    (slope,) = torch.autograd.grad(value, leaf)
    times.append(clock(device))
    (slope,) = torch.autograd.grad(images, light, slope)
    times.append(clock(device))
    radiance.backward(slope)
    times.append(clock(device))
    return tuple(later - earlier for earlier, later in pairwise(times))


def measure(count: int, device: str) -> dict[str, Any]:
    """Medians over steps, whole pictures and windows."""
    target = TargetCar()
    surface = Camouflage().on(target.mesh())
    with tempfile.TemporaryDirectory() as folder:
        record_target_images(
            TargetRecording(Path(folder), ((TOWN, count),), (), target=target, device=device), workers=0
        )
        detector = make_detector("yolov5n", device=device)
        clips = RecordedTargetImages(Path(folder), count, tuple(detector.classes), device)
        views = [view for _, view in clips.wearing(surface)]
    colour = control("random", surface.size).to(device).requires_grad_()
    batch = 1 if device == "cpu" else BATCH
    rows = {}
    with steady(detector):
        for name, window in (("whole", None), ("window", WINDOW)):
            parts = [views[k : k + batch] for k in range(0, count - batch + 1, batch)]
            step(detector, parts[0], colour, window, device)
            times = [step(detector, one, colour, window, device) for one in parts]
            stages = {
                stage: statistics.median(column) / batch
                for stage, column in zip(STAGES, zip(*times, strict=True), strict=True)
            }
            whole, detect = sum(stages.values()), stages["detector"]
            rows[name] = {
                "render_ms": whole - detect,
                "detector_ms": detect,
                "share": 1.0 - detect / whole,
                "paper_minutes": BUDGET * whole / 60e3,
                "stages_ms": stages,
            }
    torch_device = torch.cuda.get_device_name() if device != "cpu" else f"CPU, {torch.get_num_threads()} thread"
    return {"device": torch_device, "images": count, "window": WINDOW, "batch": batch, "rows": rows}


def main() -> None:
    """Measure, and print or write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    start_warp_quietly()
    torch.set_num_threads(1)
    found = measure(given.images, given.device)
    text = json.dumps(found, indent=1) + "\n"
    if given.out:
        given.out.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
