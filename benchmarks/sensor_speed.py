"""What the camera's sensor costs: python benchmarks/sensor_speed.py [--out FILE]

The renderer's last step on one core, 640 x 640, by sensor; and in torch, forward and backward from a texture of
256 x 256 on a car 20 m ahead: whole pictures, and only what the texture touches; beside it, YOLOv5n's losses on the
picture, forward and backward. Medians of the process's own time.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import warp as wp
from camera_speed import scene

from ssad.core.detections import Truth
from ssad.detectors import make_detector
from ssad.rendering.camera.render import View, develop_radiance, render
from ssad.rendering.camera.sensor import PINHOLE, SensorModel
from ssad.rendering.camera.texture import retexture, texture_taps
from ssad.rendering.camera.torch_jpeg import jpeg
from ssad.rendering.camera.torch_sensor import ChangedWindow, develop, draw_noise

NOISE = 0.012
RENDERED = {
    "pinhole": PINHOLE,
    "lens and mosaic": SensorModel(),
    "lens": SensorModel(mosaic=False),
    "pinhole, noise": SensorModel(blur=0.0, mosaic=False, noise=NOISE),
    "lens, mosaic, noise": SensorModel(noise=NOISE),
}
TORCH: dict[str, tuple[SensorModel, int | None]] = {
    "curve": (PINHOLE, None),
    "lens, mosaic, noise": (SensorModel(noise=NOISE), None),
    "lens, mosaic, noise, JPEG": (SensorModel(noise=NOISE), 92),
}


def median(run: Callable[[], object], repeats: int) -> float:
    """Median ms of a call, after one to warm up."""
    times = []
    for _ in range(repeats + 1):
        begin = time.process_time()
        run()
        times.append(1e3 * (time.process_time() - begin))
    return statistics.median(times[1:])


def rendered(view: View, radiance: Any, exposure: float, repeats: int) -> dict[str, float]:
    """Ms of the renderer's last step by sensor."""
    held = wp.array(radiance, dtype=wp.vec3, device="cpu")
    found = {}
    for name, sensor in RENDERED.items():
        views = [View(view.camera, view.pose, sensor=sensor, seed=3)]
        found[name] = median(lambda views=views: develop_radiance(held, views, [exposure]), repeats)  # type: ignore[misc]
    return found


def in_torch(picture: Any, repeats: int) -> dict[str, dict[str, float]]:
    """Ms from texture to picture and back, of all pixels and of the touched ones."""
    taps, radiance = texture_taps(picture, 256), torch.tensor(picture.radiance)
    exposure, texture = float(picture.exposure[0]), torch.full((3, 256, 256), 0.4)
    found = {}
    for name, (sensor, quality) in TORCH.items():
        noise = draw_noise(radiance.shape[:3], sensor, torch.Generator().manual_seed(0))
        window = ChangedWindow.around(taps.pixel, radiance.shape[:3], sensor, quality=quality)
        part, part_noise, part_taps = window.crop(radiance), window.crop(noise), window.relative_taps(taps)

        def whole(sensor: SensorModel = sensor, quality: int | None = quality, noise: torch.Tensor = noise) -> None:
            leaf = texture.clone().requires_grad_()
            image = develop(retexture(taps, leaf, radiance), exposure, sensor, noise)
            (image if quality is None else jpeg(image, quality)).sum().backward()

        def touched(
            part: Any = part, noise: Any = part_noise, taps: Any = part_taps, window: ChangedWindow = window
        ) -> None:
            leaf = texture.clone().requires_grad_()
            window.develop(retexture(taps, leaf, part), exposure, noise).sum().backward()

        found[name] = {"whole": median(whole, repeats), "touched": median(touched, repeats)}
    return found


def victim(picture: Any, repeats: int) -> float:
    """Ms of the losses of YOLOv5n on the picture and of their gradient with respect to it."""
    detector = make_detector("yolov5n", device="cpu")
    image = torch.tensor(picture.image).permute(0, 3, 1, 2).float() / 255
    truth = [Truth(torch.tensor([0]), torch.tensor([[280.0, 300.0, 360.0, 360.0]]))]

    def attack() -> None:
        leaf = image.clone().requires_grad_()
        dense = detector.dense(leaf)
        losses = detector.losses(dense, detector.assign(dense, truth))
        torch.stack(list(losses.values())).sum().backward()  # type: ignore[no-untyped-call]

    return median(attack, repeats)


def main() -> None:
    """Measures, prints, writes JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    stage, view = scene(640, "cpu")
    picture = render(stage, [view])
    result: dict[str, Any] = {
        "rendered_ms": rendered(view, picture.radiance, float(picture.exposure[0]), options.repeats),
        "torch_ms": in_torch(picture, options.repeats),
        "yolov5n_ms": victim(picture, options.repeats),
    }
    for name, ms in result["rendered_ms"].items():
        print(f"{ms:6.2f} ms  renderer: {name}")
    for name, both in result["torch_ms"].items():
        print(f"{both['whole']:6.1f} ms  torch, whole picture: {name}\n{both['touched']:6.1f} ms  only what is touched")
    print(f"{result['yolov5n_ms']:6.1f} ms  YOLOv5n, forward and backward")
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
