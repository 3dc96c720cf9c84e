"""Cost of the effects of the rendering: python benchmarks/effect_cost.py [--effects NAME,...] [--out FILE]

The street of `camera_speed.py` by day, with a low sun ahead, on a wet road and at night with braking and turning
vehicles, 640 x 640 and 640 x 384 pixels, on one core. A picture without any effect and one with an effect are rendered
in turn; the cost is the median of the differences in process time, so that a busy machine slows both alike. `finish` is
metallic paint, dirt and wear on all vehicles. The camera does not move: the first picture makes the probe of
`reflections`, and the others share it.

    python benchmarks/effect_cost.py --scenes 8 [--steps N] [--out FILE]

The closed loop of `camera_speed.py`, with all default effects and with `lit-signals` alone, a step of each in turn.
Egos move, so probes of new places are part of the cost.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from camera_speed import Driver, scene

from ssad.core.frames import FORWARD, Camera
from ssad.core.types import EpisodeLimits
from ssad.rendering.camera.effects import EFFECTS, NO_EFFECTS, select_effects
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import Finish, LampSignal, RenderScene
from ssad.rendering.onboard import Onboard
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.rollout import Loop
from ssad.world.world import World

FINISH = Finish(metallic=0.5, dirt=0.5, wear=0.5)


def seconds_of(run: Callable[[], object]) -> float:
    """Return the process time of a call."""
    begin = time.process_time()
    run()
    return time.process_time() - begin


def cost(base: Callable[[], object], changed: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the median seconds of a call, and the median additional seconds of another, measured in turn."""
    for run in (base, changed):
        run()
    pairs = [(seconds_of(base), seconds_of(changed)) for _ in range(repeats)]
    return statistics.median(before for before, _ in pairs), statistics.median(
        after - before for before, after in pairs
    )


def views_of(view: View) -> dict[str, View]:
    """Return the view at 640 x 640 and at 640 x 384, by day, with a low sun ahead, on a wet road and at night."""
    heading = float(np.arctan2(view.pose[1, 2], view.pose[0, 2]))
    low = replace(view.weather, sun_height=0.15, sun_heading=heading + 0.1)
    wet = replace(view.weather, wet=0.8, clouds=0.8)
    wide_camera = Camera.typical(640, 384)
    dark = SceneWeather(-0.15, 0.9)
    signals = int(LampSignal.BRAKE | LampSignal.LEFT)
    night = replace(
        view,
        weather=dark,
        lamps=own_lamps(view.pose @ np.linalg.inv(FORWARD), dark),
        objects=tuple(replace(scene_object, signals=signals) for scene_object in view.objects),
    )
    return {
        "640 x 640": view,
        "640 x 384": replace(view, camera=wide_camera),
        "640 x 640, low sun": replace(view, weather=low),
        "640 x 640, wet": replace(view, weather=wet),
        "640 x 640, night": night,
        "640 x 384, night": replace(night, camera=wide_camera),
    }


def with_finish(view: View) -> View:
    """Return the view with a finish on everything that wears no texture."""
    return replace(view, objects=tuple(replace(scene_object, finish=FINISH) for scene_object in view.objects))


def measure(stage: RenderScene, view: View, names: list[str], repeats: int) -> dict[str, Any]:
    """Return the milliseconds of a view without effects, and of each effect in addition."""
    plain = RenderQuality(effects=NO_EFFECTS)
    base = partial(render, stage, [view], quality=plain, download=False)
    costs: dict[str, Any] = {}
    for name in names:
        if name == "finish":
            changed = partial(render, stage, [with_finish(view)], quality=plain, download=False)
        else:
            quality = RenderQuality(effects=select_effects(name))
            changed = partial(render, stage, [view], quality=quality, download=False)
        before, additional = cost(base, changed, repeats)
        costs.setdefault("ms_without", 1e3 * before)
        costs[name] = {"ms": 1e3 * additional, "ratio": additional / before}
    return costs


def measure_loop(scenes: int, steps: int) -> dict[str, Any]:
    """Return the milliseconds of a step of closed loops with few effects and with all, and the median of the ratios."""
    scenarios = load_scenarios("natural-uniform")[:scenes]
    graphs = {name: load_town(name) for name in {scenario.town for scenario in scenarios}}
    endless = EpisodeLimits(max_steps=10**6, max_time=1e6, contact="count")
    loops = []
    for effects in ("lit-signals", "default"):
        episodes = [
            replace(build_episode(scenario, graphs[scenario.town], seed=0), limits=endless) for scenario in scenarios
        ]
        onboard = Onboard(effects=select_effects(effects))
        sensors = {"front": onboard.camera(Camera.typical(640, 384))}
        loops.append(Loop(World(episodes, graphs), {0: Driver()}, sensors=sensors))
        loops[-1].reset()
        loops[-1].step()
    pairs = [[seconds_of(loop.step) for loop in loops] for _ in range(steps)]
    return {
        "scenes": scenes,
        "steps": steps,
        "ms_without": 1e3 * statistics.median(before for before, _ in pairs),
        "ms_with": 1e3 * statistics.median(after for _, after in pairs),
        "ratio": statistics.median(after / before for before, after in pairs),
    }


def main() -> None:
    """Measure the costs, print them, and write JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=0)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--effects", default=",".join(["all", *EFFECTS, "finish"]))
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    result: dict[str, Any] = {}
    if options.scenes:
        result = measure_loop(options.scenes, options.steps)
        print(
            f"{options.scenes} scenes: {result['ms_with']:.0f} ms a step, {result['ratio']:.3f} times the time without"
        )
        if options.out:
            options.out.write_text(json.dumps(result, indent=1) + "\n")
        return
    stage, view = scene(640, "cpu")
    for size, sized in views_of(view).items():
        result[size] = measure(stage, sized, options.effects.split(","), options.repeats)
        print(f"{size}: {result[size]['ms_without']:.0f} ms without effects")
        for name in options.effects.split(","):
            print(f"  {name}: {result[size][name]['ms']:+.1f} ms ({result[size][name]['ratio']:+.1%})")
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
