"""One atlas for each style: a texture made on one body lies on the same parts of the next."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, make_body


@pytest.mark.parametrize("kind", BODIES)
def test_panels_have_one_place_whatever_size_and_detail(kind: str) -> None:
    for style in BODIES[kind].styles:
        bodies = [make_body(kind, style=style, generator=generator("atlas test", k), detail=k % 3) for k in range(3)]
        first = dict(zip(bodies[0].panels, bodies[0].rectangles, strict=True))
        for body in bodies[1:]:
            assert dict(zip(body.panels, body.rectangles, strict=True)) == first


@pytest.mark.parametrize("style", BODIES["car"].styles)
def test_a_texel_lies_on_the_same_part_of_every_car(style: str) -> None:
    """Where a texture coordinate is on the body, in shares of its length, width and height: within a twentieth."""
    places = []
    for k in range(3):
        body = make_body("car", style=style, generator=generator("same part", k))
        low, high = body.bounds()
        corners = (body.corners() - low) / (high - low)
        middle, uv = corners.mean(1), body.uv.astype(float).mean(1)
        places.append((middle[body.panel >= 0], uv[body.panel >= 0], [body.panels[i] for i in body.panel if i >= 0]))
    here, uv, names = places[0]
    for there, other, others in places[1:]:
        for name in {n.split("/")[0] for n in names}:
            mine = np.array([n.split("/")[0] == name for n in names])
            theirs = np.array([n.split("/")[0] == name for n in others])
            gap = np.linalg.norm(uv[mine][:, None] - other[theirs][None], axis=-1)
            near = gap.argmin(1)
            close = gap.min(1) < 0.01
            assert close.mean() > 0.8
            assert np.abs(here[mine][close] - there[theirs][near[close]]).max() < 0.08
