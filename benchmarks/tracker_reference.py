"""Our tracker beside ByteTrack and SORT of Roboflow's package `trackers`, in the picture, on the same boxes.

    python benchmarks/tracker_reference.py boxes     # drives, pictures, YOLOv5n: tests/data/tracks/boxes.npz
    python benchmarks/tracker_reference.py compare   # all three on these boxes: benchmarks/results/trackers.json

`compare` needs the package, which brings another OpenCV than SSAD's: run it in an environment of its own (`uv venv`,
`uv pip install trackers`) with PYTHONPATH=src. All three get the same boxes and equal settings: scores of the two
stages, hits to confirm, time that a lost track is kept. Ours follows points with a covariance, so here a box is its
middle, with a standard deviation of a share of its sides; the other two match by overlap.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.perception import I64, Objects
from ssad.core.types import F64, AgentKind
from ssad.drivers.perceiving.tracker import KalmanTracker, TrackerSettings
from ssad.metrics.tracking import TrackedFrame, TrackScores, track_scores

ROOT = Path(__file__).resolve().parents[1]
BOXES = ROOT / "tests" / "data" / "tracks" / "boxes.npz"
RESULTS = ROOT / "benchmarks" / "results" / "trackers.json"
DRIVES = 4
RATE = 5.0  # pictures a second, as a perceiving driver looks
HIGH, LOW, CONFIRM, RESERVE = 0.3, 0.1, 2, 6  # as a perceiving driver's
SHARE, LEAST = 0.15, 2.0  # standard deviation of a box's middle: share of its sides, pixels at least
SCALE = 33.0  # pixels a metre, of a car 60 pixels wide
GROUND, WIDER = 3.0 * SCALE**2, 20_000.0  # accelerations as on the ground; of a picture that turns with the ego
Frames = list[tuple[F64, I64, F64, F64]]
"""For each picture of a drive: boxes of who is in view [n, 4] and who it is [n], boxes found [m, 4], scores [m]."""
Follow = Callable[[Frames], Iterator[tuple[F64, I64]]]
Link = tuple[int, int, tuple[float, ...], tuple[float, ...]]


def boxes_of_drive(scenario: Any, detector: Any) -> Frames:
    """What YOLOv5n finds in a drive of the Autopilot, and what is there; boxes x1, y1, x2, y2, pixels."""
    import torch

    from ssad import World, build_episode, load_town, make_system, rollout
    from ssad.core.rotations import upright_pose
    from ssad.drivers.perceiving.perceivers import nuscenes_cameras, project_boxes
    from ssad.metrics.perception_in_drive import in_view
    from ssad.rendering.onboard import Onboard
    from ssad.world.models import MODELS

    town = load_town(scenario.town)
    (trace,) = rollout(World([build_episode(scenario, town, seed=0)], {town.name: town}), make_system("autopilot"))
    cameras = nuscenes_cameras(640)
    (camera,) = cameras.values()
    steps = list(range(0, len(trace.x), round(1.0 / RATE / trace.dt)))
    seen = in_view(trace, steps, cameras)
    pictures = Onboard().camera(camera)
    found: Frames = []
    for step, view in zip(steps, seen, strict=True):
        picture = torch.from_numpy(pictures.of_trace(trace, town, steps=[step])).float() / 255.0
        (one,) = detector.predict(picture, threshold=LOW)
        x, y, yaw = (float(v[step, 0]) for v in (trace.x, trace.y, trace.yaw))
        to_camera = np.linalg.inv(upright_pose(x, y, yaw) @ camera.to_ego)
        there, who = [np.zeros((0, 4))], []
        for agent in np.flatnonzero(view).tolist():
            height = MODELS[trace.models[agent]].height
            body = (
                np.array([[trace.x[step, agent], trace.y[step, agent], 0.5 * height]], float),
                np.array([[trace.length[agent], trace.width[agent], height]], float),
                np.array([trace.yaw[step, agent]], float),
                [int(trace.kind[agent])],
                np.zeros((1, 2)),
            )
            box = project_boxes(body, to_camera, camera).box.numpy()
            if len(box):
                there.append(box)
                who.append(agent)
        road = one.label != len(detector.classes) - 1  # signs are no road users
        found.append(
            (
                np.concatenate(there),
                np.array(who, np.int64),
                one.box[road].numpy().astype(float),
                one.score[road].numpy().astype(float),
            )
        )
    return found


def save(drives: list[Frames]) -> None:
    """All drives in one file, in 16-bit pixels."""
    flat = [(d, k, *frame) for d, frames in enumerate(drives) for k, frame in enumerate(frames)]
    told: dict[str, Any] = {"frame": np.array([(d, k) for d, k, *_ in flat], np.int16)}
    for name, at, kind in (
        ("there", 2, np.float16),
        ("who", 3, np.int16),
        ("box", 4, np.float16),
        ("score", 5, np.float16),
    ):
        told[name] = np.concatenate([row[at] for row in flat]).astype(kind)
        told[f"{name}_count"] = np.array([len(row[at]) for row in flat], np.int16)
    BOXES.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(BOXES, **told)


def load() -> list[Frames]:
    """The drives that `save` wrote."""
    with np.load(BOXES) as data:
        parts = [
            np.split(data[name].astype(kind), np.cumsum(data[f"{name}_count"])[:-1])
            for name, kind in (("there", float), ("who", np.int64), ("box", float), ("score", float))
        ]
        drive = data["frame"][:, 0]
    rows = list(zip(*parts, strict=True))
    return [[row for row, own in zip(rows, drive == d, strict=True) if own] for d in np.unique(drive)]


def overlap(one: F64, other: F64) -> F64:
    """IoU of boxes [n, 4] and [m, 4], [n, m]."""
    low, high = np.maximum(one[:, None, :2], other[:, :2]), np.minimum(one[:, None, 2:], other[:, 2:])
    common = np.clip(high - low, 0.0, None).prod(-1)
    area = [(boxes[:, 2:] - boxes[:, :2]).prod(-1) for boxes in (one, other)]
    return np.asarray(common / np.maximum(area[0][:, None] + area[1] - common, 1e-9))


def settings(density: float) -> TrackerSettings:
    """Of SSAD's tracker in pixels."""
    return TrackerSettings(
        confirm=CONFIRM, reserve=RESERVE, high=HIGH, low=LOW, stranger=0.0, density=density, speed=6.0 * SCALE
    )


def ours(frames: Frames, density: float = GROUND) -> Iterator[tuple[F64, I64]]:
    """Boxes and numbers of the tracks that were hit in each picture, by SSAD's tracker."""
    tracker = KalmanTracker(settings(density))
    for k, (_, _, box, score) in enumerate(frames):
        middle, side = 0.5 * (box[:, :2] + box[:, 2:]), box[:, 2:] - box[:, :2]
        n = len(box)
        spread = np.zeros((n, 2, 2))
        spread[:, [0, 1], [0, 1]] = np.maximum(SHARE * side, LEAST) ** 2
        found = Objects(
            np.zeros(n, np.int64),
            middle,
            spread,
            np.zeros(n),
            side,
            np.full((n, 2), np.nan),
            np.full(n, int(AgentKind.CAR)),
            score,
        )
        tracker.update(np.zeros(1, np.int64), np.array([k / RATE]), found)
        tracks = tracker.tracks.take((tracker.tracks.hits >= CONFIRM) & (tracker.tracks.missed == 0))
        # the box that a track was given is the one whose middle and score it took
        own = np.linalg.norm(tracks.mean[:, None, :2] - middle, axis=-1) + 1e3 * (tracks.score[:, None] != score)
        at = own.argmin(1) if n else np.zeros(0, np.int64)
        yield box[at], tracks.ident


def theirs(make: Callable[[], Any], least: float) -> Follow:
    """The same by a tracker of `trackers`, which is given boxes of a least score."""
    import supervision

    def follow(frames: Frames) -> Iterator[tuple[F64, I64]]:
        tracker = make()
        for _, _, box, score in frames:
            good = score >= least
            given = supervision.Detections(
                xyxy=box[good], confidence=score[good], class_id=np.zeros(int(good.sum()), int)
            )
            told = tracker.update(given)
            known = told.tracker_id >= 0
            yield np.asarray(told.xyxy[known], float), np.asarray(told.tracker_id[known], np.int64)

    return follow


def scored(drives: list[Frames], follow: Follow) -> list[TrackScores]:
    """Scores of each drive."""
    found = []
    for frames in drives:
        told = [
            TrackedFrame(who, ident, overlap(there, box))
            for (there, who, _, _), (box, ident) in zip(frames, follow(frames), strict=True)
        ]
        one = track_scores(told)
        assert one is not None
        found.append(one)
    return found


@dataclass(frozen=True)
class Mean:
    """Means over drives; switches are added up."""

    hota: float
    detection: float
    association: float
    mota: float
    idf1: float
    switches: int

    @classmethod
    def of(cls, scores: list[TrackScores]) -> Mean:
        """Of scores of drives."""
        names = ("hota", "detection", "association", "mota", "idf1")
        means = {name: round(float(np.mean([getattr(one, name) for one in scores])), 4) for name in names}
        return cls(**means, switches=sum(one.switches for one in scores))


def links(drives: list[Frames], follow: Follow) -> set[Link]:
    """Which boxes have the same number one after the other: drive, looks between, the two boxes."""
    found: set[Link] = set()
    for d, frames in enumerate(drives):
        last: dict[int, tuple[int, tuple[float, ...]]] = {}
        for k, (boxes, idents) in enumerate(follow(frames)):
            for box, ident in zip(boxes.tolist(), idents.tolist(), strict=True):
                if ident in last:
                    found.add((d, k - last[ident][0], last[ident][1], (k, *box)))
                last[ident] = k, (k, *box)
    return found


def compare(drives: list[Frames]) -> dict[str, dict[str, Any]]:
    """Ours and those of `trackers`, with equal settings."""
    from trackers import ByteTrackTracker, SORTTracker

    same = {
        "lost_track_buffer": round(30 * RESERVE / RATE),
        "frame_rate": RATE,
        "minimum_consecutive_frames": CONFIRM,
        "track_activation_threshold": HIGH,
    }
    methods = {
        "ours": ours,
        "ours, wider": lambda frames: ours(frames, WIDER),
        "ByteTrack": theirs(lambda: ByteTrackTracker(**same, high_conf_det_threshold=HIGH), LOW),
        "SORT": theirs(lambda: SORTTracker(**same), HIGH),
    }
    own = links(drives, methods["ours"])
    return {
        name: asdict(Mean.of(scored(drives, follow)))
        | {"links": len(links(drives, follow)), "links shared with ours": len(own & links(drives, follow))}
        for name, follow in methods.items()
    }


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["boxes", "compare"])
    if parser.parse_args().what == "boxes":
        from ssad import load_scenarios
        from ssad.detectors import make_detector

        twinford = load_scenarios("natural-twinford")
        chosen = twinford[:: len(twinford) // DRIVES][:DRIVES]
        save([boxes_of_drive(scenario, make_detector("yolov5n")) for scenario in chosen])
        return
    drives = load()
    told = {
        "versions": {name: version(name) for name in ("trackers", "supervision", "numpy")},
        "drives": len(drives),
        "pictures": sum(map(len, drives)),
        "scores": compare(drives),
    }
    RESULTS.write_text(json.dumps(told, indent=1) + "\n")
    print(json.dumps(told["scores"], indent=1))


if __name__ == "__main__":
    main()
