"""People: adults, children and the elderly.

They are in a walking cycle, pushing a stroller, standing, at work on the road, or seated on a two-wheeler.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ssad.core.geometry import cross
from ssad.rendering.bodies.parts import Chart, as_point, crate, unwrap
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, loft, merge, sphere, tube

SKINS = ((0.62, 0.40, 0.29), (0.50, 0.31, 0.21), (0.35, 0.20, 0.13), (0.20, 0.11, 0.07), (0.10, 0.055, 0.035))
HAIRS = ((0.015, 0.012, 0.010), (0.05, 0.03, 0.02), (0.13, 0.075, 0.04), (0.38, 0.27, 0.14), (0.40, 0.40, 0.40))
CLOTHS = (
    (0.02, 0.02, 0.025),
    (0.03, 0.045, 0.11),
    (0.14, 0.14, 0.15),
    (0.55, 0.55, 0.54),
    (0.30, 0.03, 0.04),
    (0.05, 0.16, 0.08),
    (0.42, 0.33, 0.20),
    (0.07, 0.16, 0.36),
    (0.55, 0.38, 0.06),
    (0.36, 0.15, 0.28),
)
HIVIS = (0.55, 0.75, 0.05)
ORANGE = (0.80, 0.22, 0.02)
BANDS = Material("bands", (0.62, 0.64, 0.66), specular=0.2, gloss=0.5)
STICK = Material("stick", (0.06, 0.03, 0.015), specular=0.05, gloss=0.5)
EYES = Material("eyes", (0.012, 0.010, 0.009), specular=0.05, gloss=0.6)
VISOR = Material("visor", (0.012, 0.013, 0.015), specular=0.09, gloss=0.95)
LIPS = Material("lips", (0.16, 0.05, 0.045), specular=0.02, gloss=0.2)


@dataclass(frozen=True, slots=True)
class Look:
    """What a person wears."""

    skin: Material
    hair: Material
    shirt: Material
    trousers: Material
    shoes: Material
    coat: bool = False
    skirt: bool = False
    pack: bool = False
    long_hair: bool = False
    shorts: bool = False
    bag: Material | None = None
    cap: Material | None = None
    helmet: Material | None = None
    inner: Material | None = None  # seen where the jacket is open
    bands: Material | None = None  # reflecting bands of a high-visibility vest
    beard: bool = False
    visor: bool = False  # of a motorcycle helmet


@dataclass(frozen=True, slots=True)
class Pose:
    """Joints in metres. Pairs are (left, right); `forward` is where the chest looks (unit, no share of y)."""

    pelvis: F64
    neck: F64
    head: F64
    hips: tuple[F64, F64]
    knees: tuple[F64, F64]
    ankles: tuple[F64, F64]
    toes: tuple[F64, F64]
    shoulders: tuple[F64, F64]
    elbows: tuple[F64, F64]
    hands: tuple[F64, F64]


def draw_look(
    generator: np.random.Generator, *, helmet: bool = False, rider: bool = False, visor: bool = False
) -> Look:
    """Clothes, skin and hair of a random person; a rider wears neither coat nor skirt."""

    def cloth(name: str, table: tuple[tuple[float, float, float], ...]) -> Material:
        r, g, b = table[int(generator.integers(len(table)))]
        k = float(generator.uniform(0.8, 1.2))
        return Material(name, (min(r * k, 0.8), min(g * k, 0.8), min(b * k, 0.8)), specular=0.02, gloss=0.1)

    shirt, trousers = cloth("shirt", CLOTHS), cloth("trousers", (*CLOTHS[:4], *CLOTHS[:3], CLOTHS[6]))
    coat, skirt, pack, long_hair, vest = generator.random(5) < [0.28, 0.18, 0.25, 0.4, 0.06]
    if vest:
        shirt = replace(shirt, colour=HIVIS)
    helmet_colour = cloth("helmet", (*CLOTHS[3:5], CLOTHS[0], CLOTHS[7]))
    shorts, bag, cap = generator.random(3) < [0.16, 0.2, 0.22]
    bag_colour, cap_colour = cloth("bag", CLOTHS), cloth("cap", CLOTHS)
    opened, beard = generator.random(2) < [0.6, 0.2]
    inner = cloth("inner", CLOTHS)
    if abs(sum(inner.colour) - sum(shirt.colour)) < 0.3:  # told apart from the jacket
        inner = replace(inner, colour=(0.60, 0.60, 0.58) if sum(shirt.colour) < 0.8 else (0.03, 0.03, 0.04))
    return Look(
        cloth("skin", SKINS),
        cloth("hair", HAIRS),
        shirt,
        trousers,
        cloth("shoes", (CLOTHS[0], CLOTHS[3], (0.09, 0.05, 0.03))),
        bool(coat and not rider),
        bool(skirt and not coat and not rider),
        bool(pack),
        bool(long_hair),
        bool(shorts and not coat and not skirt),
        bag_colour if bag and not pack and not rider else None,
        cap_colour if cap and not helmet else None,
        replace(helmet_colour, gloss=0.8) if helmet else None,
        inner if opened else None,
        BANDS if vest else None,
        bool(beard and not long_hair),
        visor,
    )


def walking(height: float, *, phase: float, swing: float, spread: float, child: bool = False) -> Pose:
    """A pose of the walking cycle at a phase (0: the left leg swings through).

    `swing` is the largest angle of the hips, `spread` the angle of the arms away from the trunk, rad.
    """
    h = height
    leg = (0.47 if child else 0.485) * h
    thigh, shin, arm, fore = 0.505 * leg, 0.495 * leg, (0.16 if child else 0.172) * h, 0.15 * h
    hip_z, shoulder = 0.045 * h + leg, (0.105 if child else 0.112) * h
    pelvis = np.array([0.0, 0.0, hip_z])
    lean = 0.06 * min(1.0, swing / 0.4)
    neck_z = (0.80 if child else 0.845) * h
    neck = np.array([np.sin(lean) * (neck_z - hip_z), 0.0, neck_z])
    head = neck + np.array([0.012 * h, 0.0, (0.10 if child else 0.083) * h])
    limbs: list[tuple[F64, ...]] = []
    for sign, turn in ((1.0, phase), (-1.0, phase + np.pi)):
        thigh_angle = swing * np.sin(turn) + 0.04
        flex = swing / 0.45 * (0.10 + 0.95 * max(0.0, np.cos(turn + 0.25)) ** 1.5)
        hip = pelvis + np.array([0.0, sign * 0.052 * h, 0.0])
        knee = hip + thigh * np.array([np.sin(thigh_angle), 0.0, -np.cos(thigh_angle)])
        below = thigh_angle - flex
        ankle = knee + shin * np.array([np.sin(below), 0.0, -np.cos(below)])
        pitch = 0.7 * min(below, 0.0) + 0.45 * max(below, 0.0)
        toe = ankle + np.array([np.cos(pitch), 0.0, np.sin(pitch)]) * 0.10 * h + [0.0, sign * 0.012 * h, -0.028 * h]
        at = neck + np.array([0.0, sign * shoulder, -0.035 * h])
        back = -0.75 * swing * np.sin(turn)
        out = np.array([0.0, sign * np.sin(spread), 0.0])
        elbow = at + arm * (np.array([np.sin(back), 0.0, -np.cos(back)]) * np.cos(spread) + out)
        bent = back + 0.15 + 0.6 * swing + 0.4 * max(0.0, back)
        hand = elbow + fore * (np.array([np.sin(bent), 0.0, -np.cos(bent)]) * np.cos(0.6 * spread) + 0.6 * out)
        limbs.append((hip, knee, ankle, toe, at, elbow, hand))
    return Pose(pelvis, neck, head, *zip(*limbs, strict=True))


def stooped(pose: Pose, *, angle: float, height: float) -> Pose:
    """The pose with its trunk bent forward by an angle (rad) from the hips; the arms still hang, the head looks up."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])

    def bent(point: F64) -> F64:
        return np.asarray(pose.pelvis + turn @ (point - pose.pelvis))

    neck = bent(pose.neck)
    shoulders = bent(pose.shoulders[0]), bent(pose.shoulders[1])
    moves = [new - old for new, old in zip(shoulders, pose.shoulders, strict=True)]
    elbows = pose.elbows[0] + moves[0], pose.elbows[1] + moves[1]
    hands = pose.hands[0] + moves[0], pose.hands[1] + moves[1]
    head = neck + np.array([0.045 * height, 0.0, 0.065 * height])
    return replace(pose, neck=neck, head=head, shoulders=shoulders, elbows=elbows, hands=hands)


def holding(pose: Pose, *, left: Point | None = None, right: Point | None = None, height: float) -> Pose:
    """The pose with a hand, or both, at a place (m); the arm bends to reach it."""
    elbows, hands = list(pose.elbows), list(pose.hands)
    for k, goal in enumerate((left, right)):
        if goal is not None:
            outward = np.array([-0.5, 0.35 * (1.0 - 2.0 * k), -0.8])
            arm = 0.172 * height, 0.15 * height
            elbows[k], hands[k] = reach(pose.shoulders[k], np.array(goal, np.float64), *arm, outward)
    return replace(pose, elbows=(elbows[0], elbows[1]), hands=(hands[0], hands[1]))


def seated(
    height: float,
    *,
    pelvis: Point,
    lean: float,
    hands: tuple[Point, Point],
    feet: tuple[Point, Point],
    knees_out: float = 0.1,
) -> Pose:
    """A rider: seat, forward lean of the trunk (rad), grips and soles (left, right); limbs bend to reach them."""
    h = height
    seat = np.array(pelvis, np.float64)
    trunk = 0.33 * h
    up = np.array([np.sin(lean), 0.0, np.cos(lean)])
    neck = seat + trunk * up
    head = neck + 0.088 * h * np.array([np.sin(0.35 * lean) + 0.12, 0.0, np.cos(0.35 * lean)])
    limbs: list[tuple[F64, ...]] = []
    for sign, hand, foot in ((1.0, hands[0], feet[0]), (-1.0, hands[1], feet[1])):
        hip = seat + np.array([0.0, sign * 0.052 * h, 0.0])
        ankle = np.array(foot) + np.array([-0.05 * h, 0.0, 0.045 * h])
        knee, ankle = reach(hip, ankle, 0.245 * h, 0.24 * h, np.array([1.0, sign * knees_out, 0.3]))
        at = neck + np.array([0.0, sign * 0.108 * h, 0.0]) - 0.035 * h * up
        elbow, wrist = reach(at, np.array(hand), 0.165 * h, 0.15 * h, np.array([-0.4, sign * 0.7, -0.7]))
        limbs.append((hip, knee, ankle, ankle + np.array([0.10 * h, 0.0, -0.035 * h]), at, elbow, wrist))
    return Pose(seat, neck, head, *zip(*limbs, strict=True))


def reach(start: F64, goal: F64, first: float, second: float, bend: F64) -> tuple[F64, F64]:
    """Middle joint and end of a limb of two bones that reaches for a goal and bends towards a direction."""
    line = goal - start
    distance = float(np.clip(np.linalg.norm(line), 1e-6, 0.995 * (first + second)))
    along = line / max(float(np.linalg.norm(line)), 1e-9)
    share = (first**2 - second**2 + distance**2) / (2.0 * distance)
    aside = bend - (bend @ along) * along
    aside /= max(float(np.linalg.norm(aside)), 1e-9)
    middle = start + share * along + np.sqrt(max(first**2 - share**2, 0.0)) * aside
    return middle, start + distance * along


def figure(pose: Pose, look: Look, *, height: float, detail: int, child: bool = False) -> Mesh:
    """A body around the joints of a pose; the shirt lies in the panels torso_front and torso_back."""
    h = height
    n = (4, 6, 10)[detail]
    up = (pose.neck - pose.pelvis) / np.linalg.norm(pose.neck - pose.pelvis)
    forward = cross([0.0, 1.0, 0.0], up)
    parts = [_trunk(pose, look, h, n=2 * n if detail else 6, child=child)]
    leg_look = look.skin if look.skirt else look.trousers
    for k in (0, 1):
        hip, knee, ankle, toe = pose.hips[k], pose.knees[k], pose.ankles[k], pose.toes[k]
        shoulder, elbow, hand = pose.shoulders[k], pose.elbows[k], pose.hands[k]
        if detail == 0:
            sole = ankle - np.array([0.0, 0.0, 0.045 * h])
            parts.append(tube([hip, knee, sole], np.array([0.052, 0.034, 0.030]) * h, material=leg_look, segments=4))
            arm = np.array([0.03, 0.025, 0.02]) * h
            parts.append(tube([shoulder, elbow, hand], arm, material=look.shirt, segments=4))
            continue
        leg = [hip + 0.03 * h * up, 0.6 * hip + 0.4 * knee, 0.1 * hip + 0.9 * knee]
        leg += [0.9 * knee + 0.1 * ankle, 0.6 * knee + 0.4 * ankle, ankle]
        wide = np.array([0.050, 0.048, 0.038, 0.036, 0.034, 0.024]) * h
        if look.shorts:
            parts.append(tube(leg[:3], wide[:3] * 1.12, material=leg_look, segments=n))
            parts.append(tube(leg[2:], wide[2:] * 0.9, material=look.skin, segments=n))
        else:
            parts.append(tube(leg, wide, material=leg_look, segments=n))
        heel = ankle - 0.28 * (toe - ankle) * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.018 * h]
        shoe = [heel, 0.5 * (ankle + toe), toe]
        parts.append(tube(shoe, np.array([0.022, 0.030, 0.018]) * h, material=look.shoes, segments=n))
        wrist = 0.88 * hand + 0.12 * elbow
        inward = np.array([0.0, -np.sign(shoulder[1] - pose.neck[1]), 0.0])
        sleeve = [shoulder + (0.030 * up + 0.030 * inward) * h, shoulder + 0.006 * h * up]
        sleeve += [0.5 * (shoulder + elbow), elbow, wrist]
        parts.append(tube(sleeve, np.array([0.014, 0.031, 0.030, 0.025, 0.019]) * h, material=look.shirt, segments=n))
        fist = (0.020 * h, 0.014 * h, 0.030 * h)
        parts.append(sphere(fist, material=look.skin, centre=as_point(hand), segments=n))
    parts += _head(pose, look, h, detail, 1.35 if child else 1.0)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([forward, [0.0, 1.0, 0.0], up], axis=1)
    if look.pack and detail > 0:
        turn[:3, 3] = pose.pelvis + 0.62 * (pose.neck - pose.pelvis) - 0.10 * h * forward
        parts.append(_box((0.045 * h, 0.075 * h, 0.11 * h), replace(look.trousers, name="pack")).transformed(turn))
    if look.bag is not None and detail > 0:  # at the right hip
        turn[:3, 3] = pose.pelvis + np.array([0.0, -0.125 * h, 0.0]) - 0.01 * h * forward
        parts.append(_box((0.075 * h, 0.022 * h, 0.055 * h), look.bag).transformed(turn))
    return merge(parts)


def _box(half: Point, material: Material) -> Mesh:
    """A box about the origin."""
    return crate((-half[0], -half[1], -half[2]), half, material)


def _trunk(pose: Pose, look: Look, h: float, *, n: int, child: bool) -> Mesh:
    up = (pose.neck - pose.pelvis) / np.linalg.norm(pose.neck - pose.pelvis)
    forward = cross([0.0, 1.0, 0.0], up)
    length = float(np.linalg.norm(pose.neck - pose.pelvis))
    long = look.coat or look.skirt
    rows = [
        (-0.16, 0.050, 0.070),
        (0.06, 0.066, 0.092),
        (0.16, 0.064, 0.089),
        (0.30, 0.060, 0.083),
        (0.62, 0.070, 0.104),
        (0.86, 0.062, 0.112),
        (0.97, 0.038, 0.060),
        (1.03, 0.026, 0.028),
        (1.12, 0.026, 0.028),
    ]
    if long:  # the hem goes round both thighs
        stride = max(abs(float(knee[0] - pose.pelvis[0])) for knee in pose.knees) / h
        rows = [(-0.60, 0.062 + 0.9 * stride, 0.118), (0.0, 0.076 + 0.3 * stride, 0.118), *rows[2:]]
    if look.bands is not None:  # the upper band has rows of its own
        at = next(k for k, entry in enumerate(rows) if entry[0] > 0.52)
        rows[at:at] = [(0.42, 0.064, 0.091), (0.52, 0.067, 0.097)]
    if child:
        rows = [(s, 1.12 * x, y) for s, x, y in rows]
    angle = np.arange(n) * (2.0 * np.pi / n)
    left = np.array([0.0, 1.0, 0.0])
    sections = [
        pose.pelvis
        + s * length * (up if s > 0 else np.array([0.0, 0.0, 1.0]))
        + h * (x * np.cos(angle)[:, None] * forward + y * np.sin(angle)[:, None] * left)
        for s, x, y in rows
    ]
    body = loft(np.array(sections), material=look.shirt, smooth=1.0)
    centre = body.corners().mean(axis=1) - pose.pelvis
    row = np.minimum(np.arange(len(body.faces)) // (2 * n), len(rows))  # caps come last
    hem = 0 if look.coat else 2 - int(long)
    front = centre @ forward >= 0.0
    neck = row >= len(rows) - 2
    shirt = (row >= hem) & (row < len(rows) - 1)
    material = np.where(neck, 2, np.where(shirt, 0, 1))
    materials = [look.shirt, look.trousers, look.skin]
    jacket = shirt & ~neck
    if look.bands is not None:
        banded = [k for k, entry in enumerate(rows) if entry[0] in (0.06, 0.42)]
        material[jacket & np.isin(row, banded)] = len(materials)
        materials.append(look.bands)
    if look.inner is not None and n > 6:  # a strip down the middle of the chest, 30 degrees to either side at most
        column = np.arange(len(body.faces)) // 2 % n
        middle = np.minimum(column, n - 1 - column) == 0
        material[jacket & middle & (row < len(rows))] = len(materials)
        materials.append(look.inner)
    panel = np.where(shirt & ~neck, np.where(front, 0, 1), -1).astype(np.int32)
    return replace(
        body,
        material=material.astype(np.int32),
        materials=tuple(materials),
        panel=panel,
        panels=("torso_front", "torso_back"),
    )


def _head(pose: Pose, look: Look, h: float, detail: int, big: float) -> list[Mesh]:
    x, y, z = (float(v) for v in pose.head)
    n = (6, 8, 14)[detail]
    s = big * h

    def ball(half_axes: Point, material: Material, ahead: float = 0.0, up: float = 0.0, segments: int = n) -> Mesh:
        """An ellipsoid in units of the head's size, about a place in the frame of its middle."""
        a, b, c = half_axes
        centre = (x + ahead * s, y, z + up * s)
        return sphere((a * s, b * s, c * s), material=material, centre=centre, segments=segments)

    parts = [ball((0.050, 0.042, 0.064), look.skin)]
    if look.helmet is not None and look.visor:
        parts.append(ball((0.068, 0.060, 0.066), look.helmet, -0.006, 0.012))
        if detail > 0:
            parts.append(ball((0.030, 0.050, 0.020), VISOR, 0.038, 0.012, segments=8))
    elif look.helmet is not None:  # its rim lies above the eyes
        parts.append(ball((0.050, 0.048, 0.050), look.hair, -0.018, 0.004))
        parts.append(ball((0.066, 0.058, 0.044), look.helmet, -0.006, 0.044))
        if look.cap is not None and detail > 0:  # the peak of a safety helmet
            parts.append(ball((0.036, 0.044, 0.008), look.cap, 0.054, 0.032, segments=6))
    else:
        parts.append(ball((0.050, 0.048, 0.056), look.hair, -0.016, 0.016))
        if look.long_hair and detail > 0:
            parts.append(ball((0.030, 0.042, 0.070), look.hair, -0.030, -0.035))
        if look.cap is not None:  # its peak points ahead
            parts.append(ball((0.056, 0.051, 0.042), look.cap, -0.006, 0.034))
            if detail > 0:
                parts.append(ball((0.040, 0.040, 0.008), look.cap, 0.058, 0.026, segments=6))
    if detail > 0:  # the face: eyes under their brows, nose, mouth or beard
        parts.append(ball((0.016, 0.030, 0.008), EYES, 0.038, 0.008, segments=6))
        parts.append(ball((0.014, 0.009, 0.014), look.skin, 0.049, -0.009, segments=6))
        if look.beard:
            parts.append(ball((0.026, 0.034, 0.026), look.hair, 0.022, -0.042, segments=6))
        elif detail == 2:
            parts.append(ball((0.012, 0.016, 0.005), LIPS, 0.036, -0.031, segments=6))
    if detail == 2:
        neck = [pose.neck - np.array([0.0, 0.0, 0.02 * h]), pose.head - [0.01 * h, 0.0, 0.02 * h]]
        parts.append(tube(neck, 0.030 * h, material=look.skin, segments=8))
    return parts


def _sole(pose: Pose, h: float) -> float:
    """Height of the lowest sole of a pose, m."""
    return float(min(p[2] for p in (*pose.toes, *pose.ankles))) - 0.018 * h


def _stick(pose: Pose, h: float) -> F64:
    """Top and tip [2, 3] of a walking stick in the right hand, m."""
    x, y, z = as_point(pose.hands[1])
    return np.array([(x, y, z + 0.012 * h), (x + 0.03 * h, y, _sole(pose, h) + 0.012 * h)])


def _extent(pose: Pose, h: float) -> F64:
    """Corners [2, 3] of a box about a pose whose lowest sole is at 0, m: joints and the flesh around them."""
    joints = np.array([*pose.toes, *pose.ankles, *pose.knees, *pose.elbows, *pose.hands, *pose.shoulders, pose.head])
    flesh = h * np.array([0.004] * 2 + [0.026] * 2 + [0.036] * 2 + [0.025] * 2 + [0.016] * 2 + [0.031] * 2 + [0.064])
    floor = _sole(pose, h)
    low = np.minimum(
        (joints - flesh[:, None]).min(axis=0), np.array(pose.ankles).min(axis=0) - np.array([0.028 * h, 0.0, 0.0])
    )
    high = (joints + flesh[:, None]).max(axis=0)
    return np.array([[low[0], low[1], 0.0], [high[0], high[1], high[2] - floor + 0.008 * h]])


def _pose(style: str, height: float, phase: float, swing: float, spread: float) -> Pose:
    """A moment of the walking cycle of a style (see `walking`)."""
    walker = walking(height, phase=phase, swing=swing, spread=spread, child=style == "child")
    if style == "elderly":
        walker = stooped(walker, angle=0.32, height=height)
        shoulder = walker.shoulders[1]
        grip = shoulder[0] + (0.10 + 0.05 * np.sin(phase)) * height, shoulder[1] - 0.02 * height, 0.47 * height
        return holding(walker, right=as_point(grip), height=height)
    if style == "stroller":
        left, right = ((0.235 * height, side * 0.115 * height, 0.58 * height) for side in (1.0, -1.0))
        return holding(walker, left=left, right=right, height=height)
    return walker


@lru_cache(maxsize=64)
def _cycle_extent(style: str, height: float, swing: float, spread: float) -> tuple[F64, F64]:
    """Lowest and highest corner [3] of the boxes of a walking cycle, m."""
    phases = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    boxes = np.array([_extent(_pose(style, height, float(p), swing, spread), height) for p in phases])
    return boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)


def _dressed(look: Look, style: str, own: float) -> Look:
    """The clothes that belong to a style; `own` in [0, 1) is drawn for the person."""
    if style == "elderly":
        shade = 0.30 + 0.35 * own
        grey = replace(look.hair, colour=(shade, shade, 0.97 * shade))
        return replace(look, hair=grey, pack=False, shorts=False, long_hair=look.long_hair and own < 0.4)
    if style == "worker":
        vest = replace(look.shirt, colour=HIVIS if own < 0.6 else ORANGE)
        shell = Material("helmet", ((0.75, 0.75, 0.72), (0.80, 0.52, 0.02), ORANGE)[int(3.0 * own)], gloss=0.6)
        dark = replace(look.trousers, colour=(0.03, 0.04, 0.08) if own < 0.7 else ORANGE)
        return replace(
            look,
            shirt=vest,
            trousers=dark,
            helmet=shell,
            cap=shell,
            bands=BANDS,
            coat=False,
            skirt=False,
            pack=False,
            shorts=False,
            bag=None,
        )
    if style == "stroller":
        return replace(look, bag=None)
    return look


def torso_charts(low: Point, high: Point) -> list[Chart]:
    """Panels of a person's shirt."""
    return [Chart("torso_front", "front", low, high), Chart("torso_back", "rear", low, high)]


def pedestrian(
    style: str, size: Point, *, generator: np.random.Generator, detail: int, phase: float | None = None
) -> Mesh:
    """A person whose walking cycle fills the size (m): the box is that of the whole cycle, as box labels are.

    `phase` in rad is the place in the cycle (period 2 pi); None draws it. A standing person fills the box at once.
    """
    length, width, height = size
    look = draw_look(generator)
    drawn, own = float(generator.uniform(0.0, 2.0 * np.pi)), float(generator.random())
    look = _dressed(look, style, own)
    child, still = style == "child", style == "standing" or (style == "worker" and length < 0.32 * height)
    swing = float(np.arcsin(np.clip((length - 0.16 * height) / height, 0.06, 0.16 if still else 0.6)))
    spread = float(np.arcsin(np.clip((0.5 * width - 0.145 * height) / (0.27 * height), 0.03, 0.5)))

    at = 0.5 * np.pi if still else drawn if phase is None else phase
    posed = _pose(style, height, at, swing, spread)
    chosen = figure(posed, look, height=height, detail=detail, child=child)
    if style == "elderly":
        chosen = merge(
            [chosen, tube(_stick(posed, height), 0.009 * height, material=STICK, segments=(3, 4, 6)[detail])]
        )
    chosen = chosen.moved(z=-float(chosen.bounds()[0][2]))
    low, high = chosen.bounds()
    if not still:
        least, most = _cycle_extent(style, height, swing, spread)
        low, high = np.minimum(low, least), np.maximum(high, most)
    scale = np.asarray(size) / (high - low)
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = -scale * [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.0]
    chest = (-0.3 * length, -0.35 * width, 0.35 * height), (0.3 * length, 0.35 * width, 0.9 * height)
    return unwrap(chosen.transformed(matrix), torso_charts(*chest))
