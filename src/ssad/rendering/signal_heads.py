"""Traffic lights of a town that show their state: lit lenses, and heads for walkers at crossings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from ssad.core.colours import LUMINANCE
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, EpisodeTrace, SignalState
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.camera.scene import SceneObject
from ssad.rendering.meshes.mesh import Material, Mesh, box, merge, prism, tube
from ssad.rendering.scene_objects import KERB
from ssad.rendering.street.model import Street
from ssad.world.roads.crossings import crossing_axis, road_crossings
from ssad.world.roads.sidewalks import sidewalk_network

LENS: Final = 0.11  # m, radius of a signal's lens
LENSES: Final = {SignalState.RED: 0.31, SignalState.YELLOW: 0.0, SignalState.GREEN: -0.31}  # m above a head's middle
LENS_CANDELA: Final = 400.0  # luminous intensity of a lit lens (EN 12368, performance level 3)
LIGHTS: Final = {  # linear RGB; amber is that of 592 nm, as near as sRGB comes
    SignalState.RED: (1.0, 0.004, 0.002),
    SignalState.YELLOW: (1.0, 0.25, 0.0),
    SignalState.GREEN: (0.003, 1.0, 0.12),
}
SIGNALS_WITHIN: Final = 150.0  # m from the eye

WALK, STOP, DARK = "walk", "stop", "dark"  # states of the signals for walkers
WALKER_LENSES: Final = {STOP: (2.32, SignalState.RED), WALK: (2.08, SignalState.GREEN)}  # height, m, and colour
UNLIT_LENS: Final = {SignalState.RED: (0.09, 0.007, 0.005), SignalState.GREEN: (0.004, 0.066, 0.03)}
WALKER_LENS: Final = 0.09  # m, radius
BESIDE, BEYOND = 0.4, 0.6  # m from the edge of a crossing, and from the kerb, to the post of its signal


def lens_emission(state: SignalState) -> float:
    """Return the emission of a lit lens in an image.

    Its luminance is that of `LENS_CANDELA` on the scale of noon. The renderer compresses the range of daylight, so at
    night the lens is darker than its published luminance, and the sensor does not clip its colour.
    """
    luminance = LENS_CANDELA / (np.pi * LENS**2)
    # A white surface has the luminance of its illuminance over pi.
    return float(luminance * np.pi * per_lux(SceneWeather(1.0)) / np.dot(LIGHTS[state], LUMINANCE))


def _disc(radius: float, depth: tuple[float, float], material: Material) -> Mesh:
    angles = np.arange(10) * (2 * np.pi / 10)
    return prism(radius * np.stack([np.cos(angles), np.sin(angles)], -1), depth, material=material, axis=0)


def lit_lens(state: SignalState) -> Mesh:
    """Return a lit lens that faces along x."""
    material = Material("signal_light", LIGHTS[state], emission=lens_emission(state))
    return _disc(LENS, (0.0, 0.01), material)


def walker_head(state: str) -> Mesh:
    """Return a post with the signal for walkers that faces along x, in one of its states."""
    black = Material("black_plastic", (0.02, 0.02, 0.022), gloss=0.4)
    metal = Material("galvanised", (0.36, 0.37, 0.38), specular=0.3, gloss=0.5)
    parts = [
        tube(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.5]]), 0.05, material=metal, segments=6),
        box((0.16, 0.26, 0.52), material=black, centre=(0.13, 0.0, 2.2)),
    ]
    for name, (height, colour) in WALKER_LENSES.items():
        bright = Material("signal_light", LIGHTS[colour], emission=lens_emission(colour))
        dark = Material(f"signal_{colour.name.lower()}", UNLIT_LENS[colour], gloss=0.6)
        parts.append(_disc(WALKER_LENS, (0.21, 0.22), bright if name == state else dark).moved(0.0, 0.0, height))
    return merge(parts)


def head_meshes() -> tuple[Mesh, ...]:
    """Return the meshes that `SignalHeads` places: a lit lens of each state, then heads for walkers."""
    return (*(lit_lens(state) for state in LENSES), *(walker_head(state) for state in (DARK, STOP, WALK)))


class SignalHeads:
    """Lit lenses of the signals of a town, and signals for walkers at its crossings.

    Signals of traffic belong to the effect `lit-signals`, those for walkers to `walker-signals`.

    Args:
        graph: Lane graph of the town.
        street: What stands along its roads.
        first_mesh: Number of the first of `head_meshes` in the scene.
    """

    def __init__(self, graph: LaneGraph, street: Street, first_mesh: int) -> None:
        self._signals = street.head_signal.tolist()
        self._places = street.heads[:, :2].astype(np.float64)
        self._lenses = [
            {
                # 1 cm in front of the head, so that the lens is not hidden in its surface.
                state: SceneObject(
                    first_mesh + index,
                    upright_pose(x, y, yaw, z + offset) @ upright_pose(0.01, 0.0, 0.0),
                    effect="lit-signals",
                )
                for index, (state, offset) in enumerate(LENSES.items())
            }
            for x, y, z, yaw in street.heads.astype(np.float64).tolist()
        ]
        self._walker_heads: list[tuple[tuple[int, ...], dict[str, SceneObject]]] = []
        places = []
        for signals, pose in walker_head_poses(graph):
            heads = {
                state: SceneObject(first_mesh + len(LENSES) + index, pose, effect="walker-signals")
                for index, state in enumerate((DARK, STOP, WALK))
            }
            self._walker_heads.append((signals, heads))
            places.append(pose[:2, 3])
        self._walker_places = np.array(places).reshape(-1, 2)

    def lights(self, states: Mapping[int, int], viewpoint: F64) -> tuple[SceneObject, ...]:
        """Return the objects that show the states of signals near a place; they belong to the street.

        Args:
            states: `SignalState` of the signals of the lane graph; those that are missing are off.
            viewpoint: x, y, m.
        """
        visible = []
        for head in _nearby(self._places, viewpoint):
            lenses = self._lenses[head]
            state = SignalState(states.get(self._signals[head], SignalState.OFF))
            if state in lenses:
                visible.append(lenses[state])
        for head in _nearby(self._walker_places, viewpoint):
            signals, heads = self._walker_heads[head]
            visible.append(heads[walker_state([states.get(signal, SignalState.OFF) for signal in signals])])
        return tuple(visible)

    def trace_lights(self, trace: EpisodeTrace, time: float, viewpoint: F64) -> tuple[SceneObject, ...]:
        """Return `lights` at a time (s) of a drive."""
        step = min(max(int(time / trace.dt), 0), len(trace.signal) - 1)
        states = dict(zip(trace.signal_ids.tolist(), trace.signal[step].tolist(), strict=True))
        return self.lights(states, viewpoint)


def walker_state(states: list[int]) -> str:
    """Return the state of a signal for walkers who cross traffic with signals in some states.

    They may walk while all of that traffic has red; where one of the signals is off, theirs is dark.
    """
    if SignalState.OFF in states:
        return DARK
    return WALK if all(state == SignalState.RED for state in states) else STOP


def walker_head_poses(graph: LaneGraph) -> list[tuple[tuple[int, ...], F64]]:
    """Return the signals that rule each head for walkers, and its pose [4, 4]: on the far side of a crossing."""
    heads = []
    for crossing, road in zip(sidewalk_network(graph).crossings, road_crossings(graph), strict=True):
        signals = tuple(sorted({traffic.signal for traffic in road.traffic}))
        if not signals:
            continue
        axis = crossing_axis(crossing)
        yaw = float(np.arctan2(axis[1], axis[0]))
        right = np.array([axis[1], -axis[0]])
        aside = 0.5 * crossing.width + BESIDE
        # Each head stands to the right of who walks towards it.
        for distance, side, facing in (
            (road.kerbs[1] + BEYOND, right, yaw + np.pi),
            (road.kerbs[0] - BEYOND, -right, yaw),
        ):
            x, y = crossing.xy[0] + axis * distance + side * aside
            heads.append((signals, upright_pose(float(x), float(y), facing, KERB)))
    return heads


def _nearby(places: F64, viewpoint: F64) -> list[int]:
    offsets = places - viewpoint
    nearby: list[int] = np.flatnonzero(np.hypot(offsets[:, 0], offsets[:, 1]) < SIGNALS_WITHIN).tolist()
    return nearby
