"""Signals of traffic and of walkers: where they stand, and what they show."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from ssad.core.frames import FORWARD, Camera
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import LaneType, SignalState
from ssad.rendering.camera.effects import NO_EFFECTS, select_effects
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.signal_heads import (
    LENSES,
    SignalHeads,
    head_meshes,
    walker_head_poses,
    walker_state,
)
from ssad.rendering.street import cached_street
from ssad.world.roads import load_town
from ssad.world.roads.crossings import road_crossings
from ssad.world.roads.query import LaneQuery

RED, YELLOW, GREEN = (int(state) for state in LENSES)
WEATHERS = {"day": SceneWeather(0.9, clouds=0.3), "night": SceneWeather(-0.3)}
CAMERA = Camera(48, 96, np.array([[96.0, 0, 24.0], [0, 96.0, 48.0], [0, 0, 1]]))


@cache
def town() -> LaneGraph:
    return load_town("Twinford")


@cache
def heads() -> SignalHeads:
    return SignalHeads(town(), cached_street(town()), 0)


@cache
def scene() -> RenderScene:
    return RenderScene(cached_street(town()), head_meshes())


def facing(item: SceneObject, distance: float) -> View:
    """A look at the front of an object."""
    pose = item.pose @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ FORWARD
    pose[:3, 3] = item.pose[:3, 3] + distance * item.pose[:3, 0]
    return View(CAMERA, pose)


@pytest.mark.parametrize("hour", list(WEATHERS))
@pytest.mark.parametrize("state", [RED, YELLOW, GREEN])
def test_the_lit_lens_has_the_colour_of_its_state(state: int, hour: str) -> None:
    signals = dict.fromkeys(range(len(town().signal_xy)), state)
    item = next(entry for entry in heads().lights(signals, heads()._places[0]) if entry.effect == "lit-signals")
    view = facing(item, 6.0)
    view = View(view.camera, view.pose, (item,), WEATHERS[hour])
    on, off = (
        render(scene(), [view], quality=RenderQuality(effects=effects)).image[0].astype(int)
        for effects in (select_effects("lit-signals"), NO_EFFECTS)
    )
    changed = np.abs(on - off).max(-1) > 40
    red, green, blue = on[changed].mean(0)
    assert changed.sum() > 6
    brightest = on[changed].max(0)
    if state == GREEN:
        assert green > red + 60
        assert brightest[1] > 150
    else:
        assert red > blue + 60
        assert brightest[0] > 200
        assert (green > 0.42 * red) == (state == YELLOW)


def test_recorded_drives_show_the_signals_of_their_trace() -> None:
    head = 0
    signal = int(cached_street(town()).head_signal[head])
    trace = SimpleNamespace(dt=0.1, signal_ids=np.array([signal]), signal=np.array([[RED], [RED], [GREEN]], np.uint8))
    meshes = [
        {
            entry.mesh
            for entry in heads().trace_lights(trace, time, heads()._places[head])
            if entry.effect == "lit-signals"
        }  # type: ignore[arg-type]
        for time in (0.0, 0.15, 0.25, 9.0)
    ]
    red, _, green = range(3)
    assert meshes == [{red}, {red}, {green}, {green}]


def test_walkers_may_go_while_the_traffic_that_they_cross_has_red() -> None:
    assert walker_state([RED, RED]) == "walk"
    assert walker_state([RED, GREEN]) == "stop"
    assert walker_state([RED, YELLOW]) == "stop"
    assert walker_state([RED, int(SignalState.OFF)]) == "dark"


def test_signals_for_walkers_stand_beside_crossings_and_show_their_state() -> None:
    poses = walker_head_poses(town())
    assert len(poses) == 2 * sum(bool(road.traffic) for road in road_crossings(town()))
    assert poses
    places = np.array([pose[:2, 3] for _, pose in poses])
    assert not LaneQuery(town()).nearest(places, (LaneType.DRIVING,)).is_inside.any(), "none in the road"
    signals, pose = poses[0]
    shown = []
    for state in (RED, GREEN):
        lights = heads().lights(dict.fromkeys(signals, state), pose[:2, 3])
        (item,) = (entry for entry in lights if entry.effect == "walker-signals" and np.array_equal(entry.pose, pose))
        view = facing(item, 4.0)
        view.pose[2, 3] += 2.2
        view = View(view.camera, view.pose, (item,), WEATHERS["day"])
        alone = RenderScene(None, head_meshes())
        on, off = (
            render(alone, [view], quality=RenderQuality(effects=effects))
            for effects in (select_effects("walker-signals"), NO_EFFECTS)
        )
        assert (off.tag == -1).all(), "it is there only with the effect"
        shown.append(on.image[0].astype(int))
    walk, stop = shown
    change = walk - stop
    assert (change[..., 1] > 60).sum() > 10, "green light"
    assert (change[..., 0] < -60).sum() > 10, "in place of red"
    assert np.nonzero(change[..., 1] > 60)[0].mean() > np.nonzero(change[..., 0] < -60)[0].mean(), "below it"
