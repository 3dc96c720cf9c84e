"""Sampling of lanes with carla.Map; `bake` runs it in a process of its own, because carla's C++ may abort.

`python -m ssad.world.roads._carla_reader MAP.xodr REQUEST.npz ANSWER.npz`. Request: road, lane [L] ids, s0, s1 [L]
m. Answer in OpenDRIVE's right-handed frame: count [L]; table [P, 6]: s, x, y, z, yaw (along the traffic), width;
crosswalk [., 3]: number, x, y; light_id [S], light [S, 3]: x, y, yaw.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

STEP = 0.5  # m between samples
NUDGE = 1e-3  # m, so that a sample belongs to its own section


def main(source: str, request: str, answer: str) -> int:
    """Sample the lanes. Exit code 3: carla refused the map; the last line of stderr holds its reason."""
    import carla

    try:
        road_map = carla.Map(Path(source).stem, Path(source).read_text(encoding="utf-8-sig"))
    except RuntimeError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 3
    with np.load(request) as archive:
        lanes = list(zip(*(archive[name].tolist() for name in ("road", "lane", "s0", "s1")), strict=True))
    sample_rows: list[tuple[float, ...]] = []
    sample_counts = []
    for road, lane, s0, s1 in lanes:
        first_row = len(sample_rows)
        pieces = max(1, int(np.ceil((s1 - s0) / STEP)))
        for position in np.linspace(s0 + NUDGE, s1 - NUDGE, pieces + 1).tolist() if s1 - s0 > 4 * NUDGE else ():
            waypoint = road_map.get_waypoint_xodr(road, lane, position)
            if waypoint is None:
                continue
            transform = waypoint.transform
            # CARLA's frame is left-handed: y and yaw change sign
            location, yaw = transform.location, -np.radians(transform.rotation.yaw)
            sample_rows.append((position, location.x, -location.y, location.z, yaw, waypoint.lane_width))
        sample_counts.append(len(sample_rows) - first_row)
    table = np.array(sample_rows, np.float64).reshape(-1, 6)
    crosswalk = []
    crosswalk_number, first_corner = 0, None
    for corner in road_map.get_crosswalks():
        corner_point = (corner.x, -corner.y)
        if first_corner is None:
            first_corner = corner_point
        # Each crosswalk ends with its first corner again; the list has no other separator.
        elif np.hypot(corner_point[0] - first_corner[0], corner_point[1] - first_corner[1]) < 1e-3:
            crosswalk_number, first_corner = crosswalk_number + 1, None
            continue
        crosswalk.append((crosswalk_number, *corner_point))
    lights: dict[str, tuple[float, float, float]] = {}
    for landmark in road_map.get_all_landmarks():
        transform = landmark.transform
        lights.setdefault(
            landmark.id, (transform.location.x, -transform.location.y, -float(np.radians(transform.rotation.yaw)))
        )
    np.savez(
        answer,
        count=np.array(sample_counts, np.int64),
        table=table,
        crosswalk=np.array(crosswalk, np.float64).reshape(-1, 3),
        light_id=np.array(list(lights), np.str_),
        light=np.array(list(lights.values()), np.float64).reshape(-1, 3),
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:4]))
