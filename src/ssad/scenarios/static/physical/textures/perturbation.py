"""A finished texture on a car, a walker or the stop signs: the same on recorded targets and in the loop."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.types import F32, F64, AgentKind, Episode
from ssad.rendering.agent_edit import SIGN, AgentEdit
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.target import TargetSign, TargetWalker, class_of_target, parse_target
from ssad.scenarios.static.perturbation import EGO, Perturbation, TargetImages
from ssad.scenarios.static.physical.textures.card import load_texture
from ssad.scenarios.static.physical.textures.carrier import albedo_of
from ssad.scenarios.static.physical.textures.export import PrintedTexture, load_printed_texture
from ssad.scenarios.static.physical.textures.inks import project_onto_gamut
from ssad.scenarios.static.physical.textures.spec import make_carrier
from ssad.world.models import MODELS

if TYPE_CHECKING:
    from ssad.core.detections import Truth
    from ssad.rendering.sensor_suite import SensorSuite

CONTROLS: Final = {"grey": "sedan", "grey-sign": SIGN}
"""Name of a control -> its target, which is painted grey all over."""
SIGN_DISTANCE: Final = 12.0  # m from a route within which its signs stand
SIZES: Final = (1.0, 0.9, 0.8, 0.7, 0.6)  # sizes of a patch that are tried, as a share of the trained one
BATCH: Final = 16  # images that are shown at once on a GPU


@dataclass(frozen=True, slots=True)
class Texture(Perturbation):
    """Finished texture (paper III.A.1, invasive attacks).

    Attributes:
        texture: Name of a shipped texture, "grey" or "grey-sign" (the controls: a car, or the plate of a sign, painted
            grey all over), path of a card (NAME.json beside NAME.png), or folder that `ssad export texture` wrote.
        label: Name in tables; "": that of the texture or of its file.
        project: Whether its colours are first moved to the nearest that inks can give.

    Raises:
        UnknownNameError: No shipped texture has the name.
        FormatError: A file is missing or broken.
    """

    texture: str
    label: str = ""
    project: bool = False
    severity: int = field(default=1, init=False)
    family: str = field(default="texture", init=False)

    def __post_init__(self) -> None:
        self.printed_texture()

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        return self.label or (self.texture if self.texture in CONTROLS else Path(self.texture).stem)

    def printed_texture(self) -> PrintedTexture:
        """Return the texture with all settings that put it on its target."""
        printed_texture = _load_printed_texture(self.texture)
        return _projected(self.texture) if self.project else printed_texture

    @property
    def needs_target(self) -> bool:
        """True: something must wear it."""
        return True

    @property
    def target(self) -> str:
        """Target that the texture is made for."""
        return self.printed_texture().target

    def version(self) -> str:
        """Return the hash of the texture; "" for the controls, which the code decides."""
        return _hash_of(self.texture) + ("-projected" if self.project else "")

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the first car (or walker) besides the ego; for signs the ego, if one stands beside its route."""
        target = parse_target(self.printed_texture().target)
        if isinstance(target, TargetSign):
            route = episode.agents[EGO].route
            return EGO if route is not None and len(signs_of_route(town, route.xy)) else None
        kind = AgentKind.WALKER if isinstance(target, TargetWalker) else AgentKind.CAR
        agents = enumerate(episode.agents)
        return next((number for number, agent in agents if number and MODELS[agent.model].kind == kind), None)

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite in which an agent, or every stop sign, wears the texture."""
        return suite.with_agent_edit(self.agent_edit(target))

    def agent_edit(self, agent: int) -> AgentEdit:
        """Return the edit in which an agent wears the texture; the agent is ignored for signs.

        A patch has its trained size, or a smaller one if the body has no room for it.
        """
        printed_texture = self.printed_texture()
        if self.texture in CONTROLS:
            return printed_texture.live(agent)

        def edit(mesh: Mesh) -> SceneEdit:
            for share in SIZES:
                options = {
                    key: share * value if key in ("width", "height") else value
                    for key, value in printed_texture.options.items()
                }
                try:
                    return replace(printed_texture, options=options).edit(mesh)
                except ConfigError:
                    if share == SIZES[-1]:
                        raise
            raise AssertionError

        return replace(printed_texture.live(agent), edit=edit)

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1, and truth of a recorded target that wears the texture.

        Raises:
            ConfigError: The texture does not fit on the target, or no image shows it.
        """
        printed_texture = self.printed_texture()
        return wearing_images(
            images, albedo_of(printed_texture.colour), printed_texture.on(parse_target(printed_texture.target).mesh())
        )


def wearing_images(images: TargetImages, albedo: Tensor, surface: Any) -> Iterator[tuple[str, Tensor, Truth]]:
    """Yield drive, image and truth of a recorded target that wears a texture.

    Args:
        images: The recorded images.
        albedo: The texture, linear [3, H, W].
        surface: Surface of the target that wears it.
    """
    colour = albedo.to(images.device)
    remaining = images.wearing(surface)
    # One at a time on the CPU: the bits of an image must not depend on its batch.
    while batch := list(islice(remaining, 1 if images.device == "cpu" else BATCH)):
        prepared = [view.picture for _, view in batch]
        with torch.no_grad():
            worn_images = prepared[0].together(prepared, {0: colour.expand(len(batch), *colour.shape)})
        for (drive, view), image in zip(batch, torch.split(worn_images, 1), strict=True):
            yield drive, image, view.truth


@lru_cache(maxsize=64)
def _load_printed_texture(name: str) -> PrintedTexture:
    if name in CONTROLS:
        surface = make_carrier("camouflage", {}).on(parse_target(CONTROLS[name]).mesh())
        return PrintedTexture(torch.full((3, *surface.size), 0.5), "camouflage", {}, CONTROLS[name])
    if is_export(name):
        return load_printed_texture(Path(name).expanduser())
    texture, card = load_texture(name)
    return PrintedTexture(texture, card.carrier, card.options, card.target)


@lru_cache(maxsize=64)
def _projected(name: str) -> PrintedTexture:
    printed_texture = _load_printed_texture(name)
    return replace(printed_texture, colour=project_onto_gamut(printed_texture.colour))


@lru_cache(maxsize=256)
def _hash_of(name: str) -> str:
    if name in CONTROLS:
        return ""
    if is_export(name):
        files = (Path(name).expanduser() / file for file in ("texture.json", "texture.npz"))
        return hashlib.sha256(b"".join(safeio.read_bytes(file) for file in files)).hexdigest()
    return load_texture(name)[1].hash


def is_export(name: str) -> bool:
    """Return True for a folder that `ssad export texture` wrote."""
    return (Path(name).expanduser() / "texture.json").is_file()


def class_of_texture(name: str) -> str:
    """Return the class of the target of a texture, such as car or stop_sign."""
    return class_of_target(parse_target(_load_printed_texture(name).target))


def signs_of_route(graph: LaneGraph, route: F32) -> F64:
    """Return the positions x, y [M, 2] of the stop signs along a route [N, 2]."""
    sign_positions = graph.sign_xy[graph.sign_kind == SignKind.STOP].astype(np.float64).reshape(-1, 2)
    route_distances = np.linalg.norm(sign_positions[:, None] - route[None], axis=-1).min(1)
    nearby_signs: F64 = sign_positions[route_distances < SIGN_DISTANCE]
    return nearby_signs
