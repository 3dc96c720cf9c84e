"""From objects found now and then to objects that are followed: Kalman filters on the ground, matched in two stages.

A track is confirmed by its H-th hit and forgotten after R looks in a row without one. Both decide whether a
perturbation of the camera matters: it must begin before the H-th hit, or outlast R looks (Jia et al., ICLR 2020; Shen
et al., SoK: semantic AI security, 2022). Matching follows ByteTrack (Zhang et al., ECCV 2022): first the objects of a
high score with all confirmed tracks, then those of a low score with the confirmed tracks that were found last time,
then what is left of a high score with the tracks that are still to be confirmed. Distances are Mahalanobis' on the
ground, not overlaps in the image.

Predictions and updates of all scenes are one batch; the assignment (scipy's, exact) is made scene by scene, so that no
scene depends on another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from ssad.core.columns import concatenate
from ssad.core.errors import ConfigError
from ssad.core.perception import I64, Objects, Tracks
from ssad.core.registry import Reference
from ssad.core.types import F64, I32, AgentKind, Episode
from ssad.drivers.perceiving.kalman import predict, squared_distances, update

MEMORY = 0.8  # weight of the earlier sizes, kinds and headings at each hit
SCORES = {
    "fcos3d-light": (0.25, 0.1),
    "fcos3d-light-robust": (0.25, 0.1),
    "pgd-det-light": (0.13, 0.05),
}
"""High and low for detectors that score low."""
SURE = 2.0  # standard deviations of its speed above which the direction in which a track moves is its heading


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerSettings:
    """Settings of the tracker.

    Attributes:
        confirm: Hits that confirm a track (H).
        reserve: Looks without a hit that a confirmed track survives (R).
        patience: The same for an unconfirmed track.
        high: Minimum score to be matched first and to start a track.
        low: Minimum score of an object.
        gate: Maximum squared Mahalanobis distance of a match; 9.21 loses 1 % of the true pairs.
        stranger: Penalty added to the distance if the kinds differ.
        density: Spectral density of the objects' acceleration, m^2/s^3.
        speed: Standard deviation of the speed of a new track, m/s.
    """

    confirm: int = 2
    reserve: int = 6
    patience: int = 1
    high: float = 0.3
    low: float = 0.1
    gate: float = 9.21
    stranger: float = 3.0
    density: float = 3.0
    speed: float = 6.0

    def __post_init__(self) -> None:
        if self.confirm < 1 or self.reserve < 0 or self.patience < 0 or not 0.0 <= self.low <= self.high <= 1.0:
            raise ConfigError(
                "tracking needs confirm >= 1, reserve and patience >= 0 and 0 <= low <= high <= 1, not "
                f"{self.confirm}, {self.reserve}, {self.patience}, {self.low} and {self.high}"
            )
        if min(self.gate, self.density, self.speed) <= 0.0 or self.stranger < 0.0:
            raise ConfigError("tracking needs gate, density and speed above 0, and stranger of at least 0")


def tracking_settings(
    detector: str, *, high: float | None = None, low: float | None = None, **settings: Any
) -> TrackerSettings:
    """Return tracker settings for a detector, by default adapted to the scores that it reports.

    Args:
        detector: Its name, with or without options and label.
        high: As of `TrackerSettings`. If only one of `high` and `low` is given, the other one is adapted where they
            cross.
        low: As of `TrackerSettings`.
        settings: The other fields of `TrackerSettings`.

    Raises:
        ConfigError: high is below low, or a setting is out of its range.
    """
    defaults = TrackerSettings()
    usual_high, usual_low = SCORES.get(Reference.parse(detector).name, (defaults.high, defaults.low))
    if low is None:
        low = usual_low if high is None else min(usual_low, high)
    return TrackerSettings(high=max(usual_high, low) if high is None else high, low=low, **settings)


@dataclass(frozen=True, slots=True)
class KalmanTracks:
    """Table of the states of N tracks of all scenes; never modified in place.

    Attributes:
        scene: [N] index of the scene.
        ident: [N] number of the track in its scene, in order of creation.
        time: [N] time of the state, s.
        mean: [N, 4] x, y, vx, vy.
        covariance: [N, 4, 4].
        axis: [N, 2] weighted sum of the cosines and sines of twice the observed headings: the axis.
        heading: [N, 2] weighted sum of the cosines and sines of the observed headings: the direction.
        size: [N, 2] length and width, m.
        votes: [N, kinds] weighted scores by kind.
        score: [N] of the last hit.
        hits: [N] hits so far.
        missed: [N] looks since the last hit.
    """

    scene: I64
    ident: I64
    time: F64
    mean: F64
    covariance: F64
    axis: F64
    heading: F64
    size: F64
    votes: F64
    score: F64
    hits: I64
    missed: I64

    def __len__(self) -> int:
        return len(self.scene)

    def take(self, index: npt.NDArray[Any] | slice) -> Self:
        """Return the rows selected by indices, a mask or a slice."""
        return type(self)(**{column.name: getattr(self, column.name)[index] for column in fields(self)})

    def predict_to(self, time: F64, density: float) -> Self:
        """Predict the tracks to other times [N]."""
        mean, covariance = predict(self.mean, self.covariance, time - self.time, density)
        return replace(self, time=time.copy(), mean=mean, covariance=covariance)

    def to_tracks(self) -> Tracks:
        """Return the table that other parts of a driver read."""
        place, velocity = self.mean[:, :2], self.mean[:, 2:]
        return Tracks(self.scene, self.ident, place, velocity, self.yaw, self.size, self.kind, self.score)

    @property
    def kind(self) -> I64:
        """Kind with the most votes [N]."""
        return np.asarray(self.votes.argmax(1), np.int64)

    @property
    def yaw(self) -> F64:
        """Heading [N], rad: that of the motion where it is sure, else that of the observed body."""
        speed = np.hypot(self.mean[:, 2], self.mean[:, 3])
        speed_error = np.sqrt(np.maximum(0.5 * (self.covariance[:, 2, 2] + self.covariance[:, 3, 3]), 1e-12))
        course = np.arctan2(self.mean[:, 3], self.mean[:, 2])
        observed = (self.axis != 0.0).any(1)
        # Doubled angles make opposite headings equal; front and rear are decided below.
        weight = np.minimum((speed / speed_error / SURE) ** 2, 10.0)
        double_angle = self.axis + weight[:, None] * np.stack([np.cos(2 * course), np.sin(2 * course)], 1)
        yaw = 0.5 * np.arctan2(double_angle[:, 1], double_angle[:, 0])
        is_sure = speed > SURE * speed_error
        direction = np.where(is_sure[:, None], self.mean[:, 2:], self.heading)
        backwards = np.cos(yaw) * direction[:, 0] + np.sin(yaw) * direction[:, 1] < 0.0
        return np.where(observed, yaw + np.pi * backwards, course)


def no_kalman_tracks() -> KalmanTracks:
    """Return a table without rows."""
    floats, integers = np.zeros(0), np.zeros(0, np.int64)
    pairs, votes = np.zeros((0, 2)), np.zeros((0, len(AgentKind)))
    return KalmanTracks(
        integers,
        integers,
        floats,
        np.zeros((0, 4)),
        np.zeros((0, 4, 4)),
        pairs,
        pairs,
        pairs,
        votes,
        floats,
        integers,
        integers,
    )


class KalmanTracker:
    """Multi-object tracker of B scenes.

    Args:
        settings: Settings of the tracker.
        scenes: Number of scenes B.
    """

    def __init__(self, settings: TrackerSettings | None = None, scenes: int = 1) -> None:
        self.settings = settings or TrackerSettings()
        self.tracks = no_kalman_tracks()
        self._track_counts = np.zeros(scenes, np.int64)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget all tracks; one scene for each of the episodes."""
        self.tracks, self._track_counts = no_kalman_tracks(), np.zeros(len(episodes), np.int64)

    def snapshot(self) -> tuple[KalmanTracks, I64]:
        """Return the complete state; `restore` continues from it, bit by bit."""
        return self.tracks, self._track_counts.copy()

    def restore(self, snapshot: tuple[KalmanTracks, I64]) -> None:
        """Continue from an earlier snapshot."""
        self.tracks, self._track_counts = snapshot[0], snapshot[1].copy()

    def update(self, scenes: I64, times: F64, objects: Objects, poses: F64 | None = None) -> None:
        """Process the detections of one look at each of some scenes.

        Args:
            scenes: [n] the scenes, each once; where nothing was found, all tracks missed a look.
            times: [n] s of the looks, none before the last one of its scene.
            objects: The objects; those of other scenes do not count.
            poses: Not used: objects are in the world frame.
        """
        settings, look_times = self.settings, np.full(len(self._track_counts), np.nan)
        look_times[scenes] = times
        was_looked_at = np.isfinite(look_times[self.tracks.scene])
        tracks = self.tracks.predict_to(
            np.where(was_looked_at, look_times[self.tracks.scene], self.tracks.time), settings.density
        )
        objects = objects.take(np.isfinite(look_times[objects.scene]) & (objects.score >= settings.low))
        rows, hits = self._match(tracks, objects, np.sort(scenes))
        tracks = replace(tracks, missed=np.where(was_looked_at, tracks.missed + 1, tracks.missed))
        tracks = self._update_tracks(tracks, rows, objects.take(hits))
        unmatched = np.setdiff1d(np.flatnonzero(objects.score >= settings.high), hits)
        max_missed = np.where(tracks.hits >= settings.confirm, settings.reserve, settings.patience)
        tracks = tracks.take(tracks.missed <= max_missed)
        self.tracks = concatenate([tracks, self._new_tracks(objects.take(unmatched), look_times)])

    def _match(self, tracks: KalmanTracks, objects: Objects, scenes: I64) -> tuple[I64, I64]:
        """Rows of tracks and of objects that belong together, scene by scene."""
        settings = self.settings
        rows, track_begin, track_count = _group_by_scene(tracks.scene, scenes)
        hits, object_begin, object_count = _group_by_scene(objects.scene, scenes)
        # distances of all pairs of all scenes in one batch, ordered by scene, then by track
        pair_count = track_count * object_count
        pair_scene = np.repeat(np.arange(len(scenes)), pair_count)
        pair_number = np.arange(len(pair_scene)) - np.repeat(np.cumsum(pair_count) - pair_count, pair_count)
        track_index, object_index = (
            rows[track_begin[pair_scene] + pair_number // object_count[pair_scene]],
            hits[object_begin[pair_scene] + pair_number % object_count[pair_scene]],
        )
        distances = squared_distances(
            tracks.mean[track_index],
            tracks.covariance[track_index],
            objects.place[object_index],
            objects.covariance[object_index],
        )
        # Clipping at the gate keeps impossible pairs from distorting the optimal assignment.
        distances = np.minimum(
            distances + settings.stranger * (tracks.kind[track_index] != objects.kind[object_index]), settings.gate
        )
        confirmed, is_high = tracks.hits >= settings.confirm, objects.score >= settings.high
        stages = ((confirmed, is_high), (confirmed & (tracks.missed == 0), ~is_high), (~confirmed, is_high))
        track_matches: list[I64] = [np.zeros(0, np.int64)]
        object_matches: list[I64] = [np.zeros(0, np.int64)]
        free_tracks, free_objects = np.ones(len(tracks), bool), np.ones(len(objects), bool)
        offset = 0
        for scene_index in np.flatnonzero(pair_count).tolist():
            scene_tracks, scene_objects = (
                rows[track_begin[scene_index] : track_begin[scene_index] + track_count[scene_index]],
                hits[object_begin[scene_index] : object_begin[scene_index] + object_count[scene_index]],
            )
            cost = distances[offset : offset + pair_count[scene_index]].reshape(len(scene_tracks), len(scene_objects))
            offset += int(pair_count[scene_index])
            for track_mask, object_mask in stages:
                i, j = (
                    np.flatnonzero((track_mask & free_tracks)[scene_tracks]),
                    np.flatnonzero((object_mask & free_objects)[scene_objects]),
                )
                if len(i) and len(j):
                    stage_cost = cost[i[:, None], j]
                    matched_rows, matched_columns = linear_sum_assignment(stage_cost)
                    within_gate = stage_cost[matched_rows, matched_columns] < settings.gate
                    track_matches.append(scene_tracks[i[matched_rows[within_gate]]])
                    object_matches.append(scene_objects[j[matched_columns[within_gate]]])
                    free_tracks[track_matches[-1]], free_objects[object_matches[-1]] = False, False
        return np.concatenate(track_matches), np.concatenate(object_matches)

    def _update_tracks(self, tracks: KalmanTracks, rows: I64, hits: Objects) -> KalmanTracks:
        """Update tracks with their hits."""
        columns = {column.name: getattr(tracks, column.name).copy() for column in fields(tracks)}
        filtered = update(tracks.mean[rows], tracks.covariance[rows], hits.place, hits.covariance)
        columns["mean"][rows], columns["covariance"][rows] = filtered
        axis, heading, votes = _appearance_votes(hits)
        for name, value in (("axis", axis), ("heading", heading), ("votes", votes)):
            columns[name][rows] = MEMORY * columns[name][rows] + value
        columns["size"][rows] = MEMORY * columns["size"][rows] + (1.0 - MEMORY) * hits.size
        columns["score"][rows], columns["missed"][rows] = hits.score, 0
        columns["hits"][rows] += 1
        return KalmanTracks(**columns)

    def _new_tracks(self, objects: Objects, times: F64) -> KalmanTracks:
        """Start new tracks, numbered consecutively in each scene."""
        count = len(objects)
        numbers = np.zeros(count, np.int64)
        for scene in np.unique(objects.scene):
            in_scene = objects.scene == scene
            numbers[in_scene] = self._track_counts[scene] + np.arange(in_scene.sum())
            self._track_counts[scene] += in_scene.sum()
        has_velocity = np.asarray(np.isfinite(objects.velocity).all(1))
        mean = np.concatenate([objects.place, np.where(has_velocity[:, None], objects.velocity, 0.0)], 1)
        covariance = np.zeros((count, 4, 4))
        covariance[:, :2, :2] = objects.covariance
        covariance[:, 2, 2] = covariance[:, 3, 3] = self.settings.speed**2
        axis, heading, votes = _appearance_votes(objects)
        first_hits, no_misses = np.ones(count, np.int64), np.zeros(count, np.int64)
        return KalmanTracks(
            objects.scene,
            numbers,
            times[objects.scene],
            mean,
            covariance,
            axis,
            heading,
            objects.size,
            votes,
            objects.score,
            first_hits,
            no_misses,
        )

    def confirmed(self, scenes: I32 | I64, times: F64) -> Tracks:
        """Return the confirmed tracks of some scenes, each predicted to its scene's time.

        Args:
            scenes: [n] distinct scenes.
            times: [n] s.
        """
        scene_times = np.full(len(self._track_counts), np.nan)
        scene_times[scenes] = times
        selected = self.tracks.take(
            (self.tracks.hits >= self.settings.confirm) & np.isfinite(scene_times[self.tracks.scene])
        )
        return selected.predict_to(scene_times[selected.scene], self.settings.density).to_tracks()


def kalman_tracker(  # plain values, as they stand in a suite
    *,
    confirm: int = 2,
    reserve: int = 6,
    patience: int = 1,
    high: float = 0.3,
    low: float = 0.1,
    gate: float = 9.21,
    stranger: float = 3.0,
    density: float = 3.0,
    speed: float = 6.0,
) -> KalmanTracker:
    """Return the built-in tracker; its arguments are the fields of `TrackerSettings`.

    Raises:
        ConfigError: A setting is out of its range.
    """
    return KalmanTracker(
        TrackerSettings(
            confirm=confirm,
            reserve=reserve,
            patience=patience,
            high=high,
            low=low,
            gate=gate,
            stranger=stranger,
            density=density,
            speed=speed,
        )
    )


def _group_by_scene(scene: I64, scenes: I64) -> tuple[I64, I64, I64]:
    """Return rows ordered by scene, and the first position and number of rows of each given scene."""
    order = np.argsort(scene, kind="stable")
    begin, end = (np.searchsorted(scene[order], scenes, side=side) for side in ("left", "right"))
    return order, begin, end - begin


def _appearance_votes(objects: Objects) -> tuple[F64, F64, F64]:
    """Return the votes of detections for axis, heading and kind, weighted by the score; no heading, no vote."""
    yaw, has_yaw = np.nan_to_num(objects.yaw), np.isfinite(objects.yaw)
    weight = (objects.score * has_yaw)[:, None]
    axis = weight * np.stack([np.cos(2 * yaw), np.sin(2 * yaw)], 1)
    heading = weight * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    return axis, heading, objects.score[:, None] * np.eye(len(AgentKind))[objects.kind]
