"""People: adults, children and the elderly.

They walk, push a stroller, stand, work on the road, or sit on a two-wheeler.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ssad.core.geometry import cross
from ssad.rendering.bodies.parts import Chart, as_point, crate, unwrap
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, build, loft, merge, prism, sphere, tube

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
# side view of a backpack: ahead and up from its middle, as shares of the stature
PACK_OUTLINE = np.array(
    [(0.045, -0.10), (0.045, 0.095), (0.02, 0.11), (-0.02, 0.095), (-0.045, 0.04), (-0.048, -0.08), (-0.03, -0.105)]
)
LIPS = Material("lips", (0.16, 0.05, 0.045), specular=0.02, gloss=0.2)


@dataclass(frozen=True, slots=True)
class PersonAppearance:
    """Clothes, skin and hair of a person."""

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


CHILDREN = ("child", "child_target")
TARGETS = ("adult_target", "child_target")
# The colours of the test targets are this project's: dark clothes over blue trousers.
TARGET_APPEARANCE = PersonAppearance(
    skin=Material("skin", (0.42, 0.26, 0.18), specular=0.02, gloss=0.1),
    hair=Material("hair", (0.03, 0.02, 0.015), specular=0.02, gloss=0.1),
    shirt=Material("shirt", (0.022, 0.022, 0.025), specular=0.02, gloss=0.1),
    trousers=Material("trousers", (0.03, 0.05, 0.13), specular=0.02, gloss=0.1),
    shoes=Material("shoes", (0.02, 0.02, 0.022), specular=0.02, gloss=0.1),
)


@dataclass(frozen=True, slots=True)
class BodyPose:
    """Joints of a person, m. Pairs are (left, right)."""

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


def draw_appearance(
    generator: np.random.Generator, *, helmet: bool = False, rider: bool = False, visor: bool = False
) -> PersonAppearance:
    """Draw clothes, skin and hair of a random person; a rider wears neither coat nor skirt."""

    def cloth(name: str, table: tuple[tuple[float, float, float], ...]) -> Material:
        red, green, blue = table[int(generator.integers(len(table)))]
        brightness = float(generator.uniform(0.8, 1.2))
        return Material(
            name,
            (min(red * brightness, 0.8), min(green * brightness, 0.8), min(blue * brightness, 0.8)),
            specular=0.02,
            gloss=0.1,
        )

    # Every person takes the same number of draws, whatever is worn in the end.
    shirt, trousers = cloth("shirt", CLOTHS), cloth("trousers", (*CLOTHS[:4], *CLOTHS[:3], CLOTHS[6]))
    has_coat, has_skirt, has_pack, has_long_hair, has_vest = generator.random(5) < [0.28, 0.18, 0.25, 0.4, 0.06]
    if has_vest:
        shirt = replace(shirt, colour=HIVIS)
    helmet_colour = cloth("helmet", (*CLOTHS[3:5], CLOTHS[0], CLOTHS[7]))
    has_shorts, has_bag, has_cap = generator.random(3) < [0.16, 0.2, 0.22]
    bag_colour, cap_colour = cloth("bag", CLOTHS), cloth("cap", CLOTHS)
    is_open, has_beard = generator.random(2) < [0.6, 0.2]
    inner_cloth = cloth("inner", CLOTHS)
    if abs(sum(inner_cloth.colour) - sum(shirt.colour)) < 0.3:  # distinct from the jacket
        inner_cloth = replace(inner_cloth, colour=(0.60, 0.60, 0.58) if sum(shirt.colour) < 0.8 else (0.03, 0.03, 0.04))
    return PersonAppearance(
        cloth("skin", SKINS),
        cloth("hair", HAIRS),
        shirt,
        trousers,
        cloth("shoes", (CLOTHS[0], CLOTHS[3], (0.09, 0.05, 0.03))),
        bool(has_coat and not rider),
        bool(has_skirt and not has_coat and not rider),
        bool(has_pack),
        bool(has_long_hair),
        bool(has_shorts and not has_coat and not has_skirt),
        bag_colour if has_bag and not has_pack and not rider else None,
        cap_colour if has_cap and not helmet else None,
        replace(helmet_colour, gloss=0.8) if helmet else None,
        inner_cloth if is_open else None,
        BANDS if has_vest else None,
        bool(has_beard and not has_long_hair),
        visor,
    )


def walking_pose(height: float, *, phase: float, swing: float, spread: float, child: bool = False) -> BodyPose:
    """Return a pose of the walking cycle at a phase (0: the left leg swings through).

    `swing` is the largest angle of the hips, `spread` the angle of the arms away from the trunk, rad.
    """
    stature = height
    leg_length = (0.47 if child else 0.485) * stature
    thigh_length, shin_length, arm_length, forearm_length = (
        0.505 * leg_length,
        0.495 * leg_length,
        (0.16 if child else 0.172) * stature,
        0.15 * stature,
    )
    hip_z, half_shoulders = 0.045 * stature + leg_length, (0.105 if child else 0.112) * stature
    pelvis = np.array([0.0, 0.0, hip_z])
    trunk_lean = 0.06 * min(1.0, swing / 0.4)
    neck_z = (0.80 if child else 0.845) * stature
    neck = np.array([np.sin(trunk_lean) * (neck_z - hip_z), 0.0, neck_z])
    head = neck + np.array([0.012 * stature, 0.0, (0.10 if child else 0.083) * stature])
    limbs: list[tuple[F64, ...]] = []
    for side, leg_phase in ((1.0, phase), (-1.0, phase + np.pi)):
        thigh_angle = swing * np.sin(leg_phase) + 0.04
        knee_flex = swing / 0.45 * (0.10 + 0.95 * max(0.0, np.cos(leg_phase + 0.25)) ** 1.5)
        hip = pelvis + np.array([0.0, side * 0.052 * stature, 0.0])
        knee = hip + thigh_length * np.array([np.sin(thigh_angle), 0.0, -np.cos(thigh_angle)])
        shin_angle = thigh_angle - knee_flex
        ankle = knee + shin_length * np.array([np.sin(shin_angle), 0.0, -np.cos(shin_angle)])
        foot_angle = 0.7 * min(shin_angle, 0.0) + 0.45 * max(shin_angle, 0.0)
        toe = (
            ankle
            + np.array([np.cos(foot_angle), 0.0, np.sin(foot_angle)]) * 0.10 * stature
            + [0.0, side * 0.012 * stature, -0.028 * stature]
        )
        shoulder_point = neck + np.array([0.0, side * half_shoulders, -0.035 * stature])
        arm_angle = -0.75 * swing * np.sin(leg_phase)
        sideways = np.array([0.0, side * np.sin(spread), 0.0])
        elbow = shoulder_point + arm_length * (
            np.array([np.sin(arm_angle), 0.0, -np.cos(arm_angle)]) * np.cos(spread) + sideways
        )
        elbow_angle = arm_angle + 0.15 + 0.6 * swing + 0.4 * max(0.0, arm_angle)
        hand = elbow + forearm_length * (
            np.array([np.sin(elbow_angle), 0.0, -np.cos(elbow_angle)]) * np.cos(0.6 * spread) + 0.6 * sideways
        )
        limbs.append((hip, knee, ankle, toe, shoulder_point, elbow, hand))
    return BodyPose(pelvis, neck, head, *zip(*limbs, strict=True))


def stooped_pose(pose: BodyPose, *, angle: float, height: float) -> BodyPose:
    """Return the pose with the trunk bent forward by an angle (rad) at the hips.

    The arms still hang and the head looks ahead.
    """
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])

    def bend(point: F64) -> F64:
        return np.asarray(pose.pelvis + rotation @ (point - pose.pelvis))

    neck = bend(pose.neck)
    shoulders = bend(pose.shoulders[0]), bend(pose.shoulders[1])
    shifts = [shoulder - old_shoulder for shoulder, old_shoulder in zip(shoulders, pose.shoulders, strict=True)]
    elbows = pose.elbows[0] + shifts[0], pose.elbows[1] + shifts[1]
    hands = pose.hands[0] + shifts[0], pose.hands[1] + shifts[1]
    head = neck + np.array([0.045 * height, 0.0, 0.065 * height])
    return replace(pose, neck=neck, head=head, shoulders=shoulders, elbows=elbows, hands=hands)


def pose_with_hands(
    pose: BodyPose, *, left_hand: Point | None = None, right_hand: Point | None = None, height: float
) -> BodyPose:
    """Return the pose with one or both hands at a place (m); the arms bend to reach it."""
    elbows, hands = list(pose.elbows), list(pose.hands)
    for index, goal in enumerate((left_hand, right_hand)):
        if goal is not None:
            bend_direction = np.array([-0.5, 0.35 * (1.0 - 2.0 * index), -0.8])
            bone_lengths = 0.172 * height, 0.15 * height
            elbows[index], hands[index] = reach(
                pose.shoulders[index], np.array(goal, np.float64), *bone_lengths, bend_direction
            )
    return replace(pose, elbows=(elbows[0], elbows[1]), hands=(hands[0], hands[1]))


def seated_pose(
    height: float,
    *,
    pelvis: Point,
    lean: float,
    hands: tuple[Point, Point],
    feet: tuple[Point, Point],
    knees_out: float = 0.1,
) -> BodyPose:
    """Return the pose of a rider whose limbs bend to reach grips and soles.

    Args:
        height: Height of the person, m.
        pelvis: Position of the seat, m.
        lean: Forward lean of the trunk, rad.
        hands: Grips (left, right), m.
        feet: Soles (left, right), m.
        knees_out: Share of the direction in which the knees bend that points outwards.
    """
    stature = height
    seat = np.array(pelvis, np.float64)
    trunk_length = 0.33 * stature
    trunk_axis = np.array([np.sin(lean), 0.0, np.cos(lean)])
    neck = seat + trunk_length * trunk_axis
    head = neck + 0.088 * stature * np.array([np.sin(0.35 * lean) + 0.12, 0.0, np.cos(0.35 * lean)])
    limbs: list[tuple[F64, ...]] = []
    for side, hand, foot in ((1.0, hands[0], feet[0]), (-1.0, hands[1], feet[1])):
        hip = seat + np.array([0.0, side * 0.052 * stature, 0.0])
        ankle = np.array(foot) + np.array([-0.05 * stature, 0.0, 0.045 * stature])
        knee, ankle = reach(hip, ankle, 0.245 * stature, 0.24 * stature, np.array([1.0, side * knees_out, 0.3]))
        shoulder = neck + np.array([0.0, side * 0.108 * stature, 0.0]) - 0.035 * stature * trunk_axis
        elbow, wrist = reach(
            shoulder, np.array(hand), 0.165 * stature, 0.15 * stature, np.array([-0.4, side * 0.7, -0.7])
        )
        limbs.append(
            (hip, knee, ankle, ankle + np.array([0.10 * stature, 0.0, -0.035 * stature]), shoulder, elbow, wrist)
        )
    return BodyPose(seat, neck, head, *zip(*limbs, strict=True))


def reach(start: F64, goal: F64, first: float, second: float, bend: F64) -> tuple[F64, F64]:
    """Return the middle joint and the end of a two-bone limb that reaches for a goal, bent towards a direction."""
    line = goal - start
    # A limb that cannot reach its goal stays slightly bent.
    distance = float(np.clip(np.linalg.norm(line), 1e-6, 0.995 * (first + second)))
    direction = line / max(float(np.linalg.norm(line)), 1e-9)
    joint_distance = (first**2 - second**2 + distance**2) / (2.0 * distance)
    bend_axis = bend - (bend @ direction) * direction
    bend_axis /= max(float(np.linalg.norm(bend_axis)), 1e-9)
    joint = start + joint_distance * direction + np.sqrt(max(first**2 - joint_distance**2, 0.0)) * bend_axis
    return joint, start + distance * direction


def figure(pose: BodyPose, appearance: PersonAppearance, *, height: float, detail: int, child: bool = False) -> Mesh:
    """Return a body around the joints of a pose; the shirt is in the panels torso_front and torso_back."""
    stature = height
    segments = (4, 6, 10)[detail]
    trunk_axis = (pose.neck - pose.pelvis) / np.linalg.norm(pose.neck - pose.pelvis)
    forward = cross([0.0, 1.0, 0.0], trunk_axis)
    parts = _trunk(pose, appearance, stature, segments=2 * segments if detail else 6, child=child)
    neck_path = [
        pose.neck - 0.03 * stature * trunk_axis,
        0.25 * pose.neck + 0.75 * pose.head - 0.006 * stature * forward,
    ]
    parts.append(tube(neck_path, np.array([0.034, 0.030]) * stature, material=appearance.skin, segments=segments))
    for index in (0, 1):
        parts += _leg(pose, appearance, stature, index, detail)
        parts += _arm(pose, appearance, stature, index, detail)
    parts += _head(pose, appearance, stature, detail, 1.35 if child else 1.0)
    trunk_pose = np.eye(4)
    trunk_pose[:3, :3] = np.stack([forward, [0.0, 1.0, 0.0], trunk_axis], axis=1)
    if appearance.pack and detail > 0:
        trunk_pose[:3, 3] = pose.pelvis + 0.60 * (pose.neck - pose.pelvis) - 0.10 * stature * forward
        scaled_pack = PACK_OUTLINE * stature
        pack = prism(
            scaled_pack, (-0.072 * stature, 0.072 * stature), material=replace(appearance.trousers, name="pack"), axis=1
        )
        parts.append(pack.transformed(trunk_pose))
    if appearance.bag is not None and detail > 0:  # at the right hip
        trunk_pose[:3, 3] = pose.pelvis + np.array([0.0, -0.125 * stature, 0.0]) - 0.01 * stature * forward
        parts.append(_box((0.075 * stature, 0.022 * stature, 0.055 * stature), appearance.bag).transformed(trunk_pose))
    return merge(parts)


def _box(half: Point, material: Material) -> Mesh:
    """Return a box about the origin."""
    return crate((-half[0], -half[1], -half[2]), half, material)


def _leg(pose: BodyPose, appearance: PersonAppearance, height: float, index: int, detail: int) -> list[Mesh]:
    """Return the left (0) or right (1) leg with its shoe; it begins inside the trousers about the pelvis."""
    hip, knee, ankle, toe = pose.hips[index], pose.knees[index], pose.ankles[index], pose.toes[index]
    segments = (4, 6, 10)[detail]
    material = appearance.skin if appearance.skirt else appearance.trousers
    if detail == 0:
        sole = ankle - np.array([0.0, 0.0, 0.045 * height])
        radii = np.array([0.050, 0.036, 0.030]) * height
        return [tube([hip, knee, sole], radii, material=material, segments=4)]
    thigh = (hip - knee) / max(float(np.linalg.norm(hip - knee)), 1e-9)
    path = [hip + 0.02 * height * thigh, 0.6 * hip + 0.4 * knee, 0.06 * hip + 0.94 * knee]
    path += [0.88 * knee + 0.12 * ankle, 0.6 * knee + 0.4 * ankle, ankle]
    radii = np.array([0.044, 0.048, 0.038, 0.037, 0.034, 0.029]) * height
    if appearance.shorts:
        parts = [
            tube(path[:3], radii[:3] * [1.0, 1.10, 1.22], material=material, segments=segments),
            tube(path[2:], radii[2:] * [0.9, 0.9, 0.95, 0.80], material=appearance.skin, segments=segments),
        ]
    else:
        shares = [0.9, 0.9, 0.9, 0.88, 0.95, 0.80] if appearance.skirt else [1.0] * 6
        parts = [tube(path, radii * shares, material=material, segments=segments)]
    return [*parts, _shoe(ankle, toe, height, appearance.shoes)]


def _shoe(ankle: F64, toe: F64, height: float, material: Material) -> Mesh:
    """Return a shoe with a flat sole; its tip and its lowest point are those of a foot between the joints."""
    along = (toe - ankle) * [1.0, 1.0, 0.0]
    length = max(float(np.linalg.norm(along)), 1e-9)
    pitch = np.array([along[0], along[1], toe[2] - ankle[2] + 0.028 * height])
    pitch /= max(float(np.linalg.norm(pitch)), 1e-9)
    side = cross([0.0, 0.0, 1.0], along / length)
    up = cross(pitch, side)
    sole = ankle - 0.046 * height * up
    # place along the foot, half width and height of a section: heel, ankle, instep, ball, tip
    shape = (
        (-0.026, 0.015, 0.030),
        (0.0, 0.021, 0.046),
        (0.045, 0.024, 0.040),
        (0.085, 0.026, 0.024),
        (0.116, 0.013, 0.014),
    )
    outline = np.array([(-1.0, 0.0), (-0.9, 0.55), (0.0, 1.0), (0.9, 0.55), (1.0, 0.0)])
    sections = [
        sole + height * (place * pitch + width * outline[:, :1] * side + rise * outline[:, 1:] * up)
        for place, width, rise in shape
    ]
    return loft(np.array(sections), material=material, smooth=0.9)


def _arm(pose: BodyPose, appearance: PersonAppearance, height: float, index: int, detail: int) -> list[Mesh]:
    """Return the left (0) or right (1) arm with its hand; the sleeve begins inside the shirt."""
    shoulder, elbow, hand = pose.shoulders[index], pose.elbows[index], pose.hands[index]
    segments = (4, 6, 10)[detail]
    if detail == 0:
        radii = np.array([0.034, 0.027, 0.02]) * height
        return [tube([shoulder, elbow, hand], radii, material=appearance.shirt, segments=4)]
    trunk_axis = (pose.neck - pose.pelvis) / np.linalg.norm(pose.neck - pose.pelvis)
    inward = np.array([0.0, -np.sign(shoulder[1] - pose.neck[1]), 0.0])
    path = [
        shoulder + height * (0.050 * inward - 0.006 * trunk_axis),
        shoulder + height * (0.018 * inward - 0.008 * trunk_axis),
        0.76 * shoulder + 0.24 * elbow,
        0.5 * (shoulder + elbow),
        elbow,
        0.88 * hand + 0.12 * elbow,
    ]
    radii = np.array([0.024, 0.030, 0.033, 0.030, 0.026, 0.021]) * height
    # Circles that tilt with the path, from across the shoulder to along the arm, round the sleeve off.
    sleeve = tube(path, radii, material=appearance.shirt, segments=segments)
    down = (hand - elbow) / max(float(np.linalg.norm(hand - elbow)), 1e-9)
    across = cross(down, inward)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([across, cross(down, across), down], axis=1)
    frame[:3, 3] = hand + 0.012 * height * down
    palm = sphere((0.021 * height, 0.013 * height, 0.042 * height), material=appearance.skin, segments=segments)
    return [sleeve, palm.transformed(frame)]


# rows of the clothes: place as a share of the way from the hips to the neck, half depth and half width as shares of
# the stature
SHIRT = (
    (-0.05, 0.072, 0.108),
    (0.16, 0.066, 0.096),
    (0.32, 0.061, 0.087),
    (0.62, 0.070, 0.103),
    (0.80, 0.067, 0.112),
    (0.92, 0.056, 0.100),
    (1.00, 0.040, 0.056),
    (1.10, 0.036, 0.038),
)
TROUSERS = ((-0.26, 0.036, 0.052), (-0.12, 0.066, 0.095), (0.08, 0.064, 0.093))
BAND_ROWS = (0.06, 0.42)  # of reflecting bands, which are as wide as `BAND_WIDTH`
BAND_WIDTH = 0.10


def _trunk(pose: BodyPose, appearance: PersonAppearance, height: float, *, segments: int, child: bool) -> list[Mesh]:
    """Return the trousers or skirt about the hips, and over them the shirt or coat."""
    trunk_axis = (pose.neck - pose.pelvis) / np.linalg.norm(pose.neck - pose.pelvis)
    forward = cross([0.0, 1.0, 0.0], trunk_axis)
    length = float(np.linalg.norm(pose.neck - pose.pelvis))
    shirt_rows, trouser_rows = list(SHIRT), list(TROUSERS)
    stride_share = max(abs(float(knee[0] - pose.pelvis[0])) for knee in pose.knees) / height
    hem = [(-0.62, 0.066 + 0.9 * stride_share, 0.120), (-0.30, 0.070 + 0.45 * stride_share, 0.112)]  # round both thighs
    if appearance.coat:
        shirt_rows[:1] = [*hem, (0.0, 0.078 + 0.2 * stride_share, 0.108)]
    if appearance.skirt:
        trouser_rows[:2] = [*hem, (-0.05, 0.069, 0.100)]
    if appearance.bands is not None:
        places, *profile = np.array(shirt_rows).T
        edges = [edge for row in BAND_ROWS for edge in (row, row + BAND_WIDTH)]
        half_depths, half_widths = profile
        band_rows = [
            (edge, float(np.interp(edge, places, half_depths)), float(np.interp(edge, places, half_widths)))
            for edge in edges
        ]
        shirt_rows = sorted({round(row[0], 6): row for row in (*shirt_rows, *band_rows)}.values())
    depth_share = 1.12 if child else 1.0
    angles = np.arange(segments) * (2.0 * np.pi / segments)
    left_axis = np.array([0.0, 1.0, 0.0])

    def wrap(rows: list[tuple[float, float, float]], material: Material) -> Mesh:
        sections = [
            pose.pelvis
            + station * length * (trunk_axis if station > 0 else np.array([0.0, 0.0, 1.0]))
            + height
            * (
                depth_share * half_depth * np.cos(angles)[:, None] * forward
                + half_width * np.sin(angles)[:, None] * left_axis
            )
            for station, half_depth, half_width in rows
        ]
        return loft(np.array(sections), material=material, smooth=1.0)

    shirt = wrap(shirt_rows, appearance.shirt)
    face_centres = shirt.corners().mean(axis=1) - pose.pelvis
    face_rows = np.arange(len(shirt.faces)) // (2 * segments)  # caps come last
    is_side = face_rows < len(shirt_rows) - 1
    material = np.zeros(len(shirt.faces), np.int32)
    materials = [appearance.shirt]
    if appearance.bands is not None:
        lower_edges = np.array([row[0] for row in shirt_rows])
        band_faces = [
            np.isin(face_rows, np.flatnonzero((lower_edges > row - 1e-6) & (lower_edges < row + BAND_WIDTH - 1e-6)))
            for row in BAND_ROWS
        ]
        material[is_side & np.any(band_faces, axis=0)] = len(materials)
        materials.append(appearance.bands)
    if (
        appearance.inner is not None and segments > 6
    ):  # a strip down the middle of the chest, 30 degrees to either side at most
        face_columns = np.arange(len(shirt.faces)) // 2 % segments
        is_middle = np.minimum(face_columns, segments - 1 - face_columns) == 0
        material[is_side & is_middle] = len(materials)
        materials.append(appearance.inner)
    panel = np.where(is_side, np.where(face_centres @ forward >= 0.0, 0, 1), -1).astype(np.int32)
    shirt = replace(
        shirt, material=material, materials=tuple(materials), panel=panel, panels=("torso_front", "torso_back")
    )
    return [shirt, wrap(trouser_rows, appearance.trousers)]


# rows of a head: height above its middle, front, back and half width, as shares of the stature
HEAD = (
    (-0.064, 0.036, 0.004, 0.014),
    (-0.054, 0.045, -0.012, 0.026),
    (-0.034, 0.047, -0.036, 0.036),
    (-0.010, 0.046, -0.047, 0.041),
    (0.008, 0.044, -0.052, 0.042),
    (0.026, 0.049, -0.055, 0.043),
    (0.044, 0.045, -0.053, 0.040),
    (0.057, 0.032, -0.043, 0.031),
    (0.065, 0.012, -0.022, 0.013),
)
HEAD_ROWS = ((0, 2, 4, 6, 8), (0, 1, 2, 3, 4, 5, 6, 7, 8), (0, 1, 2, 3, 4, 5, 6, 7, 8))
WHITES = Material("sclera", (0.45, 0.43, 0.41), specular=0.04, gloss=0.5)


def _skull(appearance: PersonAppearance, detail: int) -> Mesh:
    """Return a head about the origin for a stature of 1 m: skin, beard, and hair or a cap, which stand out."""
    columns = (6, 8, 14)[detail]
    rows = np.array([HEAD[index] for index in HEAD_ROWS[detail]])
    # Half a step off: a column looks straight ahead.
    angles = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    cosine, sine = np.cos(angles), np.sin(angles)
    middle = -0.004
    half_depth = np.where(cosine > 0.0, rows[:, 1:2] - middle, middle - rows[:, 2:3])
    sections = np.stack(
        [middle + half_depth * cosine, rows[:, 3:4] * sine, np.broadcast_to(rows[:, :1], half_depth.shape)], axis=-1
    )
    # lower edge of the hair ahead, at the sides and behind; of a cap all round
    face_angles = np.abs(np.angle(np.exp(1j * (np.arange(columns) + 1.0) * (2.0 * np.pi / columns))))
    back_edge = -0.066 if appearance.long_hair else -0.060 if appearance.helmet else -0.045
    edges = np.interp(face_angles, [0.0, 0.7, 1.0, 1.7, 2.2], [0.040, 0.040, 0.006, -0.004, back_edge])
    covering = appearance.hair
    if appearance.helmet is not None:
        edges = np.maximum(edges, np.where(face_angles < 1.2, 1.0, edges))
    heights = 0.5 * (rows[:-1, 0] + rows[1:, 0])
    is_hair = heights[:, None] > edges
    is_cap = np.zeros_like(is_hair)
    if appearance.cap is not None and appearance.helmet is None:
        is_cap = np.broadcast_to(heights[:, None] > 0.030, is_hair.shape)
    is_beard = np.zeros_like(is_hair)
    if appearance.beard and detail > 0:
        is_beard = (heights[:, None] < -0.030) & (face_angles < 1.6)
    # A vertex stands out where all cells about it are covered.
    covered = is_hair | is_cap
    padded = np.concatenate([covered[:1], covered, covered[-1:]])
    stands_out = padded[:-1] & padded[1:] & np.roll(padded[:-1], 1, axis=1) & np.roll(padded[1:], 1, axis=1)
    centre = np.array([middle, 0.0, 0.0])
    sections = np.where(stands_out[..., None], centre + (sections - centre) * [1.07, 1.08, 1.09], sections)
    skull = loft(sections, material=appearance.skin, smooth=1.4)
    cell_material = np.where(is_cap, 2, np.where(is_hair | is_beard, 1, 0))
    materials = (appearance.skin, covering, appearance.cap or covering)
    crown = cell_material[-1].max()
    material = np.concatenate([np.repeat(cell_material.ravel(), 2), [0] * (columns - 2), [crown] * (columns - 2)])
    return replace(skull, material=material.astype(np.int32), materials=materials)


def _facial_features(appearance: PersonAppearance, detail: int) -> Mesh:
    """Return eyes under their brows, nose and mouth, for a head about the origin and a stature of 1 m."""
    points: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    material: list[int] = []
    # The face is as flat as a column of the head is wide.
    front = 0.0435 if detail == 1 else 0.0455

    def plate(
        middle: tuple[float, float], half: tuple[float, float], ahead: float, colour: int, slope: float = 0.0
    ) -> None:
        """Add a rectangle across the face, swept back at its outer end."""
        (y, z), (half_width, half_height) = middle, half
        outer = np.sign(y) * half_width
        first = len(points)
        for across, up in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            place = y + across * half_width
            depth = front + ahead - 6.0 * place * place
            points.append((depth, place, z + up * half_height + (slope if across * outer > 0 else 0.0)))
        faces.extend([(first, first + 1, first + 2), (first, first + 2, first + 3)])
        material.extend([colour, colour])

    for side in (1.0, -1.0):
        if detail == 2:
            plate((side * 0.0175, 0.0085), (0.0078, 0.0034), 0.0015, 2)
            plate((side * 0.0170, 0.0085), (0.0032, 0.0034), 0.0025, 0)
        else:
            plate((side * 0.0175, 0.0085), (0.0070, 0.0034), 0.0025, 0)
        plate((side * 0.0180, 0.0180), (0.0092, 0.0018), 0.0035, 3, -0.001)
    plate((0.0, -0.0330), (0.0125, 0.0026), 0.0040, 1)
    first = len(points)
    points += [
        (front, 0.0, 0.010),
        (front + 0.0145, 0.0, -0.013),
        (front - 0.001, 0.009, -0.018),
        (front - 0.001, -0.009, -0.018),
    ]
    faces += [(first, first + 1, first + 3), (first, first + 2, first + 1), (first + 1, first + 2, first + 3)]
    material += [4, 4, 4]
    lips = replace(LIPS, colour=_mixed(LIPS.colour, appearance.skin.colour, 0.4))
    brows = replace(appearance.hair, name="brows", colour=_mixed(appearance.hair.colour, (0.0, 0.0, 0.0), 0.3))
    materials = (EYES, lips, WHITES, brows, appearance.skin)
    return build(points, faces, materials=materials, material=material, smooth=0.9)


def _mixed(
    first: tuple[float, float, float], second: tuple[float, float, float], share: float
) -> tuple[float, float, float]:
    """Return a colour between two: the share of the second."""
    return as_point((1.0 - share) * np.array(first) + share * np.array(second))


def _head(pose: BodyPose, appearance: PersonAppearance, height: float, detail: int, size_share: float) -> list[Mesh]:
    scale = size_share * height

    def ellipsoid(half_axes: Point, material: Material, ahead: float = 0.0, up: float = 0.0, segments: int = 6) -> Mesh:
        """Return an ellipsoid in units of the head's size, at a place in the frame of the head."""
        return sphere(half_axes, material=material, centre=(ahead, 0.0, up), segments=segments)

    segments = (6, 8, 14)[detail]
    parts = [_skull(appearance, detail)]
    if detail > 0 and not appearance.visor:
        parts.append(_facial_features(appearance, detail))
    if appearance.helmet is not None and appearance.visor:
        parts.append(ellipsoid((0.068, 0.060, 0.066), appearance.helmet, -0.006, 0.012, segments))
        if detail > 0:
            parts.append(ellipsoid((0.030, 0.050, 0.020), VISOR, 0.038, 0.012, 8))
    elif appearance.helmet is not None:  # the rim lies above the eyes
        parts.append(ellipsoid((0.067, 0.056, 0.046), appearance.helmet, -0.008, 0.038, segments))
        if appearance.cap is not None and detail > 0:  # the peak of a safety helmet
            parts.append(ellipsoid((0.036, 0.044, 0.006), appearance.cap, 0.052, 0.030))
    else:
        if appearance.long_hair and detail > 0:
            parts.append(ellipsoid((0.024, 0.042, 0.060), appearance.hair, -0.040, -0.045, 8))
        if appearance.cap is not None and detail > 0:  # the peak points ahead
            parts.append(ellipsoid((0.040, 0.036, 0.005), appearance.cap, 0.058, 0.031))
    frame = np.diag([scale, scale, scale, 1.0])
    frame[:3, 3] = pose.head
    return [part.transformed(frame) for part in parts]


def _sole(pose: BodyPose, height: float) -> float:
    """Height of the lowest sole of a pose, m."""
    return float(min(joint[2] for joint in (*pose.toes, *pose.ankles))) - 0.018 * height


def _stick(pose: BodyPose, height: float) -> F64:
    """Top and tip [2, 3] of a walking stick in the right hand, m."""
    x, y, z = as_point(pose.hands[1])
    return np.array([(x, y, z + 0.012 * height), (x + 0.03 * height, y, _sole(pose, height) + 0.012 * height)])


def _extent(pose: BodyPose, height: float) -> F64:
    """Corners [2, 3] of a box about a pose whose lowest sole is at 0, m: joints and the flesh around them."""
    joints = np.array([*pose.toes, *pose.ankles, *pose.knees, *pose.elbows, *pose.hands, *pose.shoulders, pose.head])
    flesh = height * np.array(
        [0.004] * 2 + [0.026] * 2 + [0.036] * 2 + [0.025] * 2 + [0.016] * 2 + [0.031] * 2 + [0.064]
    )
    # Heights are relative to the lowest sole, which stands on the ground.
    floor = _sole(pose, height)
    lower = np.minimum(
        (joints - flesh[:, None]).min(axis=0), np.array(pose.ankles).min(axis=0) - np.array([0.028 * height, 0.0, 0.0])
    )
    upper = (joints + flesh[:, None]).max(axis=0)
    return np.array([[lower[0], lower[1], 0.0], [upper[0], upper[1], upper[2] - floor + 0.008 * height]])


def _pose(style: str, height: float, phase: float, swing: float, spread: float) -> BodyPose:
    """Return one moment of the walking cycle of a style (see `walking_pose`)."""
    is_child = style in CHILDREN
    walker = walking_pose(height, phase=phase, swing=swing, spread=spread, child=is_child)
    if style in TARGETS:  # only the legs of a test target move
        still = walking_pose(height, phase=0.0, swing=0.0, spread=spread, child=is_child)
        return replace(walker, elbows=still.elbows, hands=still.hands)
    if style == "elderly":
        walker = stooped_pose(walker, angle=0.32, height=height)
        shoulder = walker.shoulders[1]
        stick_grip = shoulder[0] + (0.10 + 0.05 * np.sin(phase)) * height, shoulder[1] - 0.02 * height, 0.47 * height
        return pose_with_hands(walker, right_hand=as_point(stick_grip), height=height)
    if style == "stroller":
        left_hand, right_hand = ((0.235 * height, side * 0.115 * height, 0.58 * height) for side in (1.0, -1.0))
        return pose_with_hands(walker, left_hand=left_hand, right_hand=right_hand, height=height)
    return walker


@lru_cache(maxsize=64)
def _cycle_extent(style: str, height: float, swing: float, spread: float) -> tuple[F64, F64]:
    """Return the lowest and highest corner [3] of the boxes of a walking cycle, m."""
    phases = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    boxes = np.array([_extent(_pose(style, height, float(phase), swing, spread), height) for phase in phases])
    return boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)


def _dress_for_style(appearance: PersonAppearance, style: str, share: float) -> PersonAppearance:
    """The clothes that belong to a style; `share` in [0, 1) is drawn for the person."""
    if style == "elderly":
        shade = 0.30 + 0.35 * share
        grey_hair = replace(appearance.hair, colour=(shade, shade, 0.97 * shade))
        return replace(
            appearance, hair=grey_hair, pack=False, shorts=False, long_hair=appearance.long_hair and share < 0.4
        )
    if style == "worker":
        vest_material = replace(appearance.shirt, colour=HIVIS if share < 0.6 else ORANGE)
        safety_helmet = Material(
            "helmet", ((0.75, 0.75, 0.72), (0.80, 0.52, 0.02), ORANGE)[int(3.0 * share)], gloss=0.6
        )
        work_trousers = replace(appearance.trousers, colour=(0.03, 0.04, 0.08) if share < 0.7 else ORANGE)
        return replace(
            appearance,
            shirt=vest_material,
            trousers=work_trousers,
            helmet=safety_helmet,
            cap=safety_helmet,
            bands=BANDS,
            coat=False,
            skirt=False,
            pack=False,
            shorts=False,
            bag=None,
        )
    if style == "stroller":
        return replace(appearance, bag=None)
    if style in TARGETS:
        return TARGET_APPEARANCE
    return appearance


def torso_charts(low: Point, high: Point) -> list[Chart]:
    """Return the charts of the panels of a person's shirt."""
    return [Chart("torso_front", "front", low, high), Chart("torso_back", "rear", low, high)]


def pedestrian(
    style: str, size: Point, *, generator: np.random.Generator, detail: int, phase: float | None = None
) -> Mesh:
    """Return a person whose walking cycle fills the size (m), as box labels enclose the whole cycle.

    `phase` in rad is the place in the cycle (period 2 pi); None draws it. A standing person fills the box in
    every frame.
    """
    length, width, height = size
    appearance = draw_appearance(generator)
    random_phase, variation = float(generator.uniform(0.0, 2.0 * np.pi)), float(generator.random())
    appearance = _dress_for_style(appearance, style, variation)
    is_child, is_still = style in CHILDREN, style == "standing" or (style == "worker" and length < 0.32 * height)
    swing = float(np.arcsin(np.clip((length - 0.16 * height) / height, 0.06, 0.16 if is_still else 0.6)))
    spread = float(np.arcsin(np.clip((0.5 * width - 0.145 * height) / (0.27 * height), 0.03, 0.5)))

    cycle_phase = 0.5 * np.pi if is_still else random_phase if phase is None else phase
    pose = _pose(style, height, cycle_phase, swing, spread)
    body = figure(pose, appearance, height=height, detail=detail, child=is_child)
    if style == "elderly":
        body = merge([body, tube(_stick(pose, height), 0.009 * height, material=STICK, segments=(3, 4, 6)[detail])])
    # The feet leave the ground at some phases of the cycle model: put the lowest point back on it.
    body = body.moved(z=-float(body.bounds()[0][2]))
    lower, upper = body.bounds()
    if not is_still:
        cycle_low, cycle_high = _cycle_extent(style, height, swing, spread)
        lower, upper = np.minimum(lower, cycle_low), np.maximum(upper, cycle_high)
    scale = np.asarray(size) / (upper - lower)
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = -scale * [0.5 * (lower[0] + upper[0]), 0.5 * (lower[1] + upper[1]), 0.0]
    chest = (-0.3 * length, -0.35 * width, 0.35 * height), (0.3 * length, 0.35 * width, 0.9 * height)
    return unwrap(body.transformed(matrix), torso_charts(*chest))
