"""Perception of a driving system in the very drive that it drove, and the causes of its collisions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ssad.core.driving import Belief
from ssad.core.frames import Camera
from ssad.core.perception import I64, SIGN_MATCH_SHARE, DrivePerception, Objects, Tracks
from ssad.core.rotations import upright_poses
from ssad.core.types import F64, AgentKind, Bool, EpisodeTrace
from ssad.core.visibility import is_visible
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


def in_view(trace: EpisodeTrace, steps: Sequence[int], cameras: Mapping[str, Camera]) -> Bool:
    """Return the agents [N, A] in view of the ego's cameras at N steps: near, not hidden, their middle in an image.

    Without cameras (a perceiver of LiDAR or radar) all agents that are near and not hidden count.
    """
    step_indices = np.asarray(steps, np.int64)
    kind = np.where(trace.active[step_indices], trace.kind, int(AgentKind.NONE)).astype(np.int32)
    kind[:, 0] = AgentKind.NONE
    pose = np.stack([trace.x[step_indices], trace.y[step_indices], trace.yaw[step_indices]], -1)
    size = np.stack([trace.length, trace.width], -1)
    truth = Belief(
        pose.astype(np.float32),
        trace.speed[step_indices],
        np.broadcast_to(size, (len(step_indices), *size.shape)),
        kind,
    )
    is_unoccluded = is_visible(pose[:, 0, :2].astype(np.float32), truth, REACH)
    if not cameras:
        return np.asarray(is_unoccluded)
    ego_poses = upright_poses(pose[:, 0].astype(np.float64))
    homogeneous_ones = np.ones(kind.shape)
    homogeneous = np.stack([pose[..., 0], pose[..., 1], 0.8 * homogeneous_ones, homogeneous_ones], -1)
    in_image = np.zeros(kind.shape, bool)
    for camera in cameras.values():
        to_camera = np.linalg.inv(ego_poses @ camera.to_ego)
        lateral, depth = (np.einsum("nak,nk->na", homogeneous, to_camera[:, axis]) for axis in (0, 2))
        pixel_column = lateral / np.maximum(depth, 1e-6) * camera.intrinsic[0, 0] + camera.intrinsic[0, 2]
        in_image |= (depth > 0.5) & (pixel_column >= 0) & (pixel_column < camera.width)
    return np.asarray(is_unoccluded & in_image)


def _steps(trace: EpisodeTrace, records: Sequence[tuple[float, Any]]) -> list[int]:
    """Return the steps of records with times."""
    return [min(round(time / trace.dt), len(trace.x) - 1) for time, _ in records]


def relevant_agent(trace: EpisodeTrace) -> int | None:
    """The agent that the ego touches first, or else the one that it comes nearest to; None: there is nobody else."""
    struck_agents = trace.contact_agent[trace.contact_agent > 0]
    if len(struck_agents):
        return int(struck_agents[0])
    if len(trace.kind) < 2:
        return None
    distances = np.hypot(trace.x[:, 1:] - trace.x[:, :1], trace.y[:, 1:] - trace.y[:, :1])
    distances = np.where(trace.active[:, 1:], distances - 0.5 * trace.length[1:], np.inf)
    nearest_agent = int(distances.min(0).argmin())
    return nearest_agent + 1 if np.isfinite(distances[:, nearest_agent]).any() else None


def component_metrics(
    trace: EpisodeTrace, perceived: DrivePerception, *, phantom_score: float
) -> dict[str, float | None]:
    """Numbers of the component on the frames of a drive; None where there was nothing to measure.

    Args:
        trace: The drive.
        perceived: What was perceived in it.
        phantom_score: Score from which an object that is not there is a phantom.

    Returns:
        AP: average precision of all kinds together, the mean of those within 0.5, 1, 2 and 4 m. recall: of the objects
        in view; missed_burst: looks in a row that one of them is missed, on average; distance_share: RMS error of the
        distance of those that were found roughly, as a share of it. target_recall, and by band of distance: of the
        object that matters. distance_error: of that object where it was found roughly, m. phantoms: objects a look
        that are not there. believed: share of the steps with the object that matters in view in which it is believed
        where it is. switches: changes of its track. HOTA, MOTA and IDF1: see `track_metrics`.
    """
    critical = relevant_agent(trace)
    critical_looks: list[tuple[float, bool, float]] = []  # distance, found, error of the distance
    hit_count, visible_count, phantom_count, look_count = 0, 0, 0, 0
    look_tables: list[tuple[F64, Bool, Objects | None]] = []
    missed_agents: list[Bool] = []
    distance_errors: list[F64] = []
    steps = _steps(trace, perceived.detections)
    for (_, detections), step, visible in zip(
        perceived.detections, steps, in_view(trace, steps, perceived.cameras), strict=True
    ):
        agent_positions = np.stack([trace.x[step], trace.y[step]], -1).astype(np.float64)
        look_tables.append((agent_positions, visible, detections))
        look_count += 1
        detected_positions = np.zeros((0, 2)) if detections is None else detections.place
        distances = (
            np.linalg.norm(agent_positions[:, None] - detected_positions[None], axis=-1)
            if len(detected_positions)
            else np.full((len(agent_positions), 1), np.inf)
        )
        nearest = distances.min(1)
        missed_agents.append(visible & (nearest >= NEAR))
        if roughly_found := np.flatnonzero(visible & (nearest < ROUGH)).tolist():
            true_distances = np.linalg.norm(agent_positions[roughly_found] - agent_positions[0], axis=1)
            detected_distances = np.linalg.norm(
                detected_positions[distances[roughly_found].argmin(1)] - agent_positions[0], axis=1
            )
            distance_errors.append(detected_distances / true_distances - 1.0)
        visible_count, hit_count = visible_count + int(visible.sum()), hit_count + int((nearest[visible] < NEAR).sum())
        if detections is not None and len(detected_positions):
            is_other = trace.active[step].copy()
            is_other[0] = False
            # All other agents count here, hidden ones too: a detection of one of them is no phantom.
            is_phantom = distances[is_other].min(0, initial=np.inf) > ROUGH
            phantom_count += int((is_phantom & (detections.score >= phantom_score)).sum())
        if critical is not None and visible[critical]:
            critical_distance = float(np.linalg.norm(agent_positions[critical] - agent_positions[0]))
            distance_error = np.nan
            if nearest[critical] < ROUGH:
                distance_error = abs(
                    float(np.linalg.norm(detected_positions[distances[critical].argmin()] - agent_positions[0]))
                    - critical_distance
                )
            critical_looks.append((critical_distance, bool(nearest[critical] < NEAR), distance_error))
    rows = np.array(critical_looks, float).reshape(-1, 3)
    metrics: dict[str, float | None] = {
        "AP": average_precision(look_tables),
        "recall": hit_count / visible_count if visible_count else None,
        "missed_burst": _mean_miss_streak(missed_agents),
        "distance_share": float(np.sqrt(np.mean(np.concatenate(distance_errors) ** 2))) if distance_errors else None,
        "target_recall": _mean(rows[:, 1]),
        "distance_error": _mean(rows[np.isfinite(rows[:, 2]), 2]),
        "phantoms": phantom_count / look_count if look_count else None,
    }
    for band_start, band_end in BANDS:
        metrics[f"target_recall_{band_start:.0f}_{band_end:.0f}"] = _mean(
            rows[(rows[:, 0] >= band_start) & (rows[:, 0] < band_end), 1]
        )
    return metrics | _belief_metrics(trace, perceived, critical) | track_metrics(trace, perceived)


def _mean_miss_streak(missed_by_look: Sequence[Bool]) -> float | None:
    """Return the mean number of successive looks that miss an object; `missed_by_look` has [A] for each look."""
    missed_table = np.array(missed_by_look, bool)
    if not missed_table.any():
        return None
    run_starts = missed_table & ~np.concatenate([np.zeros_like(missed_table[:1]), missed_table[:-1]])
    return float(missed_table.sum() / run_starts.sum())


def track_metrics(trace: EpisodeTrace, perceived: DrivePerception) -> dict[str, float | None]:
    """HOTA, MOTA and IDF1 of what is believed against who is in view, within 2 m; None: nobody ever was.

    A track on somebody who is out of view, whom the driver may well remember, counts neither for nor against.
    """
    frames, steps = [], _steps(trace, perceived.tracks)
    for (_, tracks), step, visible in zip(
        perceived.tracks, steps, in_view(trace, steps, perceived.cameras), strict=True
    ):
        agent_positions = np.stack([trace.x[step], trace.y[step]], -1).astype(np.float64)
        similarity = similarity_of(agent_positions, tracks.place, 2.0 * NEAR)
        is_hidden = trace.active[step] & ~visible
        is_hidden[0] = False
        visible_similarity = similarity[visible].max(0, initial=0.0)
        counted_tracks = (visible_similarity >= similarity[is_hidden].max(0, initial=0.0)) | (
            similarity[is_hidden].max(0, initial=0.0) < ENOUGH
        )
        frames.append(
            TrackedFrame(np.flatnonzero(visible), tracks.ident[counted_tracks], similarity[visible][:, counted_tracks])
        )
    scores = track_scores(frames)
    if scores is None:
        return dict.fromkeys(("HOTA", "MOTA", "IDF1"))
    return {"HOTA": scores.hota, "MOTA": scores.mota, "IDF1": scores.idf1}


def sign_metrics(trace: EpisodeTrace, perceived: DrivePerception, signs: F64) -> dict[str, float | None]:
    """Return metrics of the reading of stop signs in a drive; None without a sign before the ego.

    Args:
        trace: The drive.
        perceived: What was perceived in it.
        signs: Where the stop signs stand that the route comes by, x, y [N, 2].

    Returns:
        sign_recall: share of the looks with such a sign 5 to 40 m ahead in which it was read; sign_recall_5_20 and so
        on: the same within a band of `SIGN_BANDS`. sign_read_at: m from the sign at which one was first read.
    """
    sign_looks: list[tuple[float, bool]] = []  # m to the sign ahead, whether it was read
    for time, readings in perceived.signs:
        step = min(round(time / trace.dt), len(trace.x) - 1)
        ego_position = np.array([trace.x[step, 0], trace.y[step, 0]], np.float64)
        yaw = float(trace.yaw[step, 0])
        offsets = signs - ego_position
        forward = offsets @ (np.cos(yaw), np.sin(yaw))
        lateral = np.abs(offsets @ (-np.sin(yaw), np.cos(yaw)))
        visible_signs = np.flatnonzero(
            (forward > SIGN_BANDS[0][0]) & (forward < SIGN_BANDS[-1][1]) & (lateral < 0.5 * forward)
        )
        if len(visible_signs):
            nearest_sign = visible_signs[forward[visible_signs].argmin()]
            sign_distance = float(np.linalg.norm(offsets[nearest_sign]))
            reading_error = np.linalg.norm(readings - signs[nearest_sign], axis=1).min(initial=np.inf)
            sign_looks.append((sign_distance, bool(reading_error < SIGN_MATCH_SHARE * sign_distance + 1.0)))
    rows = np.array(sign_looks, float).reshape(-1, 2)
    metrics: dict[str, float | None] = {"sign_recall": _mean(rows[:, 1])}
    for band_start, band_end in SIGN_BANDS:
        metrics[f"sign_recall_{band_start:.0f}_{band_end:.0f}"] = _mean(
            rows[(rows[:, 0] >= band_start) & (rows[:, 0] < band_end), 1]
        )
    return metrics | {
        "sign_read_at": max((sign_distance for sign_distance, is_read in sign_looks if is_read), default=None)
    }


def average_precision(detections_by_look: Sequence[tuple[F64, Bool, Objects | None]]) -> float | None:
    """Return AP over looks, all kinds as one, the mean over nuScenes' four distances; None if nothing was in view.

    Detections of hidden agents count neither for nor against.

    Args:
        detections_by_look: Positions of all agents [A, 2], which of them are in view [A], and the detections.
    """
    truth_parts, detection_parts = [], []
    for look_index, (agent_positions, visible, detections) in enumerate(detections_by_look):
        truth_parts.append(
            (np.full(int(visible.sum()), look_index), agent_positions[visible], np.full(int(visible.sum()), -1.0))
        )
        if detections is not None and len(detections):
            distances = np.linalg.norm(detections.place[:, None] - agent_positions[None, 1:], axis=-1)
            on_hidden_agent = distances[:, ~visible[1:]].min(1, initial=np.inf) < np.minimum(
                distances[:, visible[1:]].min(1, initial=np.inf), NEAR
            )
            detection_parts.append(
                (
                    np.full(len(detections), look_index)[~on_hidden_agent],
                    detections.place[~on_hidden_agent],
                    detections.score[~on_hidden_agent],
                )
            )
    truth_table, detection_table = _table(truth_parts), _table(detection_parts)
    if not len(truth_table):
        return None
    scores = match(truth_table, detection_table, samples=len(detections_by_look)).scores()
    return float(scores.mean_dist_aps["car"])


def cause_of_collision(trace: EpisodeTrace, perceived: DrivePerception) -> dict[str, Any] | None:
    """Return the perception of the struck object in the three seconds before a collision; None without one.

    Returns:
        cause: the commonest of `CAUSES` from 3 s to 0.5 s before the contact; of equal ones the worse. unknown_s: for
        how long before the contact it was not believed where it was, at most 3 s. shares: of the steps, by cause.
    """
    contact_steps = np.flatnonzero(trace.contact_agent > 0)
    if not len(contact_steps):
        return None
    contact_step = int(contact_steps[0])
    agent = int(trace.contact_agent[contact_step])
    perception_states = [
        _state(trace, step, agent, perceived)
        for step in range(max(contact_step - round(BEFORE / trace.dt), 0), contact_step)
    ]
    if not perception_states:
        return None
    unknown_steps = 0
    while unknown_steps < len(perception_states) and perception_states[-1 - unknown_steps] != "known":
        unknown_steps += 1
    early_states = perception_states[: max(len(perception_states) - round(0.5 / trace.dt), 1)]
    shares = {name: early_states.count(name) / len(early_states) for name in CAUSES}
    commonest_cause = max(CAUSES, key=lambda name: shares[name])
    return {
        "cause": commonest_cause,
        "unknown_s": round(unknown_steps * trace.dt, 3),
        "shares": shares,
        "agent": trace.names[agent],
    }


def impact_speed(trace: EpisodeTrace) -> float | None:
    """Return the relative speed of the ego and the agent that it touches first, just before, m/s; None if none."""
    contact_steps = np.flatnonzero(trace.contact_agent > 0)
    if not len(contact_steps):
        return None
    step = max(int(contact_steps[0]) - 1, 0)
    agent = int(trace.contact_agent[contact_steps[0]])
    velocity = trace.speed[step] * np.stack([np.cos(trace.yaw[step]), np.sin(trace.yaw[step])])
    return float(np.hypot(*(velocity[:, 0] - velocity[:, agent])))


def hard_braking(trace: EpisodeTrace, limit: float = 4.0) -> int:
    """Count how often the ego begins to brake harder than a limit, m/s^2."""
    brakes_hard = trace.accel < -limit
    return int((brakes_hard & ~np.concatenate([[False], brakes_hard[:-1]])).sum())


def phantom_stop(trace: EpisodeTrace, perceived: DrivePerception) -> float:
    """Seconds that the ego stood (below 0.5 m/s) with something on the road ahead, within 20 m, that is not there."""
    standing_time = 0.0
    for time, tracks in perceived.tracks:
        step = min(round(time / trace.dt), len(trace.x) - 1)
        if trace.speed[step, 0] > 0.5 or not len(tracks):
            continue
        yaw = float(trace.yaw[step, 0])
        track_offsets = tracks.place - (trace.x[step, 0], trace.y[step, 0])
        forward, lateral = track_offsets @ (np.cos(yaw), np.sin(yaw)), track_offsets @ (-np.sin(yaw), np.cos(yaw))
        other_agents = np.flatnonzero(trace.active[step])[1:]
        agent_positions = np.stack([trace.x[step, other_agents], trace.y[step, other_agents]], -1)
        distances = np.linalg.norm(tracks.place[:, None] - agent_positions[None], axis=-1).min(1, initial=np.inf)
        standing_time += trace.dt * bool(
            ((forward > 0) & (forward < 20.0) & (np.abs(lateral) < 2.5) & (distances > ROUGH)).any()
        )
    return standing_time


def _belief_metrics(trace: EpisodeTrace, perceived: DrivePerception, target: int | None) -> dict[str, float | None]:
    is_believed, track_ids, steps = [], [], _steps(trace, perceived.tracks)
    for (_, tracks), step, visible in zip(
        perceived.tracks, steps, in_view(trace, steps, perceived.cameras), strict=True
    ):
        if target is None or not visible[target]:
            continue
        distances = _gaps(tracks, trace, step, target)
        is_believed.append(float(distances.min(initial=np.inf) < NEAR))
        if is_believed[-1]:
            track_ids.append(int(tracks.ident[distances.argmin()]))
    switches = float(np.count_nonzero(np.diff(track_ids))) if track_ids else None
    return {"believed": _mean(np.array(is_believed)), "switches": switches}


def _state(trace: EpisodeTrace, step: int, agent: int, perceived: DrivePerception) -> str:
    """Return the entry of `CAUSES` that holds for an agent at a step."""
    time = step * trace.dt
    for record_time, tracks in perceived.tracks:
        if abs(record_time - time) < 0.5 * trace.dt and _gaps(tracks, trace, step, agent).min(initial=np.inf) < NEAR:
            return "known"
    if not in_view(trace, [step], perceived.cameras)[0, agent]:
        return "hidden"
    last_look = [
        detections for record_time, detections in perceived.detections if record_time <= time + 0.5 * trace.dt
    ][-1:]
    if not last_look or last_look[0] is None or not len(last_look[0]):
        return "missed"
    agent_position = np.array([trace.x[step, agent], trace.y[step, agent]])
    nearest = float(np.linalg.norm(last_look[0].place - agent_position, axis=1).min())
    return "late" if nearest < NEAR else "misplaced" if nearest < ROUGH else "missed"


def _gaps(tracks: Tracks, trace: EpisodeTrace, step: int, agent: int) -> F64:
    return np.asarray(np.linalg.norm(tracks.place - (trace.x[step, agent], trace.y[step, agent]), axis=1))


def _mean(values: F64) -> float | None:
    return float(values.mean()) if len(values) else None


def _table(objects_by_look: Sequence[tuple[I64, F64, F64]]) -> BoxTable:
    """Return boxes of one class, of which only the position counts."""
    if not objects_by_look:
        return BoxTable.empty()
    sample, positions, score = (np.concatenate(column) for column in zip(*objects_by_look, strict=True))
    table = BoxTable.empty(len(sample))
    table.sample[:], table.score[:] = sample, score
    table.centre[:, :2] = positions
    table.size_lwh[:] = 1.0
    table.rotation[:, 0] = 1.0
    return table
