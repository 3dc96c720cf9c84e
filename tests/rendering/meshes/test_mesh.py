"""Meshes: solids, bodies of road users."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, PAINT_SHARES, PAINTS, draw_paint, draw_size, make_body
from ssad.rendering.bodies.parts import MARGIN, Chart, pack
from ssad.rendering.meshes.mesh import Material, Mesh, box, lathe, loft, merge, prism, ring, sphere, triangulate, tube

GREY = Material("grey", (0.5, 0.5, 0.5))
RED = Material("red", (0.5, 0.1, 0.1), paint=True)
STYLES = [(kind, style) for kind, body in BODIES.items() for style in body.styles]
PAINTED = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle")


@functools.cache
def body(kind: str, style: str, detail: int = 2) -> Mesh:
    return make_body(kind, style=style, generator=generator("mesh", kind, style), detail=detail)


def face_normals(mesh: Mesh) -> np.ndarray:
    p = mesh.corners()
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def volume_of(mesh: Mesh) -> float:
    """Signed volume: positive where closed surfaces face outwards."""
    p = mesh.corners()
    return float(np.einsum("fi,fi->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6.0)


def panel_faces(mesh: Mesh, name: str) -> np.ndarray:
    """Faces of a panel, or of all parts of it, [F] bool."""
    return np.isin(mesh.panel, [i for i, p in enumerate(mesh.panels) if p == name or p.startswith(f"{name}/")])


def panel_scale(mesh: Mesh, name: str) -> float:
    """Metres on the surface for one unit of u or v, averaged over a panel."""
    chosen = panel_faces(mesh, name)
    a, b = (mesh.uv[chosen, k] - mesh.uv[chosen, 0] for k in (1, 2))
    flat = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    return float(np.sqrt(mesh.areas()[chosen].sum() / flat))


# ---------------------------------------------------------------- solids


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        (box((1.0, 2.0, 3.0), material=GREY), 6.0),
        (prism([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], (1.0, 3.0), material=GREY), 6.0),
        (prism([(0, 0), (0, 2), (1, 2), (1, 1), (2, 1), (2, 0)], (1.0, 3.0), material=GREY, axis=1), 6.0),
        (lathe([(1.0, 0.0), (1.0, 2.0)], material=GREY, segments=256), 2.0 * np.pi),
        (lathe([(1.0, 0.0), (1.0, 2.0)], material=GREY, segments=256, axis=0), 2.0 * np.pi),
        (sphere(1.0, material=GREY, segments=200), 4.0 / 3.0 * np.pi),
        (sphere((1.0, 2.0, 0.5), material=GREY, segments=200), 4.0 / 3.0 * np.pi),
        (tube([(0, 0, 0), (0, 0, 2)], 0.5, material=GREY, segments=256), 0.5 * np.pi),
        (ring(1.0, 0.2, material=GREY, segments=128, around=64), 2.0 * np.pi**2 * 0.9 * 0.01),
    ],
)
def test_solids_have_their_volume_and_face_outwards(mesh: Mesh, volume: float) -> None:
    mesh.check()
    assert volume_of(mesh) == pytest.approx(volume, rel=4e-3)
    # a closed surface: the area vectors cancel
    np.testing.assert_allclose(face_normals(mesh).sum(axis=0), 0.0, atol=1e-4)
    assert (np.einsum("fci,fi->fc", mesh.normals, face_normals(mesh)) > 0).all()


def test_normals_are_smooth_round_a_sphere_and_sharp_on_a_box() -> None:
    ball = sphere(2.0, material=GREY, segments=32)
    radial = ball.corners() / np.linalg.norm(ball.corners(), axis=-1, keepdims=True)
    assert np.einsum("fci,fci->fc", radial, ball.normals).min() > 0.99
    cube = box((1.0, 1.0, 1.0), material=GREY)
    assert np.allclose(np.abs(cube.normals).max(axis=-1), 1.0)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.2, 1.0), min_size=4, max_size=14))
def test_triangulation_keeps_the_area_of_a_star(radii: list[float]) -> None:
    angle = np.arange(len(radii)) * 2.0 * np.pi / len(radii)
    p = np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    faces = triangulate(p)
    assert faces.shape == (len(radii) - 2, 3)
    a, b, c = p[faces[:, 0]], p[faces[:, 1]], p[faces[:, 2]]
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    q = np.roll(p, -1, axis=0)
    assert areas.min() >= -1e-9
    assert areas.sum() == pytest.approx(0.5 * np.sum(p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]))


def test_triangles_do_not_cut_a_corner_that_touches_them() -> None:
    p = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    a, b, c = (p[k] for k in triangulate(p).T)
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert np.abs(areas).sum() == pytest.approx(3.0)


def test_a_crossing_polygon_is_refused() -> None:
    with pytest.raises(ConfigError, match="crosses itself"):
        triangulate([(0, 0), (1, 1), (1, 0), (0, 1), (0.5, -1), (0.5, 2)])


def test_transformed_keeps_outside_outside() -> None:
    mesh = prism([(0, 0), (2, 0), (0, 1)], (0.0, 1.0), material=GREY)
    mirror = mesh.transformed(np.diag([1.0, -1.0, 1.0, 1.0]))
    assert volume_of(mirror) == pytest.approx(volume_of(mesh))
    shear = np.eye(4)
    shear[0, 2], shear[:3, 3] = 0.7, (1.0, 2.0, 3.0)
    moved = mesh.transformed(shear)
    made = face_normals(moved) / np.linalg.norm(face_normals(moved), axis=1, keepdims=True)
    np.testing.assert_allclose(moved.normals[:, 0], made, atol=1e-5)
    with pytest.raises(ConfigError, match="singular"):
        mesh.transformed(np.zeros((3, 3)))


def test_merge_joins_materials_and_panels() -> None:
    a = box((1.0, 1.0, 1.0), material=GREY, panel="side")
    b = box((1.0, 1.0, 1.0), material=RED, centre=(3.0, 0.0, 0.0), panel="top")
    both = merge([a, b, a.moved(y=5.0)])
    assert both.materials == (GREY, RED)
    assert both.panels == ("side", "top")
    assert volume_of(both) == pytest.approx(3.0)
    assert both.painted().sum() == 12
    assert panel_faces(both, "side").sum() == 24
    assert panel_scale(both, "top") == pytest.approx(1.0)
    with pytest.raises(ConfigError, match="no panel 'hood'; this mesh has: side, top"):
        both.panel_rectangle("hood")


def test_check_names_the_fault() -> None:
    good = box((1.0, 1.0, 1.0), material=GREY)
    good.check("cube.obj")
    cases = {
        "vertices hold NaN": {"vertices": np.full_like(good.vertices, np.nan)},
        "vertex index is out of range": {"faces": good.faces + 1},
        "material index is out of range": {"material": good.material + 1},
        "panel index is out of range": {"panel": good.panel + 1},
        r"leave \[0, 1\]": {"uv": good.uv + 0.5},
        "faces have no area": {"faces": np.zeros_like(good.faces)},
        "normals are not of unit length": {"normals": 2.0 * good.normals},
        "have shape": {"uv": good.uv[:-1]},
    }
    for message, change in cases.items():
        fields = {name: getattr(good, name) for name in Mesh.__dataclass_fields__}
        with pytest.raises(FormatError, match=message) as error:
            Mesh(**{**fields, **change}).check("cube.obj")
        assert str(error.value).startswith("cube.obj: ")
        assert "\n" not in str(error.value)


def test_an_open_loft_has_no_caps() -> None:
    square = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
    open_side = loft(np.stack([square, square + np.array([0.0, 0.0, 1.0])]), material=GREY, closed=False)
    assert open_side.areas().sum() == pytest.approx(3.0)
    assert open_side.uv.min() == 0.0
    assert open_side.uv.max() == 1.0


# ---------------------------------------------------------------- bodies


@pytest.mark.parametrize("detail", [0, 1, 2])
@pytest.mark.parametrize(("kind", "style"), STYLES)
def test_every_body_is_sound(kind: str, style: str, detail: int) -> None:
    mesh = body(kind, style, detail)
    mesh.check(f"{kind} {style}")
    assert volume_of(mesh) > 0.0
    turned = np.einsum("fci,fi->fc", mesh.normals, face_normals(mesh)) > 0
    assert turned.mean() > 0.995
    low, _ = mesh.bounds()
    assert low[2] == pytest.approx(0.0, abs=0.09 if kind == "pedestrian" else 1e-5)
    assert not (mesh.painted() & (mesh.panel < 0)).any(), "paint lies in a panel"


@pytest.mark.parametrize("detail", [0, 1, 2])
@pytest.mark.parametrize(("kind", "style"), [s for s in STYLES if s[0] != "pedestrian"])
def test_a_body_fills_its_size_exactly(kind: str, style: str, detail: int) -> None:
    size = np.array(BODIES[kind].styles[style].size) * [1.05, 0.96, 1.03]
    mesh = make_body(kind, style=style, size=tuple(size), generator=generator(1), detail=detail)
    low, high = mesh.bounds()
    np.testing.assert_allclose(high, [0.5 * size[0], 0.5 * size[1], size[2]], atol=2e-5)
    np.testing.assert_allclose(low, [-0.5 * size[0], -0.5 * size[1], 0.0], atol=2e-5)


@pytest.mark.parametrize(
    ("style", "size"),
    [
        ("adult", (0.73, 0.67, 1.77)),
        ("child", (0.5, 0.5, 1.2)),
        ("adult", (1.0, 0.9, 1.9)),
        ("elderly", (0.70, 0.66, 1.60)),
        ("stroller", (0.80, 0.62, 1.70)),
        ("worker", (0.78, 0.68, 1.80)),
    ],
)
def test_a_walker_fills_its_box_over_the_cycle_and_never_leaves_it(
    style: str, size: tuple[float, float, float]
) -> None:
    boxes = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        mesh = make_body("pedestrian", style=style, size=size, generator=generator(3), detail=2, phase=phase)
        boxes.append(mesh.bounds())
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    half = np.array([0.5 * size[0], 0.5 * size[1], size[2]])
    assert (low >= [-half[0] - 1e-5, -half[1] - 1e-5, -1e-5]).all()
    assert (high <= half + 1e-5).all()
    np.testing.assert_allclose(high - low, size, rtol=0.06)


def test_walking_swings_opposite_legs() -> None:
    forward = [
        make_body("pedestrian", style="adult", generator=generator(9), phase=p).bounds()[1][0]
        for p in (0.5 * np.pi, 0.0)
    ]
    assert forward[0] > forward[1] + 0.1
    one, other = (
        make_body("pedestrian", style="adult", generator=generator(9), phase=p) for p in (0.5 * np.pi, 1.5 * np.pi)
    )
    mirrored = one.transformed(np.diag([1.0, -1.0, 1.0]))
    np.testing.assert_allclose(mirrored.bounds(), other.bounds(), atol=0.02)


@pytest.mark.parametrize("style", ["standing", "worker"])
def test_a_standing_person_fills_the_box(style: str) -> None:
    mesh = make_body("pedestrian", style=style, size=(0.5, 0.6, 1.8), generator=generator(2))
    low, high = mesh.bounds()
    np.testing.assert_allclose(high - low, (0.5, 0.6, 1.8), atol=1e-4)


@pytest.mark.parametrize(("kind", "style"), STYLES)
def test_panels_lie_apart_in_the_atlas_and_are_the_same_at_all_details(kind: str, style: str) -> None:
    mesh = body(kind, style)
    rectangles = np.array([mesh.panel_rectangle(p) for p in mesh.panels]).reshape(-1, 4)
    assert (rectangles[:, :2] >= 0.0).all()
    assert (rectangles[:, 2:] <= 1.0).all()
    assert (rectangles[:, 2:] > rectangles[:, :2]).all()
    for i, a in enumerate(rectangles):
        for j, b in enumerate(rectangles[:i]):
            width = min(a[2], b[2]) - max(a[0], b[0])
            height = min(a[3], b[3]) - max(a[1], b[1])
            assert min(width, height) < 1e-9, (mesh.panels[i], mesh.panels[j])
            if mesh.panels[i].split("/")[0] != mesh.panels[j].split("/")[0]:
                assert max(-width, -height) > 1.9 * MARGIN or min(width, height) < -1.9 * MARGIN
    for detail in (0, 1):
        other = body(kind, style, detail)
        assert other.panels == mesh.panels
        assert other.rectangles == mesh.rectangles
    for name in {*(p.split("/")[0] for p in mesh.panels), *mesh.panels}:
        chosen = panel_faces(mesh, name)
        u0, v0, u1, v1 = mesh.panel_rectangle(name)
        uv = mesh.uv[chosen]
        assert uv.size == 0 or (uv.min(axis=(0, 1)) >= np.array([u0, v0]) - 5e-3).all()
        assert uv.size == 0 or (uv.max(axis=(0, 1)) <= np.array([u1, v1]) + 5e-3).all()


@pytest.mark.parametrize("style", BODIES["car"].styles)
def test_car_panels_have_area_in_proportion_and_upright_texture(style: str) -> None:
    mesh = body("car", style)
    names = {"hood", "roof", "front", "rear", "left_side/front_door", "right_side/rear_door"}
    assert names <= set(mesh.panels)
    scales = [panel_scale(mesh, p) for p in (*names, "left_side", "right_side")]
    assert max(scales) / min(scales) < 1.35
    # left side: front of the car to the left of the texture, roof at its upper edge; the right side mirrors it
    for name, sign in (("left_side", -1.0), ("right_side", 1.0)):
        chosen = panel_faces(mesh, name)
        p, uv = mesh.corners()[chosen].reshape(-1, 3), mesh.uv[chosen].reshape(-1, 2)
        assert np.corrcoef(p[:, 0], uv[:, 0])[0, 1] * sign > 0.999
        assert np.corrcoef(p[:, 2], uv[:, 1])[0, 1] < -0.999
    rear = panel_faces(mesh, "rear")
    p, uv = mesh.corners()[rear].reshape(-1, 3), mesh.uv[rear].reshape(-1, 2)
    assert np.corrcoef(p[:, 1], uv[:, 0])[0, 1] < -0.999


@pytest.mark.parametrize("style", BODIES["car"].styles)
def test_cars_cost_what_their_detail_says(style: str) -> None:
    counts = [len(body("car", style, d).faces) for d in (0, 1, 2)]
    assert counts[0] < 150
    assert 800 <= counts[1] <= 2500 < counts[2] <= 5500
    names = {m.name for m in body("car", style).materials}
    colour = "cover" if style == "global_vehicle_target" else "paint"
    assert {colour, "glass", "tyre", "head_lamp", "tail_lamp", "plate", "trim"} <= names


@pytest.mark.parametrize(("kind", "style"), [s for s in STYLES if s[0] in ("car", "truck", "bus", "trailer")])
def test_the_silhouette_stays_at_low_detail(kind: str, style: str) -> None:
    full, far = (silhouette(body(kind, style, d)) for d in (2, 0))
    assert (full & far).sum() / (full | far).sum() > 0.86


def silhouette(mesh: Mesh) -> np.ndarray:
    """The side view (x, z) as filled pixels, [40, 100]."""
    import cv2

    low, high = mesh.bounds()
    p = (mesh.corners()[..., [0, 2]] - low[[0, 2]]) / (high - low)[[0, 2]] * [99.0, 39.0]
    image = np.zeros((40, 100), np.uint8)
    for triangle in np.round(p).astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 1)
    return image.astype(bool)


@pytest.mark.parametrize("kind", BODIES)
def test_a_body_depends_on_its_key_alone(kind: str) -> None:
    one, same = (make_body(kind, generator=generator("a", 1), detail=1) for _ in range(2))
    for name in ("vertices", "faces", "normals", "uv", "material", "panel"):
        assert getattr(one, name).tobytes() == getattr(same, name).tobytes()
    assert one.materials == same.materials
    sizes = {tuple(np.round(make_body(kind, generator=generator("a", k), detail=0).bounds()[1], 4)) for k in range(6)}
    assert len(sizes) > 3


@pytest.mark.parametrize(("kind", "style"), STYLES)
def test_what_is_drawn_does_not_depend_on_the_detail(kind: str, style: str) -> None:
    states = []
    for detail in (0, 2):
        random = generator("draws", kind)
        make_body(kind, style=style, generator=random, detail=detail)
        states.append(random.random())
    assert states[0] == states[1]


def test_drawn_sizes_lie_about_their_mean() -> None:
    random = generator("sizes")
    sizes = np.array([draw_size("car", "sedan", generator=random) for _ in range(400)])
    mean = np.array(BODIES["car"].styles["sedan"].size)
    np.testing.assert_allclose(sizes.mean(axis=0), mean, rtol=0.01)
    assert (np.abs(sizes / mean - 1.0) < 0.1).all()


def test_paints_and_lights() -> None:
    assert set(PAINTS) == set(PAINT_SHARES)
    colours = np.array([draw_paint(generator("paint", k)) for k in range(50)])
    assert ((colours >= 0.0) & (colours <= 0.9)).all()
    assert {"lamp_red", "lamp_yellow", "lamp_green"} <= {m.name for m in body("traffic_signal", "post").materials}
    assert any(m.paint for kind in PAINTED for m in make_body(kind, generator=generator(0)).materials)


def test_unknown_names_and_sizes_are_refused() -> None:
    random = generator(0)
    with pytest.raises(UnknownNameError, match="unknown body 'cra'; closest: car"):
        make_body("cra", generator=random)
    with pytest.raises(UnknownNameError, match="sedan"):
        make_body("car", style="sedann", generator=random)
    for size in ((4.0, 2.0, 0.0), (4.0, 2.0, np.nan), (1e6, 2.0, 1.5), (4.0, 2.0)):
        with pytest.raises(ConfigError, match="three lengths"):
            make_body("car", size=size, generator=random)
    with pytest.raises(ConfigError, match="detail 3"):
        make_body("car", generator=random, detail=3)


def test_packing_fits_any_charts() -> None:
    random = generator("pack")
    charts = [Chart(f"c{k}", "front", (0.0, 0.0, 0.0), (0.0, *random.uniform(0.05, 5.0, 2))) for k in range(20)]
    placed = pack(charts)
    assert len({round(s, 12) for _, _, s in placed.values()}) == 1
    for chart in charts:
        u, v, scale = placed[chart.name]
        width, height = chart.extent()
        assert u + width * scale <= 1.0 - MARGIN + 1e-9
        assert v + height * scale <= 1.0 - MARGIN + 1e-9
