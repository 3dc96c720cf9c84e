"""How well a driving system perceived in the very drive that it drove, and what went wrong before it collided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ssad.core.driving import Belief
from ssad.core.frames import Camera
from ssad.core.rotations import upright_poses
from ssad.core.types import F64, U8, AgentKind, Bool, EpisodeTrace
from ssad.drivers.belief import in_sight
from ssad.drivers.perceiving.driver import Known, Sighting
from ssad.drivers.perceiving.objects import I64, Objects
from ssad.drivers.perceiving.signs import SAME
from ssad.drivers.perceiving.tracker import Tracks
from ssad.metrics.detection import match
from ssad.metrics.detection_boxes import BoxTable
from ssad.metrics.tracking import ENOUGH, TrackedFrame, similarity_of, track_scores

NEAR: Final = (
    2.0  # m from the middle of an object within which it counts as found (as NeuroNCAP's recall of the target)
)
ROUGH: Final = 5.0  # m within which something was found, but in the wrong place
BANDS: Final = ((0.0, 15.0), (15.0, 30.0), (30.0, 60.0))  # m
REACH: Final = 60.0  # m
# m ahead within which a stop sign should be read: the sizes that attacks on signs are made at, and those met before
SIGN_BANDS: Final = ((5.0, 20.0), (20.0, 40.0))
BEFORE: Final = 3.0  # s before a collision that are looked at
CAUSES: Final[Mapping[str, str]] = {
    "hidden": "out of the cameras' view or hidden",
    "missed": "in view, not found",
    "misplaced": f"found more than {NEAR:g} m away from where it was",
    "late": "found, not believed yet (latency, hits to confirm)",
    "known": "believed, within 2 m of where it was",
}
"""What an object was to the driver at a step, from the worst to the best."""


@dataclass(frozen=True, eq=False)
class Perceived:
    """What a driver saw and believed in one drive.

    Attributes:
        looks: For each look its time, s, and what was found; None where there was no picture.
        known: For each step its time, s, and the confirmed tracks.
        cameras: Through which it looked.
        signs: For each look its time, s, and where the stop signs stand that were read [M, 2].
    """

    looks: Sequence[tuple[float, Objects | None]]
    known: Sequence[tuple[float, Tracks]]
    cameras: Mapping[str, Camera]
    signs: Sequence[tuple[float, F64]] = ()


class Watcher:
    """Keeps what a driver sees and believes, by scene, and a few pictures of each drive.

    Args:
        cameras: Of the driver.
        scenes: How many.
        every: s from one picture that is kept to the next, at least; the last one is always kept. None: none are kept.
    """

    def __init__(self, cameras: Mapping[str, Any], scenes: int, every: float | None = 0.5) -> None:
        self.cameras, self.every = cameras, every
        self.looks: list[list[Any]] = [[] for _ in range(scenes)]
        self.known: list[list[Any]] = [[] for _ in range(scenes)]
        self._shots: list[list[tuple[float, Any]]] = [[] for _ in range(scenes)]
        self.signs: list[list[tuple[float, F64]]] = [[] for _ in range(scenes)]

    def __call__(self, told: Sighting | Known) -> None:
        """See `Perceiving`."""
        if isinstance(told, Sighting):
            self.looks[told.scene].append((told.time, told.found))
            if told.signs is not None:
                self.signs[told.scene].append((told.time, told.signs))
            if self.every is not None:
                for picture in list(told.pictures.values())[:1]:
                    self._keep(self._shots[told.scene], told.time, picture, self.every)
            return
        tracks = told.tracks.take(np.argsort(told.tracks.scene, kind="stable"))
        ends = (np.searchsorted(tracks.scene, told.scene, side=side).tolist() for side in ("left", "right"))
        for scene, time, begin, end in zip(told.scene.tolist(), told.time.tolist(), *ends, strict=True):
            self.known[scene].append((time, tracks.take(slice(begin, end))))

    @staticmethod
    def _keep(shots: list[tuple[float, Any]], time: float, picture: Any, every: float) -> None:
        """The last picture stays as it came, often on a GPU, until it is known that it is kept."""
        if len(shots) > 1 and shots[-1][0] - shots[-2][0] < every - 1e-4:
            shots[-1] = time, picture
            return
        if shots:
            shots[-1] = shots[-1][0], _upright(shots[-1][1])
        shots.append((time, picture))

    def shots(self, scene: int) -> list[tuple[float, U8]]:
        """Pictures [H, W, 3] that the driver of a scene got, with their times, s."""
        return [(time, _upright(picture)) for time, picture in self._shots[scene]]

    def perceived(self, scene: int) -> Perceived:
        """What was perceived in a scene."""
        return Perceived(self.looks[scene], self.known[scene], self.cameras, self.signs[scene])


def _upright(picture: Any) -> U8:
    """A picture [3, H, W], or one that is [H, W, 3] already, as an array [H, W, 3] of its own."""
    if hasattr(picture, "cpu"):
        picture = picture.cpu().numpy()
    return np.ascontiguousarray(np.moveaxis(picture, 0, -1)) if picture.shape[0] == 3 else picture


def in_view(trace: EpisodeTrace, steps: Sequence[int], cameras: Mapping[str, Camera]) -> Bool:
    """Which agents [N, A] the ego's cameras can see at N steps: not hidden, near enough, their middle in a picture."""
    at = np.asarray(steps, np.int64)
    kind = np.where(trace.active[at], trace.kind, int(AgentKind.NONE)).astype(np.int32)
    kind[:, 0] = AgentKind.NONE
    pose = np.stack([trace.x[at], trace.y[at], trace.yaw[at]], -1)
    size = np.stack([trace.length, trace.width], -1)
    truth = Belief(pose.astype(np.float32), trace.speed[at], np.broadcast_to(size, (len(at), *size.shape)), kind)
    seen = in_sight(pose[:, 0, :2].astype(np.float32), truth, REACH)
    egos = upright_poses(pose[:, 0].astype(np.float64))
    ones = np.ones(kind.shape)
    places = np.stack([pose[..., 0], pose[..., 1], 0.8 * ones, ones], -1)
    inside = np.zeros(kind.shape, bool)
    for camera in cameras.values():
        to_camera = np.linalg.inv(egos @ camera.to_ego)
        across, ahead = (np.einsum("nak,nk->na", places, to_camera[:, row]) for row in (0, 2))
        column = across / np.maximum(ahead, 1e-6) * camera.intrinsic[0, 0] + camera.intrinsic[0, 2]
        inside |= (ahead > 0.5) & (column >= 0) & (column < camera.width)
    return np.asarray(seen & inside)


def _steps(trace: EpisodeTrace, told: Sequence[tuple[float, Any]]) -> list[int]:
    """The steps of what was noted at times."""
    return [min(round(time / trace.dt), len(trace.x) - 1) for time, _ in told]


def object_that_matters(trace: EpisodeTrace) -> int | None:
    """The agent that the ego touches first, or else the one that it comes nearest to; None: there is nobody else."""
    touched = trace.contact_agent[trace.contact_agent > 0]
    if len(touched):
        return int(touched[0])
    if len(trace.kind) < 2:
        return None
    gap = np.hypot(trace.x[:, 1:] - trace.x[:, :1], trace.y[:, 1:] - trace.y[:, :1])
    gap = np.where(trace.active[:, 1:], gap - 0.5 * trace.length[1:], np.inf)
    best = int(gap.min(0).argmin())
    return best + 1 if np.isfinite(gap[:, best]).any() else None


def component_metrics(trace: EpisodeTrace, seen: Perceived, *, sure: float) -> dict[str, float | None]:
    """Numbers of the component on the frames of a drive; None where there was nothing to measure.

    Args:
        trace: The drive.
        seen: What was perceived in it.
        sure: Score from which an object that is not there is a phantom.

    Returns:
        AP: average precision of all kinds together, the mean of those within 0.5, 1, 2 and 4 m. recall: of the objects
        in view; missed_burst: looks in a row that one of them is missed, on average; distance_share: RMS error of the
        distance of those that were found roughly, as a share of it. target_recall, and by band of distance: of the
        object that matters. distance_error: of that object where it was found roughly, m. phantoms: objects a look
        that are not there. believed: share of the steps with the object that matters in view in which it is believed
        where it is. switches: changes of its track. HOTA, MOTA and IDF1: see `track_metrics`.
    """
    target = object_that_matters(trace)
    found_of: list[tuple[float, bool, float]] = []  # distance, found, error of the distance
    hits, there, phantoms, looks = 0, 0, 0, 0
    tables: list[tuple[F64, Bool, Objects | None]] = []
    missed: list[Bool] = []
    shares: list[F64] = []
    steps = _steps(trace, seen.looks)
    for (_, found), step, view in zip(seen.looks, steps, in_view(trace, steps, seen.cameras), strict=True):
        place = np.stack([trace.x[step], trace.y[step]], -1).astype(np.float64)
        tables.append((place, view, found))
        looks += 1
        got = np.zeros((0, 2)) if found is None else found.place
        gap = np.linalg.norm(place[:, None] - got[None], axis=-1) if len(got) else np.full((len(place), 1), np.inf)
        nearest = gap.min(1)
        missed.append(view & (nearest >= NEAR))
        if rough := np.flatnonzero(view & (nearest < ROUGH)).tolist():
            far = np.linalg.norm(place[rough] - place[0], axis=1)
            told = np.linalg.norm(got[gap[rough].argmin(1)] - place[0], axis=1)
            shares.append(told / far - 1.0)
        there, hits = there + int(view.sum()), hits + int((nearest[view] < NEAR).sum())
        if found is not None and len(got):
            others = trace.active[step].copy()
            others[0] = False
            lone = gap[others].min(0, initial=np.inf) > ROUGH
            phantoms += int((lone & (found.score >= sure)).sum())
        if target is not None and view[target]:
            away = float(np.linalg.norm(place[target] - place[0]))
            error = np.nan
            if nearest[target] < ROUGH:
                error = abs(float(np.linalg.norm(got[gap[target].argmin()] - place[0])) - away)
            found_of.append((away, bool(nearest[target] < NEAR), error))
    rows = np.array(found_of, float).reshape(-1, 3)
    metrics: dict[str, float | None] = {
        "AP": average_precision(tables),
        "recall": hits / there if there else None,
        "missed_burst": _burst(missed),
        "distance_share": float(np.sqrt(np.mean(np.concatenate(shares) ** 2))) if shares else None,
        "target_recall": _mean(rows[:, 1]),
        "distance_error": _mean(rows[np.isfinite(rows[:, 2]), 2]),
        "phantoms": phantoms / looks if looks else None,
    }
    for low, high in BANDS:
        metrics[f"target_recall_{low:.0f}_{high:.0f}"] = _mean(rows[(rows[:, 0] >= low) & (rows[:, 0] < high), 1])
    return metrics | _belief_metrics(trace, seen, target) | track_metrics(trace, seen)


def _burst(missed: Sequence[Bool]) -> float | None:
    """Looks in a row that an object is missed, on average over all times that one is; `missed` [A] for each look."""
    table = np.array(missed, bool)
    if not table.any():
        return None
    begun = table & ~np.concatenate([np.zeros_like(table[:1]), table[:-1]])
    return float(table.sum() / begun.sum())


def track_metrics(trace: EpisodeTrace, seen: Perceived) -> dict[str, float | None]:
    """HOTA, MOTA and IDF1 of what is believed against who is in view, within 2 m; None: nobody ever was.

    A track on somebody who is out of view, whom the driver may well remember, counts neither for nor against.
    """
    frames, steps = [], _steps(trace, seen.known)
    for (_, tracks), step, view in zip(seen.known, steps, in_view(trace, steps, seen.cameras), strict=True):
        place = np.stack([trace.x[step], trace.y[step]], -1).astype(np.float64)
        likeness = similarity_of(place, tracks.mean[:, :2], 2.0 * NEAR)
        others = trace.active[step] & ~view
        others[0] = False
        best = likeness[view].max(0, initial=0.0)
        kept = (best >= likeness[others].max(0, initial=0.0)) | (likeness[others].max(0, initial=0.0) < ENOUGH)
        frames.append(TrackedFrame(np.flatnonzero(view), tracks.ident[kept], likeness[view][:, kept]))
    scores = track_scores(frames)
    if scores is None:
        return dict.fromkeys(("HOTA", "MOTA", "IDF1"))
    return {"HOTA": scores.hota, "MOTA": scores.mota, "IDF1": scores.idf1}


def sign_metrics(trace: EpisodeTrace, seen: Perceived, signs: F64) -> dict[str, float | None]:
    """How well stop signs were read on the frames of a drive; None where none stood before the ego.

    Args:
        trace: The drive.
        seen: What was perceived in it.
        signs: Where the stop signs stand that the route comes by, x, y [N, 2].

    Returns:
        sign_recall: share of the looks with such a sign 5 to 40 m ahead in which it was read; sign_recall_5_20 and so
        on: the same within a band of `SIGN_BANDS`. sign_read_at: m from the sign at which one was first read.
    """
    looks: list[tuple[float, bool]] = []  # m to the sign ahead, whether it was read
    for time, places in seen.signs:
        step = min(round(time / trace.dt), len(trace.x) - 1)
        ego = np.array([trace.x[step, 0], trace.y[step, 0]], np.float64)
        yaw = float(trace.yaw[step, 0])
        away = signs - ego
        ahead = away @ (np.cos(yaw), np.sin(yaw))
        aside = np.abs(away @ (-np.sin(yaw), np.cos(yaw)))
        near = np.flatnonzero((ahead > SIGN_BANDS[0][0]) & (ahead < SIGN_BANDS[-1][1]) & (aside < 0.5 * ahead))
        if len(near):
            sign = near[ahead[near].argmin()]
            apart = float(np.linalg.norm(away[sign]))
            gap = np.linalg.norm(places - signs[sign], axis=1).min(initial=np.inf)
            looks.append((apart, bool(gap < SAME * apart + 1.0)))
    rows = np.array(looks, float).reshape(-1, 2)
    found: dict[str, float | None] = {"sign_recall": _mean(rows[:, 1])}
    for low, high in SIGN_BANDS:
        found[f"sign_recall_{low:.0f}_{high:.0f}"] = _mean(rows[(rows[:, 0] >= low) & (rows[:, 0] < high), 1])
    return found | {"sign_read_at": max((apart for apart, read in looks if read), default=None)}


def average_precision(looks: Sequence[tuple[F64, Bool, Objects | None]]) -> float | None:
    """AP over looks, all kinds as one, the mean over nuScenes' four distances; None: nothing was in view.

    What is not in view and yet found counts neither for nor against.

    Args:
        looks: Places of all agents [A, 2], which are in view [A], and what was found.
    """
    real, told = [], []
    for number, (place, view, found) in enumerate(looks):
        real.append((np.full(int(view.sum()), number), place[view], np.full(int(view.sum()), -1.0)))
        if found is not None and len(found):
            gap = np.linalg.norm(found.place[:, None] - place[None, 1:], axis=-1)
            unseen = gap[:, ~view[1:]].min(1, initial=np.inf) < np.minimum(
                gap[:, view[1:]].min(1, initial=np.inf), NEAR
            )
            told.append((np.full(len(found), number)[~unseen], found.place[~unseen], found.score[~unseen]))
    truth, predicted = _table(real), _table(told)
    if not len(truth):
        return None
    scores = match(truth, predicted, samples=len(looks)).scores()
    return float(scores.mean_dist_aps["car"])


def cause_of_collision(trace: EpisodeTrace, seen: Perceived) -> dict[str, Any] | None:
    """What the object that was hit was to the driver in the three seconds before; None: there was no collision.

    Returns:
        cause: the commonest of `CAUSES` from 3 s to 0.5 s before the contact; of equal ones the worse. unknown_s: for
        how long before the contact it was not believed where it was, at most 3 s. shares: of the steps, by cause.
    """
    struck = np.flatnonzero(trace.contact_agent > 0)
    if not len(struck):
        return None
    end = int(struck[0])
    agent = int(trace.contact_agent[end])
    states = [_state(trace, step, agent, seen) for step in range(max(end - round(BEFORE / trace.dt), 0), end)]
    if not states:
        return None
    unknown = 0
    while unknown < len(states) and states[-1 - unknown] != "known":
        unknown += 1
    early = states[: max(len(states) - round(0.5 / trace.dt), 1)]
    shares = {name: early.count(name) / len(early) for name in CAUSES}
    cause = max(CAUSES, key=lambda name: shares[name])
    return {"cause": cause, "unknown_s": round(unknown * trace.dt, 3), "shares": shares, "agent": trace.names[agent]}


def impact_speed(trace: EpisodeTrace) -> float | None:
    """Speed of the ego against who it touches first, just before, m/s; None: there was no collision with an agent."""
    struck = np.flatnonzero(trace.contact_agent > 0)
    if not len(struck):
        return None
    step = max(int(struck[0]) - 1, 0)
    agent = int(trace.contact_agent[struck[0]])
    velocity = trace.speed[step] * np.stack([np.cos(trace.yaw[step]), np.sin(trace.yaw[step])])
    return float(np.hypot(*(velocity[:, 0] - velocity[:, agent])))


def hard_braking(trace: EpisodeTrace, limit: float = 4.0) -> int:
    """How often the ego began to brake harder than a limit, m/s^2."""
    hard = trace.accel < -limit
    return int((hard & ~np.concatenate([[False], hard[:-1]])).sum())


def phantom_stop(trace: EpisodeTrace, seen: Perceived) -> float:
    """Seconds that the ego stood (below 0.5 m/s) with something on the road ahead, within 20 m, that is not there."""
    total = 0.0
    for time, tracks in seen.known:
        step = min(round(time / trace.dt), len(trace.x) - 1)
        if trace.speed[step, 0] > 0.5 or not len(tracks):
            continue
        yaw = float(trace.yaw[step, 0])
        apart = tracks.mean[:, :2] - (trace.x[step, 0], trace.y[step, 0])
        ahead, aside = apart @ (np.cos(yaw), np.sin(yaw)), apart @ (-np.sin(yaw), np.cos(yaw))
        others = np.flatnonzero(trace.active[step])[1:]
        place = np.stack([trace.x[step, others], trace.y[step, others]], -1)
        gap = np.linalg.norm(tracks.mean[:, None, :2] - place[None], axis=-1).min(1, initial=np.inf)
        total += trace.dt * bool(((ahead > 0) & (ahead < 20.0) & (np.abs(aside) < 2.5) & (gap > ROUGH)).any())
    return total


def _belief_metrics(trace: EpisodeTrace, seen: Perceived, target: int | None) -> dict[str, float | None]:
    believed, idents, steps = [], [], _steps(trace, seen.known)
    for (_, tracks), step, view in zip(seen.known, steps, in_view(trace, steps, seen.cameras), strict=True):
        if target is None or not view[target]:
            continue
        gap = _gaps(tracks, trace, step, target)
        believed.append(float(gap.min(initial=np.inf) < NEAR))
        if believed[-1]:
            idents.append(int(tracks.ident[gap.argmin()]))
    switches = float(np.count_nonzero(np.diff(idents))) if idents else None
    return {"believed": _mean(np.array(believed)), "switches": switches}


def _state(trace: EpisodeTrace, step: int, agent: int, seen: Perceived) -> str:
    """Which of `CAUSES` an agent is at a step."""
    time = step * trace.dt
    for then, tracks in seen.known:
        if abs(then - time) < 0.5 * trace.dt and _gaps(tracks, trace, step, agent).min(initial=np.inf) < NEAR:
            return "known"
    if not in_view(trace, [step], seen.cameras)[0, agent]:
        return "hidden"
    last = [found for then, found in seen.looks if then <= time + 0.5 * trace.dt][-1:]
    if not last or last[0] is None or not len(last[0]):
        return "missed"
    place = np.array([trace.x[step, agent], trace.y[step, agent]])
    nearest = float(np.linalg.norm(last[0].place - place, axis=1).min())
    return "late" if nearest < NEAR else "misplaced" if nearest < ROUGH else "missed"


def _gaps(tracks: Tracks, trace: EpisodeTrace, step: int, agent: int) -> F64:
    return np.asarray(np.linalg.norm(tracks.mean[:, :2] - (trace.x[step, agent], trace.y[step, agent]), axis=1))


def _mean(values: F64) -> float | None:
    return float(values.mean()) if len(values) else None


def _table(parts: Sequence[tuple[I64, F64, F64]]) -> BoxTable:
    """Boxes of one class, of which only the place counts."""
    if not parts:
        return BoxTable.empty()
    sample, place, score = (np.concatenate(column) for column in zip(*parts, strict=True))
    table = BoxTable.empty(len(sample))
    table.sample[:], table.score[:] = sample, score
    table.centre[:, :2] = place
    table.size_lwh[:] = 1.0
    table.rotation[:, 0] = 1.0
    return table
