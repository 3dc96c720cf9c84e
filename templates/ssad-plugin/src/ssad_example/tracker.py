"""A tracker: each detection continues the nearest track of its scene, at a constant velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ssad.core.perception import Objects, Tracks, no_tracks
from ssad.core.types import Episode

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Track:
    """State of a track: number, time s, place and velocity [2] in the world, and the last detection."""

    ident: int
    time: float
    place: Floats
    velocity: Floats
    last: Objects
    missed: int = 0


class Nearest:
    """Tracker that joins each track with the nearest detection.

    Args:
        gate: Distance from its predicted place within which a detection continues a track, m.
        keep: Looks without a detection that a track survives.
    """

    def __init__(self, gate: float = 4.0, keep: int = 3) -> None:
        self.gate, self.keep = gate, keep
        self.tracks: dict[int, list[Track]] = {}
        self.born: dict[int, int] = {}

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget all tracks."""
        self.tracks = {scene: [] for scene in range(len(episodes))}
        self.born = dict.fromkeys(self.tracks, 0)

    def update(self, scenes: Integers, times: Floats, found: Objects, poses: Floats) -> None:
        """Take in the detections of one look at each of some scenes; see `ssad.drivers.perceiving.parts.Tracker`."""
        for scene, time in zip(scenes.tolist(), times.tolist(), strict=True):
            rows = np.flatnonzero(found.scene == scene).tolist()
            tracks = []
            for track in self.tracks[scene]:
                seconds = time - track.time
                predicted = track.place + track.velocity * seconds
                row = min(rows, key=lambda row: float(np.linalg.norm(found.place[row] - predicted)), default=None)
                if row is not None and np.linalg.norm(found.place[row] - predicted) < self.gate:
                    rows.remove(row)
                    measured = (found.place[row] - track.place) / max(seconds, 1e-6)
                    velocity = 0.5 * (track.velocity + measured)
                    last = found.take(np.array([row]))
                    tracks.append(Track(track.ident, time, found.place[row].copy(), velocity, last))
                elif track.missed < self.keep:
                    tracks.append(replace(track, time=time, place=predicted, missed=track.missed + 1))
            for row in rows:
                last = found.take(np.array([row]))
                velocity = np.nan_to_num(found.velocity[row])
                tracks.append(Track(self.born[scene], time, found.place[row].copy(), velocity, last))
                self.born[scene] += 1
            self.tracks[scene] = tracks

    def confirmed(self, scenes: npt.NDArray[np.integer], times: Floats) -> Tracks:
        """Return all tracks of some scenes, predicted to the present."""
        now = dict(zip(scenes.tolist(), times.tolist(), strict=True))
        tracks = [(scene, track) for scene in now for track in self.tracks[scene]]
        if not tracks:
            return no_tracks()
        last = Objects.cat([track.last for _, track in tracks])
        velocity = np.stack([track.velocity for _, track in tracks])
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        return Tracks(
            scene=np.array([scene for scene, _ in tracks]),
            ident=np.array([track.ident for _, track in tracks]),
            place=np.stack([track.place + track.velocity * (now[scene] - track.time) for scene, track in tracks]),
            velocity=velocity,
            yaw=np.where(np.isnan(last.yaw), heading, last.yaw),
            size=last.size,
            kind=last.kind,
            score=last.score,
        )
