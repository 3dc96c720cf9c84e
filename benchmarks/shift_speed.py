"""Images a second of every shift: one core, or batches on a GPU.

python benchmarks/shift_speed.py [--device cpu|cuda] [--batch N] [--out FILE]

One 1600 x 900 street with 8 objects of about 250 x 200 pixels, severities 1, 3 and 5, the median of several runs.
The codec is timed by itself and, on the CPU, decode + shift + encode end to end. Beside it the rates of
3D_Corruptions_AD as measured elsewhere (one process, 2-core machine, severity 3 or nearest): its sum over the 11
shifts is what ours is compared with.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import warp as wp

from ssad.core.boxes import TrackedBoxes
from ssad.core.frames import FORWARD, Camera, Frame, SceneContext
from ssad.core.images import decode_image, encode_jpeg
from ssad.core.rotations import yaw_to_quaternion
from ssad.scenarios.static.shifts import SHIFTS, VERSIONS, ShiftSpec, shift_images
from ssad.scenarios.static.shifts.batch import Batch, to_batch

# images / s of 3D_Corruptions_AD (patched to run); scale: mean time of up 3.8 and down 1.0; motion blur: of zoom 0.38
# and linear 4.2
OTHERS = {
    "snow": 2.3,
    "rain": 4.7,
    "fog": 3.6,
    "sunlight": 2.2,
    "uniform": 17,
    "gaussian": 9.5,
    "impulse": 9.0,
    "scale": 2 / (1 / 3.8 + 1 / 1.0),
    "shear": 3.7,
    "rotation": 3.7,
    "motion_blur": 2 / (1 / 0.38 + 1 / 4.2),
}
WIDTH, HEIGHT = 1600, 900


def street() -> tuple[np.ndarray, Frame]:
    """A drawn street and what is known of it."""
    camera = Camera(WIDTH, HEIGHT, np.array([[1266.4, 0, 816.3], [0, 1266.4, 491.5], [0, 0, 1]]))
    rng = np.random.default_rng(0)
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    image[:492] = np.linspace((110, 150, 220), (200, 215, 235), 492)[:, None]
    image[492:] = 95
    for x in range(0, WIDTH, 230):
        height = int(rng.integers(90, 330))
        cv2.rectangle(image, (x, 492 - height), (x + 190, 500), rng.integers(60, 190, 3).tolist(), -1)
        for row in range(492 - height + 20, 470, 40):
            for column in range(x + 15, x + 175, 45):
                cv2.rectangle(image, (column, row), (column + 20, row + 22), (40, 50, 60), -1)
    texture = cv2.resize(rng.normal(0, 8, (HEIGHT // 2, WIDTH // 2)).astype(np.float32), (WIDTH, HEIGHT))
    image = np.clip(image + texture[..., None], 0, 255).astype(np.uint8)
    side = np.linspace(-6.2, 6.2, 8)
    centre = np.stack([np.full(8, 12.5) + np.arange(8) % 2, side, np.full(8, 0.8)], 1)
    yaw = np.linspace(-0.3, 0.3, 8)
    rotation = yaw_to_quaternion(yaw)
    size = np.tile([3.4, 1.9, 1.6], (8, 1))
    velocity = np.stack([0 * yaw, np.where(np.arange(8) % 2, 6.0, -6.0), 0 * yaw], 1)
    boxes = TrackedBoxes(centre, size, rotation, velocity, tuple(f"car {n}" for n in range(8)), np.ones(8))
    to_camera = np.linalg.inv(FORWARD)
    corners = boxes.corners()
    for n in np.argsort(-centre[:, 0], kind="stable"):
        points = to_camera[:3, :3] @ corners[n].T + to_camera[:3, 3:]
        pixels = (points[:2] / points[2] * 1266.4 + [[816.3], [491.5]]).T
        hull = cv2.convexHull(pixels.astype(np.float32)).astype(np.int32)
        cv2.fillConvexPoly(image, hull, rng.integers(40, 230, 3).tolist())
        cv2.polylines(image, [hull], True, (15, 15, 15), 3)
    v = (np.arange(225) * 4 + 1.5)[:, None] - 491.5
    depth = np.where(v > 5, 1.5 * 1266.4 / np.maximum(v, 5), np.where(v > -133, 60, np.inf)).astype(np.float32)
    depth = depth + np.zeros((1, 400), np.float32)  # houses 6 degrees high, the sun above them
    return image, Frame(camera, "scene", "sample", 3.0, ego_velocity=np.array([8.0, 0, 0]), boxes=boxes, depth=depth)


def median(run: Callable[[], object], device: str, repeats: int) -> float:
    """Median seconds of a call, after one to warm up: on the CPU those of the processor, whatever else runs there."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    times = []
    for number in range(repeats + 1):
        wp.synchronize_device(device)
        begin = clock()
        run()
        wp.synchronize_device(device)
        if number:
            times.append(clock() - begin)
    return statistics.median(times)


def main() -> None:
    """Measures, prints a table, writes JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    device = "cuda:0" if options.device == "cuda" else options.device
    image, frame = street()
    images: Batch = to_batch(np.repeat(image[None], options.batch, 0), device)
    frames = [frame] * options.batch
    contexts = {"scene": SceneContext("scene", 0.8, sun=(0.985, 0.0, 0.174))}
    rows: dict[str, dict[str, float]] = {}
    for calibration in ("physical", "paper"):
        total = 0.0
        for name in SHIFTS:
            specs = [ShiftSpec(name, severity, calibration=calibration) for severity in (1, 3, 5)]
            calls = [partial(shift_images, images, frames, spec, contexts=contexts) for spec in specs]
            seconds = statistics.mean(median(call, device, options.repeats) for call in calls) / options.batch
            total += seconds
            rows[f"{calibration} {name}"] = {"images_per_s": 1 / seconds, "others_per_s": OTHERS[name]}
            print(
                f"{calibration:<9}{name:<12}{1 / seconds:9.0f} /s   3D_Corruptions_AD {OTHERS[name]:5.1f} /s",
                flush=True,
            )
        others = sum(1 / rate for rate in OTHERS.values())
        rows[f"{calibration} sum"] = {"seconds": total, "others_seconds": others, "ratio": others / total}
        print(f"{calibration:<9}sum {total * 1e3:.0f} ms, other {others * 1e3:.0f} ms: {others / total:.0f} times")
    if device == "cpu":
        data = encode_jpeg(image, 80)
        decode = median(lambda: decode_image(data), device, options.repeats)
        rows["decode"] = {"images_per_s": 1 / decode}
        print(f"decode {1 / decode:.0f} /s")
        for name in SHIFTS:
            spec = ShiftSpec(name, 3)
            mode = "444" if spec.family == "sensor" else "420"
            shifted = shift_images(image, frame, spec, contexts=contexts)[0]
            encode = median(lambda s=shifted, m=mode: encode_jpeg(s, 95, m), device, options.repeats)
            whole = median(
                lambda s=spec, m=mode: encode_jpeg(
                    shift_images(decode_image(data), frame, s, contexts=contexts)[0], 95, m
                ),
                device,
                options.repeats,
            )
            rows[f"end to end {name}"] = {"images_per_s": 1 / whole, "codec_share": (decode + encode) / whole}
            print(f"{name:<12}end to end {1 / whole:5.0f} /s, codec {100 * (decode + encode) / whole:3.0f} % of it")
    where = wp.get_device(device).name if device != "cpu" else platform.processor() or platform.machine()
    result = {"device": where, "batch": options.batch, "versions": VERSIONS, "rows": rows}
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
