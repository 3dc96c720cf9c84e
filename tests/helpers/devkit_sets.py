"""Small datasets in the nuScenes schema with detections, made from fixed keys: the inputs of the comparison with the
official devkit. Each is loadable by it; each stresses something that an evaluation can get wrong.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.nuscenes_names import ATTRIBUTES, CATEGORY_TO_CLASS, CLASSES
from ssad.core.seeding import generator

VERSION = "v1.0-mini"
SPLIT = "mini_val"
SCENES = ("scene-0103", "scene-0061", "scene-0916")  # the second is of mini_train
PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg==")
OTHERS = ("animal", "vehicle.emergency.police")  # categories without a detection class
RACK = "static_object.bicycle_rack"
SIZES = {
    "car": (1.9, 4.6, 1.7),
    "truck": (2.5, 6.9, 2.8),
    "bus": (2.9, 11.0, 3.5),
    "trailer": (2.9, 12.3, 3.9),
    "construction_vehicle": (2.7, 6.4, 3.2),
    "pedestrian": (0.7, 0.7, 1.8),
    "motorcycle": (0.8, 2.1, 1.5),
    "bicycle": (0.6, 1.7, 1.3),
    "traffic_cone": (0.4, 0.4, 1.1),
    "barrier": (2.5, 0.5, 1.0),
}


@dataclass(frozen=True)
class Spec:
    """What a set is like. Lengths in metres, shares in 0 .. 1.

    levels: number of different scores, 0 for any; grid: positions are multiples of it; noise: of predicted positions;
    found: share of the objects that are predicted; copies: predictions of each; strays: false ones a sample; lost:
    share of samples that an object is absent from; nan, bare, empty, zero: shares of predictions without velocity, of
    objects without attribute, of objects without points, of scores that are 0; counted: some predictions say how many
    points they hold; racks: bicycle racks a sample.
    """

    samples: int = 5
    objects: int = 24
    classes: tuple[str, ...] = CLASSES
    levels: int = 0
    grid: float = 0.0
    noise: float = 0.5
    found: float = 0.85
    copies: int = 1
    strays: int = 6
    lost: float = 0.15
    nan: float = 0.0
    bare: float = 0.1
    empty: float = 0.1
    racks: int = 0
    zero: float = 0.0
    counted: bool = False
    spread: float = 60.0


SETS: dict[str, Spec] = {
    "plain": Spec(samples=8, objects=40),
    "ties": Spec(levels=3, grid=0.5, copies=2, objects=40),
    "one_score": Spec(levels=1, grid=0.25, copies=3),
    "crowd": Spec(
        samples=3, objects=60, classes=("pedestrian", "traffic_cone"), spread=12.0, grid=0.5, levels=20, copies=2
    ),
    "nan_velocity": Spec(nan=0.5, lost=0.7),
    "all_nan_velocity": Spec(nan=1.0),
    "single_frames": Spec(samples=6, lost=0.93, objects=80),
    "empty_classes": Spec(classes=("car", "pedestrian", "barrier"), strays=20),
    "no_attributes": Spec(bare=1.0),
    "no_points": Spec(empty=0.5),
    "racks": Spec(classes=("bicycle", "motorcycle", "car"), racks=8, objects=60, grid=0.5, spread=25.0),
    "single_sample": Spec(samples=1, objects=30),
    "low_recall": Spec(found=0.08, samples=8, objects=40),
    "no_predictions": Spec(found=0.0, strays=0),
    "zero_scores": Spec(levels=4, zero=0.4),
    "counted_points": Spec(counted=True),
    "many": Spec(samples=1, objects=150, copies=3, strays=40, spread=40.0),
}


def write_set(folder: Path, name: str) -> Path:
    """Write the set `name` below the folder: tables, a map picture, results.json; gives the dataset's root."""
    root = folder / name
    tables, results = make_set(name)
    (root / VERSION).mkdir(parents=True)
    (root / "maps").mkdir()
    (root / "maps" / "map.png").write_bytes(PIXEL)
    for table, rows in tables.items():
        (root / VERSION / f"{table}.json").write_text(json.dumps(rows, indent=0))
    (root / "results.json").write_text(json.dumps(results))
    return root


def make_set(name: str) -> tuple[dict[str, list[dict[str, Any]]], dict[str, Any]]:
    """Tables and results of a set; the samples of the results stand in another order than in the tables."""
    spec = SETS[name]
    random = generator("devkit set", name)
    tables: dict[str, list[dict[str, Any]]] = _constant_tables()
    names = {row["name"]: row["token"] for row in tables["category"]}
    boxes: dict[str, list[dict[str, Any]]] = {}
    for number, scene in enumerate(SCENES):
        samples = _scene(tables, number, scene, spec.samples)
        tracks = [
            _track(random, spec, int(random.choice([CLASSES.index(c) for c in spec.classes])))
            for _ in range(spec.objects)
        ]
        for t, sample in enumerate(samples):
            if scene != "scene-0061":
                boxes[sample] = []
            for r in range(spec.racks):
                turn = float(random.uniform(-math.pi, math.pi)) if r % 2 else 0.0
                place = np.add(_snap(spec, random.uniform(-spec.spread, spec.spread, 2)), (5.0 * t, 0.0))
                _annotate(
                    tables,
                    f"rack-{number}-{t}-{r}",
                    category=names[RACK],
                    sample=sample,
                    translation=[*place.tolist(), 0.8],
                    size=[8.0, 3.0, 1.6],
                    rotation=_turned(turn),
                )
        for i, track in enumerate(tracks):
            _write_track(
                random,
                spec,
                tables=tables,
                names=names,
                samples=samples,
                track=track,
                key=f"{number}-{i}",
                boxes=boxes,
            )
        for sample in samples:
            if sample in boxes:
                boxes[sample] += [_stray(random, spec, sample) for _ in range(spec.strays)]
                random.shuffle(boxes[sample])  # type: ignore[arg-type]
    if not any(boxes.values()):  # the devkit needs one box at least, be it out of range
        sample = next(iter(boxes))
        boxes[sample] = [{**_stray(random, spec, sample), "translation": [900.0, 0.0, 0.0]}]
    order = [list(boxes)[i] for i in random.permutation(len(boxes))]
    meta = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
    return tables, {"meta": meta, "results": {token: boxes[token] for token in order}}


def _snap(spec: Spec, value: Any) -> Any:
    return np.round(np.asarray(value) / spec.grid) * spec.grid if spec.grid else np.asarray(value)


def _turned(yaw: float) -> list[float]:
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def _constant_tables() -> dict[str, list[dict[str, Any]]]:
    categories = [*CATEGORY_TO_CLASS, *OTHERS, RACK]
    return {
        "category": [{"token": f"category-{i}", "name": n, "description": ""} for i, n in enumerate(categories)],
        "attribute": [{"token": f"attribute-{i}", "name": n, "description": ""} for i, n in enumerate(ATTRIBUTES)],
        "visibility": [{"token": str(i), "level": f"v{i}", "description": ""} for i in range(1, 5)],
        "sensor": [
            {"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"},
            {"token": "front", "channel": "CAM_FRONT", "modality": "camera"},
        ],
        "calibrated_sensor": [
            {
                "token": f"calibrated-{sensor}",
                "sensor_token": sensor,
                "translation": [1.0, 0.0, 1.8],
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "camera_intrinsic": [],
            }
            for sensor in ("lidar", "front")
        ],
        "log": [{"token": "log", "logfile": "", "vehicle": "", "date_captured": "", "location": "boston-seaport"}],
        "map": [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/map.png"}],
        **{name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "instance", "sample_annotation")},
    }


def _scene(tables: dict[str, list[dict[str, Any]]], number: int, name: str, count: int) -> list[str]:
    """Samples of a scene: the ego drives east at 10 m/s; a sweep and a camera have poses of their own."""
    tokens = [f"sample-{number}-{t}" for t in range(count)]
    tables["scene"].append(
        {
            "token": f"scene-{number}",
            "name": name,
            "log_token": "log",
            "description": "",
            "nbr_samples": count,
            "first_sample_token": tokens[0],
            "last_sample_token": tokens[-1],
        }
    )
    for t, token in enumerate(tokens):
        time = 1_532_402_927_647_951 + number * 10**9 + t * 500_000 + (t * 7919) % 3000
        tables["sample"].append(
            {
                "token": token,
                "timestamp": time,
                "scene_token": f"scene-{number}",
                "prev": tokens[t - 1] if t else "",
                "next": tokens[t + 1] if t + 1 < count else "",
            }
        )
        for kind, sensor, key, ahead in (
            ("sweep", "lidar", False, 0.3),
            ("key", "lidar", True, 0.0),
            ("cam", "front", True, 0.1),
        ):
            pose = f"pose-{kind}-{token}"
            tables["ego_pose"].append(
                {
                    "token": pose,
                    "timestamp": time,
                    "translation": [5.0 * t + ahead, 0.0, 0.0],
                    "rotation": [1.0, 0.0, 0.0, 0.0],
                }
            )
            tables["sample_data"].append(
                {
                    "token": f"data-{kind}-{token}",
                    "sample_token": token,
                    "ego_pose_token": pose,
                    "calibrated_sensor_token": f"calibrated-{sensor}",
                    "timestamp": time,
                    "is_key_frame": key,
                    "filename": f"samples/{kind}-{token}",
                    "fileformat": "pcd",
                    "height": 0,
                    "width": 0,
                    "prev": "",
                    "next": "",
                }
            )
    return tokens


def _track(random: np.random.Generator, spec: Spec, label: int) -> dict[str, Any]:
    return {
        "label": label,
        "place": random.uniform(-spec.spread, spec.spread, 2),
        "speed": random.uniform(-6.0, 6.0, 2) if random.random() < 0.7 else np.zeros(2),
        "yaw": float(random.uniform(-math.pi, math.pi)),
        "size": (np.array(SIZES[CLASSES[label]]) * random.uniform(0.8, 1.2, 3)).round(3).tolist(),
        "category": str(
            random.choice(
                [c for c, n in CATEGORY_TO_CLASS.items() if n == CLASSES[label]] + ([OTHERS[0]] if label == 0 else [])
            )
        ),
    }


def _write_track(
    random: np.random.Generator,
    spec: Spec,
    *,
    tables: dict[str, list[dict[str, Any]]],
    names: dict[str, str],
    samples: list[str],
    track: dict[str, Any],
    key: str,
    boxes: dict[str, list[dict[str, Any]]],
) -> None:
    """Annotations of an object in the samples that have it, linked, and the predictions of it."""
    there = [t for t in range(len(samples)) if random.random() >= spec.lost] or [0]
    tables["instance"].append(
        {
            "token": f"instance-{key}",
            "category_token": names[track["category"]],
            "nbr_annotations": len(there),
            "first_annotation_token": "",
            "last_annotation_token": "",
        }
    )
    for i, t in enumerate(there):
        place = _snap(spec, track["place"] + track["speed"] * 0.5 * t)
        own = [a for a, n in enumerate(ATTRIBUTES) if n.split(".")[0] == _family(CLASSES[track["label"]])]
        bare = not own or random.random() < spec.bare
        chosen = None if bare else int(random.choice(own))
        points = 0 if random.random() < spec.empty else int(random.integers(1, 30))
        tables["sample_annotation"].append(
            {
                "token": f"ann-{key}-{t}",
                "sample_token": samples[t],
                "instance_token": f"instance-{key}",
                "visibility_token": str(random.integers(1, 5)),
                "attribute_tokens": [] if chosen is None else [f"attribute-{chosen}"],
                "translation": [*place.tolist(), 1.0],
                "size": track["size"],
                "rotation": _turned(track["yaw"]),
                "num_lidar_pts": points - points // 3,
                "num_radar_pts": points // 3,
                "prev": f"ann-{key}-{there[i - 1]}" if i else "",
                "next": f"ann-{key}-{there[i + 1]}" if i + 1 < len(there) else "",
            }
        )
        if samples[t] not in boxes:
            continue
        for _ in range(spec.copies):
            if random.random() >= spec.found:
                continue
            box = _stray(random, spec, samples[t])
            # not quite unit length: the devkit brings it there
            turn = (
                np.array(_turned(track["yaw"] + float(random.normal(0.0, 0.4)))) * random.uniform(0.9, 1.1)
            ).tolist()
            box |= {
                "translation": [*_snap(spec, place + random.normal(0.0, spec.noise, 2)).tolist(), 1.1],
                "size": (np.array(track["size"]) * random.uniform(0.8, 1.3, 3)).tolist(),
                "rotation": turn,
                "detection_name": CLASSES[track["label"]],
            }
            if not math.isnan(box["velocity"][0]):
                box["velocity"] = (track["speed"] + random.normal(0.0, 0.5, 2)).tolist()
            if chosen is not None and random.random() < 0.7:
                box["attribute_name"] = ATTRIBUTES[chosen]
            boxes[samples[t]].append(box)


def _family(name: str) -> str:
    if name in {"bicycle", "motorcycle"}:
        return "cycle"
    return name if name == "pedestrian" else "" if name in {"traffic_cone", "barrier"} else "vehicle"


def _annotate(
    tables: dict[str, list[dict[str, Any]]],
    key: str,
    *,
    category: str,
    sample: str,
    translation: list[float],
    size: list[float],
    rotation: list[float],
) -> None:
    tables["instance"].append(
        {
            "token": f"instance-{key}",
            "category_token": category,
            "nbr_annotations": 1,
            "first_annotation_token": "",
            "last_annotation_token": "",
        }
    )
    tables["sample_annotation"].append(
        {
            "token": f"ann-{key}",
            "sample_token": sample,
            "instance_token": f"instance-{key}",
            "visibility_token": "4",
            "attribute_tokens": [],
            "translation": translation,
            "size": size,
            "rotation": rotation,
            "num_lidar_pts": 9,
            "num_radar_pts": 0,
            "prev": "",
            "next": "",
        }
    )


def _stray(random: np.random.Generator, spec: Spec, sample: str) -> dict[str, Any]:
    """A prediction of nothing."""
    name = CLASSES[int(random.integers(len(CLASSES)))]
    step = int(sample.rsplit("-", 1)[1])
    score = float(random.random()) if not spec.levels else float(random.integers(1, spec.levels + 1)) / 10.0
    unknown = random.random() < spec.nan
    box = {
        "sample_token": sample,
        "translation": [
            *_snap(spec, np.add(random.uniform(-spec.spread, spec.spread, 2), (5.0 * step, 0.0))).tolist(),
            1.0,
        ],
        "size": list(SIZES[name]),
        "rotation": _turned(float(random.uniform(-math.pi, math.pi))),
        "velocity": [math.nan, math.nan] if unknown else random.normal(0.0, 2.0, 2).tolist(),
        "detection_name": name,
        "detection_score": 0.0 if random.random() < spec.zero else score,
        "attribute_name": str(random.choice(["", *ATTRIBUTES])),
    }
    if spec.counted and random.random() < 0.5:
        box["num_pts"] = int(random.integers(0, 3))
    return box
