"""Appearance of the episodes of a town: its street, signs and lit signals, and a body for each agent.

Sensors in the loop and images that are rendered from a trace afterwards both use it, so that they agree to the bit.
The result does not depend on the other episodes that share a scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.rotations import upright_pose, upright_poses
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, I32, U8, Body, Bool, Episode, EpisodeTrace
from ssad.rendering.bodies import draw_paint, make_body
from ssad.rendering.bodies.actor_bodies import ACTOR_BODIES, plain_body
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.meshes.mesh import Mesh, merge
from ssad.rendering.scene_objects import PHASES, STRIDE, GroundOccupancy
from ssad.rendering.signal_heads import SignalHeads, head_meshes
from ssad.rendering.street import cached_street
from ssad.rendering.street_signs import KINDS, LIMIT_SIGN, REACH, street_signs
from ssad.rendering.vehicle_signals import flashing, trace_signals
from ssad.world.models import agent_model, agent_size, stated_size, trace_sizes
from ssad.world.rollout import route_signals

VARIANTS: Final = 4  # bodies that play a model
CYCLED: Final = ("pedestrian", "bicycle")  # kinds of body that have a walking cycle, or pedals

BodyKey = tuple[str, int, int, tuple[float, ...]]
"""Model, which of its `VARIANTS`, which of the `PHASES` of its cycle, and its size if that is not the model's."""


@lru_cache(maxsize=512)
def body_of(model: str, variant: int, phase: int = 0, size: tuple[float, ...] = ()) -> Mesh:
    """Return the body that plays a model of the world.

    Args:
        model: Name of the model.
        variant: Number of the body among those of the model.
        phase: Place in the walking cycle or of the pedals, 0 to 7; other bodies have one phase only.
        size: Length, width, height, m; (): those of the model.

    Raises:
        KeyError: Unknown model.
    """
    body_size = agent_size(model, size)
    if model not in ACTOR_BODIES:
        return plain_body(body_size)
    body_kind, styles = ACTOR_BODIES[model]
    style = styles[int(generator("body style", model, variant).integers(len(styles)))]
    cycle_phase = 2 * np.pi * phase / PHASES if body_kind in CYCLED else None
    return make_body(
        body_kind, style=style, size=body_size, generator=generator("body", model, variant), detail=1, phase=cycle_phase
    )


@dataclass(frozen=True, slots=True)
class Appearance:
    """Time-invariant appearance of an episode.

    Attributes:
        key: Key of the episode.
        models: Model of each agent.
        sizes: Length, width and height of each agent, m; () for one of the size of its model.
        variants: Number of the body that plays each agent.
        paints: Colour of each agent, linear RGB.
        strides: Phase of each agent's walking cycle at the start, m.
        signals: Lit signals of the town's lane graph: those of the junctions on the ego's route.
        signs: Numbers of the town's signs near the route.
        route: Points of the ego's route [N, 2], m.
    """

    key: str
    models: tuple[str, ...]
    sizes: tuple[tuple[float, ...], ...]
    variants: tuple[int, ...]
    paints: tuple[tuple[float, float, float], ...]
    strides: F64
    signals: I32
    signs: tuple[int, ...]
    route: F64 = field(default_factory=lambda: np.zeros((0, 2)))

    def bodies(self) -> set[BodyKey]:
        """Return the keys of the bodies that the agents need, in all phases of their cycles."""
        return {
            (model, variant, phase, size)
            for model, variant, size in zip(self.models, self.variants, self.sizes, strict=True)
            for phase in range(PHASES if _cycles(model) else 1)
        }


@dataclass(frozen=True, slots=True)
class AgentPoses:
    """Poses of the agents of an episode at a step.

    Attributes:
        step: Steps since the start.
        pose: [A, 3] x, y, yaw.
        active: [A] whether the agent is present.
        walked: [A] distance covered so far, m.
        signal: [S'] `SignalState` of the lit signals.
        lamps: [A] `LampSignal` bits of the agents' stop lamps and indicators at this moment; None: none shines.
    """

    step: int
    pose: F32
    active: Bool
    walked: F64
    signal: U8
    lamps: I32 | None = None


def walked_distance(distance: F64, previous_pose: F32, pose: F32) -> F64:
    """Return the distances that agents have covered, a step later.

    Args:
        distance: [A] m so far.
        previous_pose: [A, 2 or 3] x, y before the step.
        pose: The same after it.

    Returns:
        [A] m.
    """
    displacement = pose[:, :2].astype(np.float64) - previous_pose[:, :2].astype(np.float64)
    return distance + np.hypot(displacement[:, 0], displacement[:, 1])


class EpisodeScene:
    """Town with the bodies of some episodes, for the camera and the LiDAR.

    Args:
        graph: Lane graph of the town.
        device: Device that renders.
    """

    def __init__(self, graph: LaneGraph, *, device: str = "cpu") -> None:
        self.graph, self.device = graph, device
        street = self.street = cached_street(graph)
        signs = list(
            street_signs(
                graph,
                np.concatenate([graph.sign_xy, street.limit_signs[:, :2]]).astype(np.float64),
                GroundOccupancy(street),
                key=(graph.name,),
                many=False,
                detail=1,
                limit_signs=street.limit_signs,
            )
        )
        self.stop_signs = frozenset(index for index, sign in enumerate(signs) if sign.kind == KINDS[SignKind.STOP])
        self.sign_kinds = {
            index: f"{sign.kind}:{sign.style}" if sign.kind == LIMIT_SIGN else sign.kind
            for index, sign in enumerate(signs)
        }
        self._sign_poses = [upright_pose(*sign.pose) for sign in signs]
        # Signs and lenses come first: their numbers must not change when bodies are added.
        self._fixed = [merge([sign.plate, sign.post]) for sign in signs] + list(head_meshes())
        self.heads = street.heads.astype(np.float64)
        self._signal_heads = SignalHeads(graph, street, len(signs))
        self._bodies: dict[object, int] = {}
        self._meshes: dict[object, Mesh] = {}
        self._scene: RenderScene | None = None

    def add_bodies(self, bodies: Iterable[BodyKey]) -> None:
        """Add bodies; those that exist already stay."""
        missing_keys = sorted(set(bodies) - set(self._bodies))
        self._add({key: body_of(*key) for key in missing_keys})

    def add_meshes(self, meshes: Mapping[object, Mesh]) -> None:
        """Add other meshes under their own names; those that exist already stay."""
        self._add({key: mesh for key, mesh in meshes.items() if key not in self._bodies})

    def _add(self, meshes: Mapping[object, Mesh]) -> None:
        if meshes:
            first_index = len(self._fixed) + len(self._bodies)
            self._bodies |= {key: first_index + index for index, key in enumerate(meshes)}
            self._meshes |= meshes
            self._scene = None

    def indices(self, keys: Iterable[object]) -> dict[object, int]:
        """Return the number of each mesh in the scene."""
        return {key: self._bodies[key] for key in keys}

    def index(self, key: object) -> int:
        """Return the number of a mesh in the scene."""
        return self._bodies[key]

    @property
    def scene(self) -> RenderScene:
        """Street and bodies on the device, built on first use."""
        if self._scene is None:
            meshes = [*self._fixed, *self._meshes.values()]
            self._scene = RenderScene(self.street, meshes, device=self.device)
        return self._scene

    def appearance(self, episode: Episode) -> Appearance:
        """Return the appearance of an episode of this town."""
        route = episode.agents[0].route
        assert route is not None  # checked when the world was built
        models = tuple(agent.model for agent in episode.agents)
        sizes = tuple(
            stated_size(agent.model, (body.length, body.width, body.height)) if agent.body != Body() else ()
            for agent, body in ((agent, agent_model(agent)) for agent in episode.agents)
        )
        return self._make_appearance(episode.key, models, sizes, route_signals(self.graph, route), route.xy)

    def appearance_of_trace(self, trace: EpisodeTrace) -> Appearance:
        """Return the appearance of the episode of a trace of this town."""
        sizes: tuple[tuple[float, ...], ...] = ((),) * len(trace.models)
        if trace.heights:
            sizes = tuple(map(stated_size, trace.models, trace_sizes(trace)))
        return self._make_appearance(trace.key, trace.models, sizes, trace.signal_ids, trace.route)

    def _make_appearance(
        self, key: str, models: tuple[str, ...], sizes: tuple[tuple[float, ...], ...], signals: I32, way: F32
    ) -> Appearance:
        agents = range(len(models))
        strides = np.array([generator("stride", key, agent).uniform(0, STRIDE) for agent in agents])
        near_signs = [
            sign_index
            for sign_index, sign_pose in enumerate(self._sign_poses)
            if np.hypot(*(way - sign_pose[:2, 3]).T).min() < REACH
        ]
        return Appearance(
            key,
            models,
            sizes,
            tuple(int(generator("variant", key, agent).integers(VARIANTS)) for agent in agents),
            tuple(draw_paint(generator("paint", key, agent)) for agent in agents),
            strides,
            signals,
            tuple(near_signs),
            way.astype(np.float64),
        )

    def objects(
        self, appearance: Appearance, agent_poses: AgentPoses, *, without: int | None = None
    ) -> tuple[SceneObject, ...]:
        """Bodies of agents at a moment, with the signs along the way; agent a has the tag a + 1.

        Args:
            appearance: Of the episode.
            agent_poses: Who is where.
            without: Agent that is left out: who looks.
        """
        visible = [SceneObject(sign_index, self._sign_poses[sign_index]) for sign_index in appearance.signs]
        poses = upright_poses(agent_poses.pose.astype(np.float64))
        lamps = [0] * len(poses) if agent_poses.lamps is None else agent_poses.lamps.tolist()
        for agent, model in enumerate(appearance.models):
            if agent_poses.active[agent] and agent != without:
                phase = 0
                if _cycles(model):
                    phase = int((agent_poses.walked[agent] + appearance.strides[agent]) / STRIDE * PHASES) % PHASES
                body_index = self._bodies[model, appearance.variants[agent], phase, appearance.sizes[agent]]
                visible.append(
                    SceneObject(body_index, poses[agent], appearance.paints[agent], agent + 1, signals=lamps[agent])
                )
        return tuple(visible)

    def lights(self, appearance: Appearance, poses: AgentPoses, viewpoint: F64) -> tuple[SceneObject, ...]:
        """Return the objects that show the states of the signals near a place [2]; they belong to the street."""
        signal_states = dict(zip(appearance.signals.tolist(), poses.signal.tolist(), strict=True))
        return self._signal_heads.lights(signal_states, viewpoint)


def agent_poses(trace: EpisodeTrace) -> list[AgentPoses]:
    """Return the poses of all agents at each step of a trace, with the signals of vehicles."""
    pose = np.stack([trace.x, trace.y, trace.yaw], -1)
    agents, signals = np.arange(len(trace.models)), trace_signals(trace)
    walked = np.zeros(pose.shape[1])
    moments = []
    for step in range(len(pose)):
        walked = walked_distance(walked, pose[max(step - 1, 0)], pose[step])
        lamps = flashing(signals[step], step * trace.dt, agents)
        moments.append(AgentPoses(step, pose[step], trace.active[step], walked, trace.signal[step], lamps))
    return moments


def _cycles(model: str) -> bool:
    """Return True if the body of a model has a cycle that depends on the distance covered."""
    return ACTOR_BODIES.get(model, ("",))[0] in CYCLED
