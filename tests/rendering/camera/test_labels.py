"""Labels of pictures: tight boxes, visible shares, what lies inside."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.nuscenes_names import visibility_token
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.labels import Labels, extents, label_image, visible_share
from ssad.rendering.camera.render import PLAIN, Rendering, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.meshes.mesh import Material, box

WIDTH, HEIGHT, FOCAL = 640, 360, 500.0
CAMERA = Camera(WIDTH, HEIGHT, np.array([[FOCAL, 0, 320.0], [0, FOCAL, 180.0], [0, 0, 1]]))
EYE = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # along +x, 1.5 m up
BODIES = ("car", "bus", "motorcycle", "bicycle", "pedestrian", "traffic_cone", "barrier")
GREY = Material("grey", (0.5, 0.5, 0.5))


@functools.cache
def stage() -> RenderScene:
    """Mesh 0: a box 0.5 x 2 x 2 m about (0.25, 0, 1.5), its front at x = 0; then bodies."""
    slab = box((0.5, 2.0, 2.0), centre=(0.25, 0.0, 1.5), material=GREY)
    return RenderScene(None, [slab, *(make_body(kind, generator=generator("labels", kind)) for kind in BODIES)])


def at(x: float, y: float = 0.0, *, mesh: int = 0, tag: int = 1, yaw: float = 0.0) -> SceneObject:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:2, 3] = x, y
    return SceneObject(mesh, pose, tag=tag)


def seen(*things: SceneObject, scale: int = 2) -> tuple[Labels, Rendering]:
    view = View(CAMERA, EYE, things)
    picture = render(stage(), [view], scale=scale, quality=PLAIN)
    return label_image(stage(), view, picture, scale=scale), picture


def empty_picture() -> Rendering:
    picture = render(stage(), [View(CAMERA, EYE, (at(10.0),))], quality=PLAIN)
    return replace(picture, tag=np.full_like(picture.tag, -1))


@settings(max_examples=60, deadline=None)
@given(arrays(np.int32, st.tuples(st.integers(1, 7), st.integers(1, 7)), elements=st.sampled_from([-1, 0, 1, 2, 900])))
def test_extents_equal_a_plain_search(tags: np.ndarray) -> None:
    tag, edges, pixels = extents(tags)
    assert tag.tolist() == sorted({t for t in tags.ravel().tolist() if t > 0})
    for t, edge, count in zip(tag, edges, pixels, strict=True):
        rows, columns = np.nonzero(tags == t)
        assert edge.tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert count == len(rows)


def test_a_single_pixel_spans_one_pixel() -> None:
    tags = np.zeros((5, 6), np.int32)
    tags[3, 2] = 7
    tag, edges, pixels = extents(tags)
    assert (tag.tolist(), edges.tolist(), pixels.tolist()) == ([7], [[2.0, 3.0, 3.0, 4.0]], [1])


@pytest.mark.parametrize(("x", "y"), [(5.0, 0.0), (12.3, 1.7), (40.0, -6.0)])
def test_the_box_is_the_projection(x: float, y: float) -> None:
    labels, picture = seen(at(x, y))
    u = [320 - FOCAL * (y + side) / depth for side in (1, -1) for depth in (x, x + 0.5)]
    expected = [min(u), 180 - FOCAL / x, max(u), 180 + FOCAL / x]
    assert np.abs(labels.box[0] - expected).max() <= 1.0
    rows, columns = np.nonzero(picture.tag[0] == 1)
    assert labels.box[0].tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    assert labels.pixels[0] == len(rows)
    assert labels.share[0] > 0.99
    assert labels.image_share[0] == 1.0


@pytest.mark.parametrize(("x", "y"), [(5.0, 0.0), (11.0, 1.1)])
def test_projected_corners_enclose_what_is_drawn(x: float, y: float) -> None:
    """The drawn extent, found to a part of a pixel from pictures moved by such parts, is that of the corners through
    the recorded intrinsic: boxes and intrinsics count from the same corner of the picture."""
    parts = 32
    intrinsic = np.array([[40.0, 0, 31.3], [0, 40.0, 23.7], [0, 0, 1]])
    move = np.arange(parts) / parts
    views = []
    for part in move:
        moved = intrinsic.copy()
        moved[:2, 2] += part
        views.append(View(Camera(64, 48, moved), EYE, (at(x, y),)))
    tags = render(stage(), views, scale=1, quality=PLAIN).tag
    edges = np.array([extents(tag)[1][0] for tag in tags]) - move[:, None]
    # one sample a pixel: a pixel is drawn where its middle lies inside
    drawn = np.concatenate([edges[:, :2].min(0) + 0.5, edges[:, 2:].max(0) - 0.5])
    corners = np.array([(x + a, y + b, c) for a in (0.0, 0.5) for b in (-1.0, 1.0) for c in (0.5, 2.5)])
    pixels = (corners - EYE[:3, 3]) @ EYE[:3, :3] @ intrinsic.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inwards = (drawn - np.concatenate([pixels.min(0), pixels.max(0)])) * [1, 1, -1, -1]
    assert inwards.min() > -1e-3, "the corners enclose it"
    assert inwards.max() < 0.05, "and closely"


@pytest.mark.parametrize("x", [6.0, 15.0, 45.0])
def test_half_hidden_is_half_visible(x: float) -> None:
    near = x - 1.0
    # the left edge of the near slab lies on the line of sight to the middle of the far one
    labels, _ = seen(at(x), at(near, -1.0, tag=2))
    assert labels.tag.tolist() == [1, 2]
    assert labels.share[0] == pytest.approx(0.5, abs=0.03)
    assert labels.share[1] > 0.97
    assert labels.image_share.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("number", range(len(BODIES)))
@pytest.mark.parametrize("x", [7.0, 20.0, 50.0])
def test_a_body_in_the_open_is_fully_visible(number: int, x: float) -> None:
    labels, _ = seen(at(x, mesh=number + 1, yaw=0.7))
    assert labels.share[0] > 0.97


def test_shares_without_supersampling() -> None:
    labels, _ = seen(at(18.0, mesh=1, yaw=0.4), scale=1)
    assert labels.share[0] > 0.98


def test_shares_of_hidden_and_of_seen_pixels_agree() -> None:
    """The share of a covered car is that of its pixels in two pictures, with and without what hides it."""
    car, screen = at(22.0, mesh=1, yaw=0.5), at(9.0, -0.6, tag=2)
    alone, _ = seen(car)
    both, _ = seen(car, screen)
    assert both.tag.tolist() == [1, 2]
    assert both.share[0] == pytest.approx(both.pixels[0] / alone.pixels[0], abs=0.01)


def test_the_part_outside_the_picture_does_not_count_as_hidden() -> None:
    x = 10.0
    labels, _ = seen(at(x, 0.64 * x))  # its middle on the left border
    assert labels.box[0, 0] == 0.0
    assert labels.share[0] > 0.98
    width = FOCAL / x
    flank = FOCAL * (0.64 - (0.64 * x - 1) / (x + 0.5))  # from the border to where the flank ends
    assert labels.image_share[0] == pytest.approx(flank / (flank + width), abs=0.03)


def test_a_thing_beside_the_camera_is_cut_at_the_near_plane() -> None:
    labels, _ = seen(at(1.0, 2.2, mesh=2))
    assert len(labels) == 1
    assert 0.9 < labels.share[0] <= 1.0
    assert 0.0 < labels.image_share[0] < 0.6


def test_what_is_behind_or_beside_has_no_label() -> None:
    things = (at(-8.0, tag=3), at(10.0, 30.0, tag=4), at(10.0, tag=5), at(14.0, tag=6), at(10.0, 3.0, tag=0))
    view = View(CAMERA, EYE, things)
    picture = render(stage(), [view], quality=PLAIN)
    assert label_image(stage(), view, picture).tag.tolist() == [5]
    shares = visible_share(stage(), view, picture)
    assert list(shares) == [3, 4, 5, 6]
    assert (shares[3], shares[4], shares[6]) == (0.0, 0.0, 0.0)
    assert shares[5] > 0.97


def test_things_of_one_tag_are_one() -> None:
    labels, _ = seen(at(10.0, -2.0), at(10.0, 2.0))
    assert labels.tag.tolist() == [1]
    assert labels.share[0] > 0.98
    assert labels.box[0, 0] < 320 - FOCAL * 0.25
    assert labels.box[0, 2] > 320 + FOCAL * 0.25


def test_labels_of_the_second_picture() -> None:
    views = [View(CAMERA, EYE, (at(10.0, tag=8),)), View(CAMERA, EYE, (at(20.0, tag=9),))]
    picture = render(stage(), views, quality=PLAIN)
    assert label_image(stage(), views[1], picture, 1).tag.tolist() == [9]


def test_nothing_there() -> None:
    for view in (View(CAMERA, EYE), View(CAMERA, EYE, (at(-5.0),))):
        labels = label_image(stage(), view, empty_picture())
        assert len(labels) == 0
        assert labels.box.shape == (0, 4)
        assert labels.share.shape == labels.image_share.shape == labels.pixels.shape == (0,)
    assert visible_share(stage(), View(CAMERA, EYE), empty_picture()) == {}


def test_labels_are_the_same_each_time_and_in_any_order() -> None:
    things = [at(8.0 + 3 * n, n - 3.0, mesh=n % 8, tag=n + 1, yaw=n) for n in range(8)]
    first, _ = seen(*things)
    again, _ = seen(*things)
    turned, _ = seen(*things[::-1])
    for name in ("tag", "box", "pixels", "share", "image_share"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
        assert np.array_equal(getattr(first, name), getattr(turned, name))


def test_a_picture_of_another_view_is_refused() -> None:
    view = View(CAMERA, EYE, (at(10.0, tag=8),))
    picture = render(stage(), [view], quality=PLAIN)
    with pytest.raises(ConfigError, match="shows tag 8"):
        label_image(stage(), View(CAMERA, EYE, (at(10.0, tag=2),)), picture)
    with pytest.raises(ConfigError, match="no picture 1"):
        label_image(stage(), view, picture, 1)
    with pytest.raises(ConfigError, match="640 x 360"):
        label_image(stage(), View(Camera.typical(320, 180), EYE, view.objects), picture)


def test_levels_of_visibility() -> None:
    shares = [0.0, 0.39, 0.4, 0.41, 0.6, 0.61, 0.8, 0.81, 1.0]
    assert "".join(visibility_token(s) for s in shares) == "111223344"
