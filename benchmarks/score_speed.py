"""Scoring 6,000 samples with 30 ground-truth boxes and 100 predictions each: ours beside the official devkit.

    SSAD_DEVKIT_PYTHON=.../bin/python uv run python benchmarks/score_speed.py

The size of nuScenes val. Files are written to a temporary folder first; each run is a process of its own, and its CPU
time (user and system) and peak memory are those of the whole process, imports and reading included. Without
SSAD_DEVKIT_PYTHON, an interpreter with nuscenes-devkit 1.2.0, only ours runs. Writes results/score_speed.json.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, TextIO

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from helpers.devkit_sets import PIXEL, SIZES, VERSION  # noqa: E402

from ssad.core.nuscenes_names import ATTRIBUTES, CATEGORY_TO_CLASS, CLASSES  # noqa: E402
from ssad.core.safeio import write_atomic  # noqa: E402
from ssad.core.seeding import digest, generator  # noqa: E402

# about the shares of the classes in nuScenes
SHARE = np.array([0.43, 0.08, 0.015, 0.023, 0.013, 0.20, 0.011, 0.01, 0.09, 0.13])
OURS = """
import json, sys
from ssad.datasets.nuscenes.score import score_results
root, out = sys.argv[1:]
found = score_results(root + "/results.json", dataroot=root, version="v1.0-mini", split="mini_val")
json.dump(found, open(out, "w"))
"""


def main() -> None:
    """Write the files, run both, print and store."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, default=6000)
    parser.add_argument("--truth", type=int, default=30)
    parser.add_argument("--predictions", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="keep the files here and take them from here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if not (folder / "results.json").exists():
            write_files(folder, options.samples, options.truth, options.predictions)
        out = Path(temporary) / "out.json"
        ours = [measure([sys.executable, "-c", OURS, str(folder), str(out)]) for _ in range(options.repeats)]
        scores = json.loads(out.read_text())
        result: dict[str, Any] = {
            "samples": options.samples,
            "truth": options.truth * options.samples,
            "predictions": options.predictions * options.samples,
            "results_mb": round((folder / "results.json").stat().st_size / 1e6, 1),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "ours": {
                "cpu_s": round(statistics.median(run["cpu_s"] for run in ours), 2),
                "cpu_s_all": [round(run["cpu_s"], 2) for run in ours],
                "wall_s": round(statistics.median(run["wall_s"] for run in ours), 2),
                "peak_mib": round(max(run["peak_mib"] for run in ours)),
                "parts_wall_s": {k: round(v, 2) for k, v in scores["ssad"]["wall_s"].items()},
            },
        }
        devkit = os.environ.get("SSAD_DEVKIT_PYTHON")
        if devkit:
            script = ROOT / "tests" / "helpers" / "devkit_eval.py"
            run = measure([devkit, str(script), str(out), VERSION, "mini_val", str(folder)])
            theirs = json.loads(out.read_text())[folder.name]
            if "error" in theirs:
                raise SystemExit(f"the devkit failed: {theirs['error']}")
            result["devkit"] = {
                "cpu_s": round(run["cpu_s"], 1),
                "wall_s": round(run["wall_s"], 1),
                "peak_mib": round(run["peak_mib"]),
            }
            result["cpu_ratio"] = round(run["cpu_s"] / result["ours"]["cpu_s"], 1)
            result["largest_difference"] = difference(theirs, scores)
    text = json.dumps(result, indent=2)
    print(text)
    write_atomic(ROOT / "benchmarks" / "results" / "score_speed.json", text + "\n")


def measure(command: list[str]) -> dict[str, float]:
    """CPU seconds, wall seconds and peak resident memory (MiB) of a process."""
    began = time.perf_counter()
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"failed with {process.returncode}: {command}")
    return {
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "wall_s": time.perf_counter() - began,
        "peak_mib": usage.ru_maxrss / 1024,
    }


def difference(theirs: dict[str, Any], ours: dict[str, Any]) -> float:
    """Largest difference of a number under the keys that the devkit gives, its time aside."""
    worst = 0.0
    for key, value in theirs.items():
        if isinstance(value, dict):
            worst = max(worst, difference(value, ours[key]))
        elif isinstance(value, float) and key != "eval_time":
            if math.isnan(value) != math.isnan(ours[key]):
                return math.inf
            worst = max(worst, abs(value - ours[key]) if not math.isnan(value) else 0.0)
    return worst


def write_files(root: Path, samples: int, truth: int, predictions: int) -> None:
    """A dataset of 40 samples a scene, all in two scenes' names of mini_val, and a results file."""
    (root / VERSION).mkdir(parents=True, exist_ok=True)
    (root / "maps").mkdir(exist_ok=True)
    (root / "maps" / "map.png").write_bytes(PIXEL)
    scenes = max(samples // 40, 1)
    random = generator("score speed", samples, truth, predictions)
    label = random.choice(len(CLASSES), size=(scenes, truth), p=SHARE / SHARE.sum())
    start = random.normal(0.0, 20.0, (scenes, truth, 2))
    speed = random.normal(0.0, 3.0, (scenes, truth, 2))
    token = {kind: [digest(kind, i)[:32] for i in range(samples)] for kind in ("sample", "data", "pose")}
    category = {CLASSES.index(name): digest(c)[:32] for c, name in CATEGORY_TO_CLASS.items()}
    size = np.array([SIZES[name] for name in CLASSES])
    tables: dict[str, list[dict[str, Any]]] = {
        "category": [{"token": digest(c)[:32], "name": c, "description": ""} for c in CATEGORY_TO_CLASS],
        "attribute": [{"token": f"{i}", "name": name, "description": ""} for i, name in enumerate(ATTRIBUTES)],
        "visibility": [{"token": f"{i}", "level": "", "description": ""} for i in range(1, 5)],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"}],
        "calibrated_sensor": [
            {
                "token": "calibrated",
                "sensor_token": "lidar",
                "translation": [0.0, 0.0, 1.8],
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "camera_intrinsic": [],
            }
        ],
        "log": [{"token": "log", "logfile": "", "vehicle": "", "date_captured": "", "location": "boston-seaport"}],
        "map": [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/map.png"}],
        "scene": [{"token": f"scene-{s}", "name": ("scene-0103", "scene-0916")[s % 2]} for s in range(scenes)],
        "instance": [
            {"token": digest("instance", s, i)[:32], "category_token": category[int(label[s, i])]}
            for s in range(scenes)
            for i in range(truth)
        ],
        **{name: [] for name in ("sample", "sample_data", "ego_pose", "sample_annotation")},
    }
    for n in range(samples):
        tables["sample"].append(
            {"token": token["sample"][n], "timestamp": 10**15 + n * 500_000, "scene_token": f"scene-{n // 40 % scenes}"}
            | {"prev": "", "next": ""}
        )
        tables["ego_pose"].append(
            {
                "token": token["pose"][n],
                "timestamp": 0,
                "translation": [0.0, 0.0, 0.0],
                "rotation": [1.0, 0.0, 0.0, 0.0],
            }
        )
        tables["sample_data"].append(
            {"token": token["data"][n], "sample_token": token["sample"][n], "ego_pose_token": token["pose"][n]}
            | {"calibrated_sensor_token": "calibrated", "timestamp": 0, "is_key_frame": True, "filename": "a/b"}
            | {"fileformat": "pcd", "height": 0, "width": 0, "prev": "", "next": ""}
        )
    with (
        (root / "results.json").open("w") as results,
        (root / VERSION / "sample_annotation.json").open("w") as annotations,
    ):
        results.write('{"meta": {"use_camera": true}, "results": {')
        annotations.write("[\n")
        for n in range(samples):
            s, t = n // 40 % scenes, n % 40
            place = start[s] + speed[s] * 0.5 * t
            write_truth(
                annotations,
                n,
                samples=samples,
                place=place,
                label=label[s],
                size=size,
                sample=token["sample"][n],
                random=random,
            )
            pick = random.integers(0, truth, predictions)
            far = random.random(predictions)[:, None] < 0.5
            found = place[pick] + random.normal(0.0, np.where(far, 15.0, 1.0), (predictions, 2))
            results.write((", " if n else "") + f'"{token["sample"][n]}": ')
            results.write(json.dumps(boxes(token["sample"][n], found, label[s][pick], size, random)))
        results.write("}}")
        annotations.write("]\n")
    del tables["sample_annotation"]
    for name, rows in tables.items():
        (root / VERSION / f"{name}.json").write_text(json.dumps(rows, indent=0))


def write_truth(
    file: TextIO,
    n: int,
    *,
    samples: int,
    place: np.ndarray,
    label: np.ndarray,
    size: np.ndarray,
    sample: str,
    random: np.random.Generator,
) -> None:
    """Annotations of sample n, linked to those of the samples before and after in its scene."""
    rows = []
    for i, (x, y) in enumerate(place.tolist()):
        first, last = n % 40 == 0, n % 40 == 39 or n == samples - 1
        rows.append(
            {
                "token": digest("ann", n, i)[:32],
                "sample_token": sample,
                "instance_token": digest("instance", n // 40, i)[:32],
                "visibility_token": "4",
                "attribute_tokens": ["6"] if label[i] < 5 else [],
                "translation": [x, y, 1.0],
                "size": size[label[i]].tolist(),
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "prev": "" if first else digest("ann", n - 1, i)[:32],
                "next": "" if last else digest("ann", n + 1, i)[:32],
                "num_lidar_pts": int(random.integers(0, 30)),
                "num_radar_pts": 0,
            }
        )
    file.write((",\n" if n else "") + json.dumps(rows, indent=0)[1:-1])


def boxes(
    sample: str, found: np.ndarray, label: np.ndarray, size: np.ndarray, random: np.random.Generator
) -> list[Any]:
    """Predictions of a sample."""
    count = len(found)
    turn = random.uniform(-math.pi, math.pi, count)
    sides = size[label] * random.uniform(0.8, 1.2, (count, 3))
    velocity, score, attribute = random.normal(0.0, 3.0, (count, 2)), random.random(count), random.integers(0, 8, count)
    return [
        {
            "sample_token": sample,
            "translation": [*found[i].tolist(), 1.0],
            "size": sides[i].tolist(),
            "rotation": [math.cos(turn[i] / 2), 0.0, 0.0, math.sin(turn[i] / 2)],
            "velocity": velocity[i].tolist(),
            "detection_name": CLASSES[label[i]],
            "detection_score": float(score[i]),
            "attribute_name": ATTRIBUTES[attribute[i]],
        }
        for i in range(count)
    ]


if __name__ == "__main__":
    main()
