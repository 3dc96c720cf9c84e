"""Frames a second of the camera: python benchmarks/camera_speed.py [--device cpu|cuda] [--batch N] [--out FILE]

A street of Twinford, 640 x 640, 30 vehicles, 2 x 2 samples a pixel: by day, by day without shadows, contact shadows and
lamps (`PLAIN`), by night with the lamps of vehicles and street; medians, on the CPU of the process's own time.
Re-texturing: a car 20 m ahead wears a texture of 256 x 256; picture and gradient, once the frame has been seen.

    python benchmarks/camera_speed.py --scenes 64 [--device cpu|cuda] [--steps N] [--out FILE]

The closed loop: so many natural episodes at once at 10 Hz, each ego on its way with a camera of 640 x 384; how many
times as fast as real time they run together, and what a step takes with pictures of 8 x 8 instead. Compiling and making
bodies do not count.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
import warp as wp

from ssad.core.driving import Observation
from ssad.core.frames import FORWARD, Camera
from ssad.core.seeding import generator
from ssad.core.types import Controller, EpisodeLimits
from ssad.rendering.bodies import draw_paint, make_body
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import PLAIN, RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureLayer
from ssad.rendering.camera.texture import retexture, texture_taps
from ssad.rendering.onboard import Onboard
from ssad.rendering.street import build_street
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.rollout import Loop
from ssad.world.world import World


def place(x: float, y: float, yaw: float) -> Any:
    """Pose of something on the ground."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:2, 3] = x, y
    return pose


def scene(size: int, device: str) -> tuple[RenderScene, View]:
    """A stage and a view with 30 vehicles on the lanes before the camera."""
    graph = load_town("Twinford")
    kinds = ["car"] * 7 + ["truck", "bus", "motorcycle"]
    meshes = [make_body(kind, generator=generator("camera speed", k)) for k, kind in enumerate(kinds)]
    stage = RenderScene(build_street(graph, seed=0), meshes, device=device)
    lanes = [k for k in range(len(graph.kind)) if graph.kind[k] == 1 and graph.junction[k] < 0]
    start = next(k for k in lanes if graph.s[graph.offset[k + 1] - 1] > 50)
    first = graph.offset[start] + 6
    ego = place(*graph.xy[first], graph.yaw[first])
    spots = np.concatenate([np.arange(graph.offset[k] + 3, graph.offset[k + 1], 6) for k in lanes])
    local = (graph.xy[spots] - graph.xy[first]) @ ego[:2, :2]
    # before the camera, and not between it and the car that wears the texture
    ahead = (local[:, 0] > 9) & (np.abs(local[:, 1]) < local[:, 0])
    ahead &= (np.abs(local[:, 1]) > 2) | (local[:, 0] > 30)
    spots = spots[ahead][np.argsort(local[ahead, 0])][:29]
    draws = generator("camera speed")
    things = [
        SceneObject(k % len(meshes), place(*graph.xy[i], graph.yaw[i]), draw_paint(draws), k + 1)
        for k, i in enumerate(spots)
    ]
    things.append(SceneObject(0, ego @ place(21.7, 0, 0), tag=100, layers=(TextureLayer(0),)))
    focal = 0.79 * size
    camera = Camera(size, size, np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]))
    return stage, View(camera, ego @ FORWARD, tuple(things), SceneWeather(0.8, 0.9))


def median(run: Callable[[], object], device: str, repeats: int) -> float:
    """Median seconds of a call, after one to warm up."""
    times = []
    clock = time.process_time if device == "cpu" else time.perf_counter
    for number in range(repeats + 1):
        wp.synchronize_device(device)
        begin = clock()
        run()
        wp.synchronize_device(device)
        if number:
            times.append(clock() - begin)
    return statistics.median(times)


class Driver:
    """Looks, and drives ahead."""

    name, controller, sensors = "driver", Controller.EXTERNAL, ("front",)

    def reset(self, episodes: object) -> None:
        """Nothing to forget."""

    def act(self, view: Observation) -> Any:
        """Slowly along the route."""
        assert view.readings["front"].any()  # a sensor is read when it is looked at
        steer = np.clip(1.5 * np.arctan2(view.route[:, 6, 1], view.route[:, 6, 0]), -1, 1)
        throttle = 0.5 * (view.speed < 4.0)
        return np.stack([throttle, 0.0 * throttle, steer], 1).astype(np.float32)


def in_the_loop(scenes: int, device: str, steps: int) -> dict[str, Any]:
    """Seconds a step of scenes with a camera each, as medians."""
    chosen = load_scenarios("natural-uniform")[:scenes]
    graphs = {name: load_town(name) for name in {scenario.town for scenario in chosen}}
    endless = EpisodeLimits(max_steps=10**6, max_time=1e6, contact="count")
    episodes = [replace(build_episode(s, graphs[s.town], seed=0), limits=endless) for s in chosen]
    found: dict[str, Any] = {"scenes": scenes, "towns": len(graphs), "steps": steps}
    for name, camera in (("loop", Camera.typical(640, 384)), ("host", Camera.typical(8, 8))):
        world = World(episodes, graphs, device=device)
        loop = Loop(world, {0: Driver()}, sensors={"front": Onboard(device=device).camera(camera)})
        loop.reset()
        loop.step()
        seconds = median(loop.step, device, steps)
        found[f"{name}_ms_per_step"] = 1e3 * seconds
    found["times_real_time"] = 100.0 / found["loop_ms_per_step"]
    found["frames_per_s"] = 1e3 * scenes / found["loop_ms_per_step"]
    return found


def main() -> None:
    """Measures, prints, writes JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--scenes", type=int, default=0)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    device = "cuda:0" if options.device == "cuda" else "cpu"
    if options.scenes:
        found = in_the_loop(options.scenes, device, options.steps)
        found["device"] = wp.get_device(device).name if device != "cpu" else platform.machine()
        print(
            f"{options.scenes} scenes, a camera each: {found['loop_ms_per_step']:.0f} ms a step of 100 ms "
            f"({found['times_real_time']:.2f} x real time), {found['frames_per_s']:.0f} frames/s; "
            f"{found['host_ms_per_step']:.0f} ms with pictures of 8 x 8"
        )
        if options.out:
            options.out.write_text(json.dumps(found, indent=1) + "\n")
        return
    stage, view = scene(640, device)
    seconds = median(lambda: render(stage, [view] * options.batch, download=False), device, options.repeats)
    result: dict[str, Any] = {
        "device": wp.get_device(device).name if device != "cpu" else platform.machine(),
        "batch": options.batch,
        "things": len(view.objects),
        "ms_per_frame": 1e3 * seconds / options.batch,
        "frames_per_s": options.batch / seconds,
    }
    print(f"{result['ms_per_frame']:.2f} ms a frame, {result['frames_per_s']:.0f} frames/s")
    dark = SceneWeather(-0.15, 0.9)
    lamps = own_lamps(view.pose @ np.linalg.inv(FORWARD), dark)
    night = replace(view, weather=dark, lamps=lamps)
    for name, one, quality in (("plain", view, PLAIN), ("night", night, RenderQuality())):
        seconds = median(
            partial(render, stage, [one] * options.batch, quality=quality, download=False), device, options.repeats
        )
        result[f"{name}_ms_per_frame"] = 1e3 * seconds / options.batch
        print(f"{result[f'{name}_ms_per_frame']:.2f} ms a frame, {name}")
    if device == "cpu":
        picture = render(stage, [view])
        taps = texture_taps(picture, 256)
        radiance = torch.tensor(picture.radiance)
        texture = torch.full((3, 256, 256), 0.4, requires_grad=True)
        both = median(lambda: retexture(taps, texture, radiance).sum().backward(), device, 15)
        result["retexture_ms"] = 1e3 * both
        result["pieces"] = len(taps.pixel)
        print(f"{1e3 * both:.2f} ms to re-texture {len(taps.pixel)} pieces, with gradient")
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
