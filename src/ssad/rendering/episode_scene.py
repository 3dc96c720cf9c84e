"""How episodes of a town look: its street, signs and lit signals, and a body for each agent, wherever it is.

What an agent carries in the loop and what is rendered from a trace afterwards come from here, so that both are the
same to the bit. Nothing here depends on which other episodes share a scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.rotations import upright_pose, upright_poses
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, I32, U8, Bool, Episode, EpisodeTrace, SignalState
from ssad.rendering.bodies import draw_paint, make_body
from ssad.rendering.bodies.actor_bodies import ACTOR_BODIES, plain_body
from ssad.rendering.camera.scene import Scene, Thing
from ssad.rendering.meshes.mesh import Material, Mesh, merge, prism
from ssad.rendering.scene_objects import PHASES, STRIDE, Clear
from ssad.rendering.street import cached_street
from ssad.rendering.street_signs import KINDS, REACH, street_signs
from ssad.world.models import MODELS
from ssad.world.rollout import route_signals

VARIANTS: Final = 4  # bodies that play a model
CYCLED: Final = ("pedestrian", "bicycle")  # kinds of body that have a walking cycle, or pedals
LENS: Final = 0.11  # m, radius of a signal's lens
LENSES: Final = {SignalState.RED: 0.31, SignalState.YELLOW: 0.0, SignalState.GREEN: -0.31}  # m above a head's middle
LIGHTS: Final = {
    SignalState.RED: (1.0, 0.04, 0.02),
    SignalState.YELLOW: (1.0, 0.45, 0.02),
    SignalState.GREEN: (0.03, 1.0, 0.45),
}
BRIGHT: Final = 1.3  # emission of a lit lens
SIGNALS_WITHIN: Final = 150.0  # m from the eye

BodyKey = tuple[str, int, int]
"""Model, which of its `VARIANTS`, and which of the `PHASES` of its cycle."""


@lru_cache(maxsize=512)
def body_of(model: str, variant: int, phase: int = 0) -> Mesh:
    """The body that plays a model of the world, of its size.

    Args:
        model: Name of the model.
        variant: Which body of that model.
        phase: Place in the walking cycle or of the pedals, 0 to 7; others have one only.

    Raises:
        KeyError: There is no such model.
    """
    size = MODELS[model].length, MODELS[model].width, MODELS[model].height
    if model not in ACTOR_BODIES:
        return plain_body(size)
    kind, styles = ACTOR_BODIES[model]
    style = styles[int(generator("body style", model, variant).integers(len(styles)))]
    turn = 2 * np.pi * phase / PHASES if kind in CYCLED else None
    return make_body(kind, style=style, size=size, generator=generator("body", model, variant), detail=1, phase=turn)


@lru_cache(maxsize=3)
def _lens(state: SignalState) -> Mesh:
    """A lit lens that faces along x."""
    turn = np.arange(10) * (2 * np.pi / 10)
    outline = LENS * np.stack([np.cos(turn), np.sin(turn)], -1)
    return prism(outline, (0.0, 0.01), material=Material("signal_light", LIGHTS[state], emission=BRIGHT), axis=0)


@dataclass(frozen=True, slots=True)
class Looks:
    """What of an episode's looks is the same at all its steps.

    Attributes:
        key: The episode's.
        models: Of each agent.
        variants: Which body plays it.
        paints: Its colour, linear RGB.
        strides: m of its walking cycle that lie behind it at the start.
        signals: Signals that are lit, of the town's lane graph: those of the junctions on the ego's route.
        signs: Which of the town's signs stand near the route.
    """

    key: str
    models: tuple[str, ...]
    variants: tuple[int, ...]
    paints: tuple[tuple[float, float, float], ...]
    strides: F64
    signals: I32
    signs: tuple[int, ...]

    def bodies(self) -> set[BodyKey]:
        """The bodies that the agents need, in all phases of their cycles."""
        return {
            (model, variant, phase)
            for model, variant in zip(self.models, self.variants, strict=True)
            for phase in range(PHASES if _cycles(model) else 1)
        }


@dataclass(frozen=True, slots=True)
class Moment:
    """Who is where in an episode at a step.

    Attributes:
        step: Since the start.
        pose: [A, 3] x, y, yaw.
        active: [A] whether somebody is there.
        walked: [A] m that each has moved.
        signal: [S'] `SignalState` of the lit signals.
    """

    step: int
    pose: F32
    active: Bool
    walked: F64
    signal: U8


def walked_to(walked: F64, before: F32, now: F32) -> F64:
    """How far agents have moved, a step later.

    Args:
        walked: [A] m so far.
        before: [A, 2 or 3] x, y before the step.
        now: The same after it.

    Returns:
        [A] m.
    """
    moved = now[:, :2].astype(np.float64) - before[:, :2].astype(np.float64)
    return walked + np.hypot(moved[:, 0], moved[:, 1])


class EpisodeScene:
    """A town with the bodies of some episodes in it, for the camera and the LiDAR.

    Args:
        graph: The town.
        device: Where it is rendered.
    """

    def __init__(self, graph: LaneGraph, *, device: str = "cpu") -> None:
        self.graph, self.device = graph, device
        street = self.street = cached_street(graph)
        at = graph.sign_xy.astype(np.float64).reshape(-1, 2)
        found = list(street_signs(graph, at, Clear(street), key=(graph.name,), many=False, detail=1))
        self.stop_signs = frozenset(n for n, sign in enumerate(found) if sign.kind == KINDS[SignKind.STOP])
        self._sign_poses = [upright_pose(*sign.pose) for sign in found]
        self._fixed = [merge([sign.plate, sign.post]) for sign in found] + [_lens(state) for state in LENSES]
        heads = street.heads.astype(np.float64)
        self._head_places = heads[:, :2]
        self._lenses = [
            {
                state: Thing(len(found) + n, upright_pose(x, y, yaw, z + up) @ upright_pose(0.01, 0.0, 0.0))
                for n, (state, up) in enumerate(LENSES.items())
            }
            for x, y, z, yaw in heads.tolist()
        ]
        self._bodies: dict[object, int] = {}
        self._own: dict[object, Mesh] = {}
        self._scene: Scene | None = None

    def cast(self, bodies: Iterable[BodyKey]) -> None:
        """Have these bodies; what is there already stays."""
        missing = sorted(set(bodies) - set(self._bodies))
        self._add({key: body_of(*key) for key in missing})

    def have(self, meshes: Mapping[object, Mesh]) -> None:
        """Have other meshes, by names of their own; what is there already stays."""
        self._add({key: mesh for key, mesh in meshes.items() if key not in self._bodies})

    def _add(self, meshes: Mapping[object, Mesh]) -> None:
        if meshes:
            first = len(self._fixed) + len(self._bodies)
            self._bodies |= {key: first + n for n, key in enumerate(meshes)}
            self._own |= meshes
            self._scene = None

    def index(self, key: object) -> int:
        """Number of a mesh in the scene."""
        return self._bodies[key]

    @property
    def scene(self) -> Scene:
        """Street and bodies on the device."""
        if self._scene is None:
            meshes = [*self._fixed, *self._own.values()]
            self._scene = Scene(self.street, meshes, device=self.device)
        return self._scene

    def looks(self, episode: Episode) -> Looks:
        """How an episode of this town looks."""
        route = episode.agents[0].route
        assert route is not None  # checked when the world was built
        models = tuple(agent.model for agent in episode.agents)
        return self._looks(episode.key, models, route_signals(self.graph, route), route.xy)

    def looks_of_trace(self, trace: EpisodeTrace) -> Looks:
        """How the episode of a trace of this town looked."""
        return self._looks(trace.key, trace.models, trace.signal_ids, trace.route)

    def _looks(self, key: str, models: tuple[str, ...], signals: I32, way: F32) -> Looks:
        agents = range(len(models))
        strides = np.array([generator("stride", key, a).uniform(0, STRIDE) for a in agents])
        near = [n for n, at in enumerate(self._sign_poses) if np.hypot(*(way - at[:2, 3]).T).min() < REACH]
        return Looks(
            key,
            models,
            tuple(int(generator("variant", key, a).integers(VARIANTS)) for a in agents),
            tuple(draw_paint(generator("paint", key, a)) for a in agents),
            strides,
            signals,
            tuple(near),
        )

    def things(self, looks: Looks, moment: Moment, *, without: int | None = None) -> tuple[Thing, ...]:
        """Bodies of agents at a moment, with the signs along the way; agent a has the tag a + 1.

        Args:
            looks: Of the episode.
            moment: Who is where.
            without: Agent that is left out: who looks.
        """
        found = [Thing(n, self._sign_poses[n]) for n in looks.signs]
        poses = upright_poses(moment.pose.astype(np.float64))
        for a, model in enumerate(looks.models):
            if moment.active[a] and a != without:
                phase = 0
                if _cycles(model):
                    phase = int((moment.walked[a] + looks.strides[a]) / STRIDE * PHASES) % PHASES
                mesh = self._bodies[model, looks.variants[a], phase]
                found.append(Thing(mesh, poses[a], looks.paints[a], a + 1))
        return tuple(found)

    def lights(self, looks: Looks, moment: Moment, eye: F64) -> tuple[Thing, ...]:
        """The lit lenses of the signals near a place [2]; they belong to the street."""
        state = dict(zip(looks.signals.tolist(), moment.signal.tolist(), strict=True))
        away = self._head_places - eye
        near = np.flatnonzero(np.hypot(away[:, 0], away[:, 1]) < SIGNALS_WITHIN).tolist()
        lit = (
            (k, SignalState(state.get(signal, SignalState.OFF)))
            for k, signal in zip(near, self.street.head_signal[near].tolist(), strict=True)
        )
        return tuple(self._lenses[k][one] for k, one in lit if one in LENSES)


def moments_of(trace: EpisodeTrace) -> list[Moment]:
    """Who was where at each step of a trace."""
    pose = np.stack([trace.x, trace.y, trace.yaw], -1)
    walked = np.zeros(pose.shape[1])
    found = []
    for step in range(len(pose)):
        walked = walked_to(walked, pose[max(step - 1, 0)], pose[step])
        found.append(Moment(step, pose[step], trace.active[step], walked, trace.signal[step]))
    return found


def _cycles(model: str) -> bool:
    """Whether the body of a model has a cycle that goes with how far it has moved."""
    return ACTOR_BODIES.get(model, ("",))[0] in CYCLED
