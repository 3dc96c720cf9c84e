"""Speed of perceiving drivers in the closed loop: python benchmarks/closed_loop_speed.py [--device cuda:0]

Scenes drive at once in one world for some simulated seconds: traffic, pictures, detector, tracker, planner. Pictures
are 640 x 360, in the 3D detector 640 x 384. Printed is how many times faster than real time all scenes are, after a few
steps to warm up, and what part of the time each stage takes.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from ssad import World, build_episode, load_scenarios, load_town, make_system
from ssad.drivers.perceiving.driver import Perceiving
from ssad.drivers.perceiving.eyes import CameraEyes, front
from ssad.jobs.machine import quiet_warp, versions
from ssad.recording.loop_sensors import Onboard
from ssad.world.rollout import Loop

THREE = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT")
# name -> detector, cameras, scenes, looks a second, width inside the detector
CASES: dict[str, tuple[str, tuple[str, ...], int, float, int | None]] = {
    "fcos3d": ("fcos3d-light", THREE, 64, 10.0, 640),
    "yolo": ("yolov5n", THREE[:1], 100, 10.0, None),
    "fcos3d-small": ("fcos3d-light", THREE[:1], 1, 5.0, 640),
    "yolo-small": ("yolov5n", THREE[:1], 2, 5.0, None),
}


class Stopwatch:
    """Adds up what calls take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def around(self, name: str, call: Callable[..., Any], *, sync: Callable[[], None]) -> Callable[..., Any]:
        """The same call, timed."""

        def timed(*args: Any, **options: Any) -> Any:
            start = time.perf_counter()
            result = call(*args, **options)
            sync()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            return result

        return timed


def measured(name: str, *, device: str, seconds: float, warm: int) -> dict[str, Any]:
    """One case: steps of all scenes, timed."""
    import torch

    detector, channels, scenes, rate, inside = CASES[name]
    cuda = device.startswith("cuda")

    def sync() -> None:
        if cuda:
            torch.cuda.synchronize()

    cameras = front(640, channels)
    options = {} if inside is None else {"input_width": inside}
    eyes = CameraEyes(detector, cameras, **options)
    driver = Perceiving(eyes, rate=rate)
    driver.to(device)
    scenarios = load_scenarios("natural-twinford")
    town = load_town(scenarios[0].town)
    episodes = [build_episode(scenarios[k % len(scenarios)], town, seed=k) for k in range(scenes)]
    onboard = Onboard(device=device)
    sensors = {channel: onboard.camera(camera) for channel, camera in cameras.items()}
    watch = Stopwatch()
    timed = {
        channel: _Timed(sensor, watch.around("pictures", sensor, sync=sync)) for channel, sensor in sensors.items()
    }
    eyes.detect = watch.around("detector", eyes.detect, sync=sync)  # type: ignore[method-assign]
    loop = Loop(World(episodes, {town.name: town}, device=device), {0: driver}, sensors=timed, policies=make_system)
    loop.reset()
    for _ in range(warm):
        loop.step()
    watch.seconds.clear()
    start, steps = time.perf_counter(), round(seconds / loop.simulator.dt)
    for _ in range(steps):
        loop.step()
    sync()
    wall = time.perf_counter() - start
    running = int((np.asarray(loop.simulator.ended()) == 0).sum())
    rest = wall - sum(watch.seconds.values())
    return {
        "case": name, "detector": detector, "cameras": len(cameras), "picture": [640, 360], "scenes": scenes,
        "still running": running, "rate": rate, "simulated s": seconds, "wall s": round(wall, 3),
        "times real time, all scenes at once": round(seconds / wall, 3),
        "times real time, scenes added up": round(scenes * seconds / wall, 2),
        "share": {k: round(v / wall, 3) for k, v in (watch.seconds | {"rest": rest}).items()},
    }  # fmt: skip


class _Timed:
    def __init__(self, sensor: Any, call: Callable[..., Any]) -> None:
        self.follow, self._call = sensor.follow, call

    def __call__(self, simulator: Any, agents: Any) -> Any:
        return self._call(simulator, agents)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--case", choices=CASES, nargs="+", default=["fcos3d-small", "yolo-small"])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--warm", type=int, default=3, help="steps before the clock starts")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    quiet_warp()
    found = []
    for name in args.case:
        found.append(measured(name, device=args.device, seconds=args.seconds, warm=args.warm))
        print(json.dumps(found[-1]), flush=True)
    if args.out:
        args.out.write_text(json.dumps({"versions": versions(args.device), "cases": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
