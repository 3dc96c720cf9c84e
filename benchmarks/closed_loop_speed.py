"""Speed of perceiving drivers in the closed loop.

    python benchmarks/closed_loop_speed.py --device cuda:0 --case fcos3d yolo --json closed-loop.json
    python benchmarks/closed_loop_speed.py --case fcos3d --width 64 --seconds 1      # on a CPU: what the host does

Scenes drive at once in one world for some simulated seconds: traffic, pictures, detector, tracker, planner. Pictures
are 640 x 360, in the 3D detector 640 x 384. Printed is how many times faster than real time all scenes are, after a few
steps to warm up, and the ms that each stage takes a look of all scenes, without the stages within it; a device is
waited for where a stage begins and ends.
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
from ssad.core.machine import start_warp_quietly, versions
from ssad.drivers.perceiving.driver import PerceivingDriver
from ssad.drivers.perceiving.perceivers import CameraPerceiver, nuscenes_cameras
from ssad.rendering.onboard import Onboard
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
    """Adds up what calls take, each without the timed calls within it.

    Args:
        sync: Waits for the device.
    """

    def __init__(self, sync: Callable[[], None]) -> None:
        self.seconds: dict[str, float] = {}
        self._sync, self._open, self._last = sync, [], 0.0

    def _turn(self) -> None:
        self._sync()
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._last
        self._last = now

    def around(self, stage: str, owner: Any, *names: str) -> None:
        """Time calls of methods of an object as a stage."""
        for name in names:
            setattr(owner, name, self._timed(stage, getattr(owner, name)))

    def _timed(self, stage: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **options: Any) -> Any:
            self._turn()
            self._open.append(stage)
            try:
                return call(*args, **options)
            finally:
                self._turn()
                self._open.pop()

        return timed


def measured(name: str, *, device: str, seconds: float, warm: int, width: int, scenes: int | None) -> dict[str, Any]:
    """One case: steps of all scenes, timed."""
    import torch

    detector, channels, count, rate, inside = CASES[name]
    scenes = scenes or count
    cuda = device.startswith("cuda")
    cameras = nuscenes_cameras(width, channels)
    options = {} if inside is None else {"input_width": min(inside, width)}
    eyes = CameraPerceiver(detector, cameras, **options)
    driver = PerceivingDriver(eyes, rate=rate)
    driver.to(device)
    scenarios = [s for s in load_scenarios("natural-uniform") if s.town == "Twinford"]
    town = load_town(scenarios[0].town)
    episodes = [build_episode(scenarios[k % len(scenarios)], town, seed=k) for k in range(scenes)]
    onboard = Onboard(device=device, resident=True)
    world = World(episodes, {town.name: town}, device=device)
    loop = Loop(world, {0: driver}, sensors=onboard.group_cameras(cameras), policies=make_system)
    loop.reset()
    watch = Stopwatch(torch.cuda.synchronize if cuda else lambda: None)
    watch.around("views", onboard, "view")
    watch.around("rendering", onboard, "render")
    watch.around("pictures to the detector", eyes, "perceive")
    watch.around("decoding", eyes.detector, "predict")
    watch.around("detector", eyes.detector, "_maps" if hasattr(eyes.detector, "_maps") else "dense")
    watch.around("lifting", driver, "_sightings")
    watch.around("tracker", driver, "_take_in")
    watch.around("belief", driver, "believe")
    watch.around("planner and world", world, "step")
    for _ in range(warm):
        loop.step()
    watch.seconds.clear()
    start, steps = time.perf_counter(), round(seconds / world.dt)
    for _ in range(steps):
        loop.step()
    if cuda:
        torch.cuda.synchronize()
    wall = time.perf_counter() - start
    running = int((np.asarray(world.ended()) == 0).sum())
    stages = watch.seconds | {"rest": wall - sum(watch.seconds.values())}
    looks = seconds * rate
    return {
        "case": name,
        "detector": detector,
        "cameras": len(cameras),
        "picture": [width, width * 9 // 16],
        "scenes": scenes,
        "still running": running,
        "rate": rate,
        "simulated s": seconds,
        "wall s": round(wall, 3),
        "times real time, all scenes at once": round(seconds / wall, 3),
        "times real time, scenes added up": round(scenes * seconds / wall, 2),
        "images/s": round(looks * scenes * len(cameras) / wall, 1),
        "ms a look": {stage: round(1e3 * taken / looks, 2) for stage, taken in stages.items()},
        "share": {stage: round(taken / wall, 3) for stage, taken in stages.items()},
    }


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--case", choices=CASES, nargs="+", default=["fcos3d-small", "yolo-small"])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--warm", type=int, default=3, help="steps before the clock starts")
    parser.add_argument("--width", type=int, default=640, help="of the pictures, pixels")
    parser.add_argument("--scenes", type=int, help="another number of scenes")
    parser.add_argument("--json", type=Path, help="where the results are written")
    args = parser.parse_args()
    start_warp_quietly()
    found = []
    for name in args.case:
        found.append(
            measured(
                name, device=args.device, seconds=args.seconds, warm=args.warm, width=args.width, scenes=args.scenes
            )
        )
        print(json.dumps(found[-1]), flush=True)
    if args.json:
        import torch

        name = torch.cuda.get_device_name(args.device) if args.device.startswith("cuda") else "CPU"
        told = {"device": name, "versions": versions(args.device), "cases": found}
        args.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
