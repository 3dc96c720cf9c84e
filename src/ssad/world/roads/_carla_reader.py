"""Run by `bake` in a process of its own, because carla's C++ may abort: samples lanes with carla.Map.

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
    """Sample the lanes; exit code 3: carla refused the map, with its reason as the last line of stderr."""
    import carla

    try:
        road_map = carla.Map(Path(source).stem, Path(source).read_text(encoding="utf-8-sig"))
    except RuntimeError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 3
    with np.load(request) as data:
        wanted = list(zip(*(data[name].tolist() for name in ("road", "lane", "s0", "s1")), strict=True))
    rows: list[tuple[float, ...]] = []
    count = []
    for road, lane, s0, s1 in wanted:
        before = len(rows)
        pieces = max(1, int(np.ceil((s1 - s0) / STEP)))
        for s in np.linspace(s0 + NUDGE, s1 - NUDGE, pieces + 1).tolist() if s1 - s0 > 4 * NUDGE else ():
            point = road_map.get_waypoint_xodr(road, lane, s)
            if point is None:
                continue
            place = point.transform
            # CARLA's frame is left-handed: y and yaw change sign
            at, yaw = place.location, -np.radians(place.rotation.yaw)
            rows.append((s, at.x, -at.y, at.z, yaw, point.lane_width))
        count.append(len(rows) - before)
    table = np.array(rows, np.float64).reshape(-1, 6)
    crosswalk = []
    number, first = 0, None
    for corner in road_map.get_crosswalks():
        here = (corner.x, -corner.y)
        if first is None:
            first = here
        elif np.hypot(here[0] - first[0], here[1] - first[1]) < 1e-3:
            number, first = number + 1, None
            continue
        crosswalk.append((number, *here))
    lights: dict[str, tuple[float, float, float]] = {}
    for mark in road_map.get_all_landmarks():
        place = mark.transform
        lights.setdefault(mark.id, (place.location.x, -place.location.y, -float(np.radians(place.rotation.yaw))))
    np.savez(
        answer,
        count=np.array(count, np.int64),
        table=table,
        crosswalk=np.array(crosswalk, np.float64).reshape(-1, 3),
        light_id=np.array(list(lights), np.str_),
        light=np.array(list(lights.values()), np.float64).reshape(-1, 3),
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:4]))
