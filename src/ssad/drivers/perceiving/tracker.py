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

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from ssad.core.driving import Belief
from ssad.core.errors import ConfigError
from ssad.core.registry import Reference
from ssad.core.types import F64, I32, AgentKind
from ssad.drivers.perceiving.kalman import distance, predict, update
from ssad.drivers.perceiving.objects import I64, Objects

MEMORY = 0.8  # what earlier sizes, kinds and headings weigh, at each hit
SCORES = {
    "fcos3d-light": (0.25, 0.1),
    "fcos3d-light-robust": (0.25, 0.1),
    "pgd-det-light": (0.13, 0.05),
}
"""High and low for detectors that score low."""
SURE = 2.0  # standard deviations of its speed above which the direction in which a track moves is its heading


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking:
    """Settings of the tracker.

    Attributes:
        confirm: Hits from which a track is believed (H).
        reserve: Looks without a hit that a confirmed track survives (R).
        patience: The same for a track that is not confirmed yet.
        high: Score from which an object is matched first, and may begin a track.
        low: Score below which objects do not count.
        gate: Squared Mahalanobis distance from which nothing matches; 9.21 loses 1 % of the true pairs.
        stranger: What is added to it where the kinds differ.
        density: Spectral density of the objects' acceleration, m^2/s^3.
        speed: Standard deviation of the speed of an object seen for the first time, m/s.
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


def tracking_of(detector: str, *, high: float | None = None, low: float | None = None, **settings: Any) -> Tracking:
    """Settings for a detector: unless others are said, from the scores that it gives.

    Args:
        detector: Its name, with or without options and label.
        high: As of `Tracking`. One of `high` and `low` alone takes the other along where they would cross.
        low: As of `Tracking`.
        settings: The other fields of `Tracking`.

    Raises:
        ConfigError: high is below low, or a setting is out of its range.
    """
    plain = Tracking()
    usual_high, usual_low = SCORES.get(Reference.of(detector).name, (plain.high, plain.low))
    if low is None:
        low = usual_low if high is None else min(usual_low, high)
    return Tracking(high=max(usual_high, low) if high is None else high, low=low, **settings)


@dataclass(frozen=True, slots=True)
class Tracks:
    """N tracks of all scenes; never changed in place.

    Attributes:
        scene: [N] which scene.
        ident: [N] number of the track in its scene, in the order in which they began.
        time: [N] s that the state belongs to.
        mean: [N, 4] x, y, vx, vy.
        covariance: [N, 4, 4].
        axis: [N, 2] weighted sum of the cosines and sines of twice the headings seen: which way it lies.
        heading: [N, 2] weighted sum of the cosines and sines of the headings seen: which way it looks.
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
        """The rows that `index` (numbers, a mask or a slice) names."""
        return type(self)(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def at(self, time: F64, density: float) -> Self:
        """The same tracks at other times [N]."""
        mean, covariance = predict(self.mean, self.covariance, time - self.time, density)
        return replace(self, time=time.copy(), mean=mean, covariance=covariance)

    @property
    def kind(self) -> I64:
        """[N] the kind that has most votes."""
        return np.asarray(self.votes.argmax(1), np.int64)

    @property
    def yaw(self) -> F64:
        """[N] heading: of its motion where that is sure, of its body as seen otherwise, rad."""
        moves = np.hypot(self.mean[:, 2], self.mean[:, 3])
        error = np.sqrt(np.maximum(0.5 * (self.covariance[:, 2, 2] + self.covariance[:, 3, 3]), 1e-12))
        course = np.arctan2(self.mean[:, 3], self.mean[:, 2])
        seen = (self.axis != 0.0).any(1)
        weight = np.minimum((moves / error / SURE) ** 2, 10.0)
        twice = self.axis + weight[:, None] * np.stack([np.cos(2 * course), np.sin(2 * course)], 1)
        yaw = 0.5 * np.arctan2(twice[:, 1], twice[:, 0])
        sure = moves > SURE * error
        ahead = np.where(sure[:, None], self.mean[:, 2:], self.heading)
        backwards = np.cos(yaw) * ahead[:, 0] + np.sin(yaw) * ahead[:, 1] < 0.0
        return np.where(seen, yaw + np.pi * backwards, course)


def no_tracks() -> Tracks:
    """A table without rows."""
    none, whole = np.zeros(0), np.zeros(0, np.int64)
    wide, votes = np.zeros((0, 2)), np.zeros((0, len(AgentKind)))
    return Tracks(
        whole, whole, none, np.zeros((0, 4)), np.zeros((0, 4, 4)), wide, wide, wide, votes, none, whole, whole
    )


class Tracker:
    """Follows objects in B scenes.

    Args:
        settings: Its settings.
        scenes: B.
    """

    def __init__(self, settings: Tracking | None = None, scenes: int = 1) -> None:
        self.settings = settings or Tracking()
        self.tracks = no_tracks()
        self._born = np.zeros(scenes, np.int64)

    def snapshot(self) -> tuple[Tracks, I64]:
        """All that changes; `restore` goes on from there, to the bit."""
        return self.tracks, self._born.copy()

    def restore(self, snapshot: tuple[Tracks, I64]) -> None:
        """Go on from an earlier moment."""
        self.tracks, self._born = snapshot[0], snapshot[1].copy()

    def update(self, scenes: I64, times: F64, found: Objects) -> None:
        """Take in what was found in one look at each of some scenes.

        Args:
            scenes: [n] the scenes, each once; where nothing was found, all tracks missed a look.
            times: [n] s of the looks, none before the last one of its scene.
            found: The objects; those of other scenes do not count.
        """
        own, when = self.settings, np.full(len(self._born), np.nan)
        when[scenes] = times
        looked = np.isfinite(when[self.tracks.scene])
        tracks = self.tracks.at(np.where(looked, when[self.tracks.scene], self.tracks.time), own.density)
        found = found.take(np.isfinite(when[found.scene]) & (found.score >= own.low))
        rows, hits = self._matched(tracks, found, np.sort(scenes))
        tracks = replace(tracks, missed=np.where(looked, tracks.missed + 1, tracks.missed))
        tracks = self._with_hits(tracks, rows, found.take(hits))
        left = np.setdiff1d(np.flatnonzero(found.score >= own.high), hits)
        limit = np.where(tracks.hits >= own.confirm, own.reserve, own.patience)
        tracks = tracks.take(tracks.missed <= limit)
        self.tracks = _joined(tracks, self._begun(found.take(left), when))

    def _matched(self, tracks: Tracks, found: Objects, scenes: I64) -> tuple[I64, I64]:
        """Rows of tracks and of objects that belong together, scene by scene."""
        own = self.settings
        rows, begin, count = _by_scene(tracks.scene, scenes)
        hits, first, many = _by_scene(found.scene, scenes)
        # all pairs of all scenes in one go, the pairs of a scene one after the other, track by track
        size = count * many
        line = np.repeat(np.arange(len(scenes)), size)
        number = np.arange(len(line)) - np.repeat(np.cumsum(size) - size, size)
        a, b = rows[begin[line] + number // many[line]], hits[first[line] + number % many[line]]
        far = distance(tracks.mean[a], tracks.covariance[a], found.place[b], found.spread[b])
        far = np.minimum(far + own.stranger * (tracks.kind[a] != found.kind[b]), own.gate)
        confirmed, high = tracks.hits >= own.confirm, found.score >= own.high
        stages = ((confirmed, high), (confirmed & (tracks.missed == 0), ~high), (~confirmed, high))
        one: list[I64] = [np.zeros(0, np.int64)]
        other: list[I64] = [np.zeros(0, np.int64)]
        free, open_ = np.ones(len(tracks), bool), np.ones(len(found), bool)
        at = 0
        for k in np.flatnonzero(size).tolist():
            r, h = rows[begin[k] : begin[k] + count[k]], hits[first[k] : first[k] + many[k]]
            cost = far[at : at + size[k]].reshape(len(r), len(h))
            at += int(size[k])
            for wanted, offered in stages:
                i, j = np.flatnonzero((wanted & free)[r]), np.flatnonzero((offered & open_)[h])
                if len(i) and len(j):
                    part = cost[i[:, None], j]
                    m, n = linear_sum_assignment(part)
                    good = part[m, n] < own.gate
                    one.append(r[i[m[good]]])
                    other.append(h[j[n[good]]])
                    free[one[-1]], open_[other[-1]] = False, False
        return np.concatenate(one), np.concatenate(other)

    def _with_hits(self, tracks: Tracks, rows: I64, hits: Objects) -> Tracks:
        """Tracks after their hits."""
        out = {f.name: getattr(tracks, f.name).copy() for f in fields(tracks)}
        moved = update(tracks.mean[rows], tracks.covariance[rows], hits.place, hits.spread)
        out["mean"][rows], out["covariance"][rows] = moved
        axis, heading, votes = _looks(hits)
        for name, value in (("axis", axis), ("heading", heading), ("votes", votes)):
            out[name][rows] = MEMORY * out[name][rows] + value
        out["size"][rows] = MEMORY * out["size"][rows] + (1.0 - MEMORY) * hits.size
        out["score"][rows], out["missed"][rows] = hits.score, 0
        out["hits"][rows] += 1
        return Tracks(**out)

    def _begun(self, found: Objects, when: F64) -> Tracks:
        """New tracks, numbered on in each scene."""
        n = len(found)
        order = np.zeros(n, np.int64)
        for scene in np.unique(found.scene):
            own = found.scene == scene
            order[own] = self._born[scene] + np.arange(own.sum())
            self._born[scene] += own.sum()
        known = np.asarray(np.isfinite(found.velocity).all(1))
        mean = np.concatenate([found.place, np.where(known[:, None], found.velocity, 0.0)], 1)
        covariance = np.zeros((n, 4, 4))
        covariance[:, :2, :2] = found.spread
        covariance[:, 2, 2] = covariance[:, 3, 3] = self.settings.speed**2
        axis, heading, votes = _looks(found)
        once, none = np.ones(n, np.int64), np.zeros(n, np.int64)
        return Tracks(
            found.scene,
            order,
            when[found.scene],
            mean,
            covariance,
            axis,
            heading,
            found.size,
            votes,
            found.score,
            once,
            none,
        )

    def confirmed(self, scenes: I32 | I64, times: F64) -> Tracks:
        """The confirmed tracks of some scenes, each at its scene's time.

        Args:
            scenes: [n] each once.
            times: [n] s.
        """
        when = np.full(len(self._born), np.nan)
        when[scenes] = times
        chosen = self.tracks.take((self.tracks.hits >= self.settings.confirm) & np.isfinite(when[self.tracks.scene]))
        return chosen.at(when[chosen.scene], self.settings.density)


def believed(tracks: Tracks, scenes: I32 | I64) -> Belief:
    """Tracks as what the planner plans over: pose, speed, size and kind.

    Args:
        tracks: Tracks of these scenes and of no others.
        scenes: [N] scene of each row of the belief.
    """
    row = np.full(int(np.max(scenes, initial=-1)) + 1, -1)
    row[scenes] = np.arange(len(scenes))
    at = row[tracks.scene]
    order = np.argsort(at, kind="stable")
    tracks, at = tracks.take(order), at[order]
    count = np.bincount(at, minlength=len(scenes))
    slot = np.arange(len(tracks)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(scenes), max(int(count.max(initial=0)), 1))
    pose, size = np.zeros((*shape, 3), np.float32), np.ones((*shape, 2), np.float32)
    speed, kind = np.zeros(shape, np.float32), np.full(shape, int(AgentKind.NONE), np.int32)
    yaw = tracks.yaw
    pose[at, slot, :2], pose[at, slot, 2] = tracks.mean[:, :2], yaw
    speed[at, slot] = tracks.mean[:, 2] * np.cos(yaw) + tracks.mean[:, 3] * np.sin(yaw)
    size[at, slot], kind[at, slot] = tracks.size, tracks.kind
    return Belief(pose, speed, size, kind)


def _by_scene(scene: I64, scenes: I64) -> tuple[I64, I64, I64]:
    """Rows ordered by scene, and for each of some scenes where its rows begin in that order and how many they are."""
    order = np.argsort(scene, kind="stable")
    begin, end = (np.searchsorted(scene[order], scenes, side=side) for side in ("left", "right"))
    return order, begin, end - begin


def _looks(found: Objects) -> tuple[F64, F64, F64]:
    """What a look says of heading (twice, once) and kind, weighed by the score; no heading: nothing."""
    yaw, known = np.nan_to_num(found.yaw), np.isfinite(found.yaw)
    weight = (found.score * known)[:, None]
    axis = weight * np.stack([np.cos(2 * yaw), np.sin(2 * yaw)], 1)
    heading = weight * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    return axis, heading, found.score[:, None] * np.eye(len(AgentKind))[found.kind]


def _joined(one: Tracks, other: Tracks) -> Tracks:
    return Tracks(**{f.name: np.concatenate([getattr(one, f.name), getattr(other, f.name)]) for f in fields(one)})
