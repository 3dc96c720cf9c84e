"""People: adults, children and the elderly.

They walk, push a stroller, stand, work on the road, or sit on a two-wheeler.
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
    parts = [_trunk(pose, appearance, stature, segments=2 * segments if detail else 6, child=child)]
    leg_material = appearance.skin if appearance.skirt else appearance.trousers
    for index in (0, 1):
        hip, knee, ankle, toe = pose.hips[index], pose.knees[index], pose.ankles[index], pose.toes[index]
        shoulder, elbow, hand = pose.shoulders[index], pose.elbows[index], pose.hands[index]
        if detail == 0:
            sole = ankle - np.array([0.0, 0.0, 0.045 * stature])
            parts.append(
                tube([hip, knee, sole], np.array([0.052, 0.034, 0.030]) * stature, material=leg_material, segments=4)
            )
            arm_radii = np.array([0.03, 0.025, 0.02]) * stature
            parts.append(tube([shoulder, elbow, hand], arm_radii, material=appearance.shirt, segments=4))
            continue
        leg_path = [hip + 0.03 * stature * trunk_axis, 0.6 * hip + 0.4 * knee, 0.1 * hip + 0.9 * knee]
        leg_path += [0.9 * knee + 0.1 * ankle, 0.6 * knee + 0.4 * ankle, ankle]
        leg_radii = np.array([0.050, 0.048, 0.038, 0.036, 0.034, 0.024]) * stature
        if appearance.shorts:
            parts.append(tube(leg_path[:3], leg_radii[:3] * 1.12, material=leg_material, segments=segments))
            parts.append(tube(leg_path[2:], leg_radii[2:] * 0.9, material=appearance.skin, segments=segments))
        else:
            parts.append(tube(leg_path, leg_radii, material=leg_material, segments=segments))
        heel = ankle - 0.28 * (toe - ankle) * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.018 * stature]
        shoe_path = [heel, 0.5 * (ankle + toe), toe]
        parts.append(
            tube(shoe_path, np.array([0.022, 0.030, 0.018]) * stature, material=appearance.shoes, segments=segments)
        )
        wrist = 0.88 * hand + 0.12 * elbow
        inward = np.array([0.0, -np.sign(shoulder[1] - pose.neck[1]), 0.0])
        sleeve_path = [
            shoulder + (0.030 * trunk_axis + 0.030 * inward) * stature,
            shoulder + 0.006 * stature * trunk_axis,
        ]
        sleeve_path += [0.5 * (shoulder + elbow), elbow, wrist]
        parts.append(
            tube(
                sleeve_path,
                np.array([0.014, 0.031, 0.030, 0.025, 0.019]) * stature,
                material=appearance.shirt,
                segments=segments,
            )
        )
        hand_radii = (0.020 * stature, 0.014 * stature, 0.030 * stature)
        parts.append(sphere(hand_radii, material=appearance.skin, centre=as_point(hand), segments=segments))
    parts += _head(pose, appearance, stature, detail, 1.35 if child else 1.0)
    trunk_pose = np.eye(4)
    trunk_pose[:3, :3] = np.stack([forward, [0.0, 1.0, 0.0], trunk_axis], axis=1)
    if appearance.pack and detail > 0:
        trunk_pose[:3, 3] = pose.pelvis + 0.62 * (pose.neck - pose.pelvis) - 0.10 * stature * forward
        parts.append(
            _box(
                (0.045 * stature, 0.075 * stature, 0.11 * stature), replace(appearance.trousers, name="pack")
            ).transformed(trunk_pose)
        )
    if appearance.bag is not None and detail > 0:  # at the right hip
        trunk_pose[:3, 3] = pose.pelvis + np.array([0.0, -0.125 * stature, 0.0]) - 0.01 * stature * forward
        parts.append(_box((0.075 * stature, 0.022 * stature, 0.055 * stature), appearance.bag).transformed(trunk_pose))
    return merge(parts)


def _box(half: Point, material: Material) -> Mesh:
    """Return a box about the origin."""
    return crate((-half[0], -half[1], -half[2]), half, material)


def _trunk(pose: BodyPose, appearance: PersonAppearance, height: float, *, segments: int, child: bool) -> Mesh:
    trunk_axis = (pose.neck - pose.pelvis) / np.linalg.norm(pose.neck - pose.pelvis)
    forward = cross([0.0, 1.0, 0.0], trunk_axis)
    length = float(np.linalg.norm(pose.neck - pose.pelvis))
    is_long = appearance.coat or appearance.skirt
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
    if is_long:  # the hem goes round both thighs
        stride_share = max(abs(float(knee[0] - pose.pelvis[0])) for knee in pose.knees) / height
        rows = [(-0.60, 0.062 + 0.9 * stride_share, 0.118), (0.0, 0.076 + 0.3 * stride_share, 0.118), *rows[2:]]
    if appearance.bands is not None:  # the upper band has rows of its own
        band_row = next(row_index for row_index, entry in enumerate(rows) if entry[0] > 0.52)
        rows[band_row:band_row] = [(0.42, 0.064, 0.091), (0.52, 0.067, 0.097)]
    if child:
        rows = [(station, 1.12 * half_depth, half_width) for station, half_depth, half_width in rows]
    angles = np.arange(segments) * (2.0 * np.pi / segments)
    left_axis = np.array([0.0, 1.0, 0.0])
    sections = [
        pose.pelvis
        + station * length * (trunk_axis if station > 0 else np.array([0.0, 0.0, 1.0]))
        + height * (half_depth * np.cos(angles)[:, None] * forward + half_width * np.sin(angles)[:, None] * left_axis)
        for station, half_depth, half_width in rows
    ]
    body = loft(np.array(sections), material=appearance.shirt, smooth=1.0)
    face_centres = body.corners().mean(axis=1) - pose.pelvis
    face_rows = np.minimum(np.arange(len(body.faces)) // (2 * segments), len(rows))  # caps come last
    first_shirt_row = 0 if appearance.coat else 2 - int(is_long)
    is_front = face_centres @ forward >= 0.0
    is_neck = face_rows >= len(rows) - 2
    is_shirt = (face_rows >= first_shirt_row) & (face_rows < len(rows) - 1)
    material = np.where(is_neck, 2, np.where(is_shirt, 0, 1))
    materials = [appearance.shirt, appearance.trousers, appearance.skin]
    is_jacket = is_shirt & ~is_neck
    if appearance.bands is not None:
        band_rows = [row_index for row_index, entry in enumerate(rows) if entry[0] in (0.06, 0.42)]
        material[is_jacket & np.isin(face_rows, band_rows)] = len(materials)
        materials.append(appearance.bands)
    if (
        appearance.inner is not None and segments > 6
    ):  # a strip down the middle of the chest, 30 degrees to either side at most
        face_columns = np.arange(len(body.faces)) // 2 % segments
        is_middle = np.minimum(face_columns, segments - 1 - face_columns) == 0
        material[is_jacket & is_middle & (face_rows < len(rows))] = len(materials)
        materials.append(appearance.inner)
    panel = np.where(is_shirt & ~is_neck, np.where(is_front, 0, 1), -1).astype(np.int32)
    return replace(
        body,
        material=material.astype(np.int32),
        materials=tuple(materials),
        panel=panel,
        panels=("torso_front", "torso_back"),
    )


def _head(pose: BodyPose, appearance: PersonAppearance, height: float, detail: int, size_share: float) -> list[Mesh]:
    x, y, z = (float(value) for value in pose.head)
    default_segments = (6, 8, 14)[detail]
    scale = size_share * height

    def ellipsoid(
        half_axes: Point, material: Material, ahead: float = 0.0, up: float = 0.0, segments: int = default_segments
    ) -> Mesh:
        """Return an ellipsoid in units of the head's size, at a place in the frame of the head."""
        half_depth, half_width, half_height = half_axes
        centre = (x + ahead * scale, y, z + up * scale)
        return sphere(
            (half_depth * scale, half_width * scale, half_height * scale),
            material=material,
            centre=centre,
            segments=segments,
        )

    parts = [ellipsoid((0.050, 0.042, 0.064), appearance.skin)]
    if appearance.helmet is not None and appearance.visor:
        parts.append(ellipsoid((0.068, 0.060, 0.066), appearance.helmet, -0.006, 0.012))
        if detail > 0:
            parts.append(ellipsoid((0.030, 0.050, 0.020), VISOR, 0.038, 0.012, segments=8))
    elif appearance.helmet is not None:  # the rim lies above the eyes
        parts.append(ellipsoid((0.050, 0.048, 0.050), appearance.hair, -0.018, 0.004))
        parts.append(ellipsoid((0.066, 0.058, 0.044), appearance.helmet, -0.006, 0.044))
        if appearance.cap is not None and detail > 0:  # the peak of a safety helmet
            parts.append(ellipsoid((0.036, 0.044, 0.008), appearance.cap, 0.054, 0.032, segments=6))
    else:
        parts.append(ellipsoid((0.050, 0.048, 0.056), appearance.hair, -0.016, 0.016))
        if appearance.long_hair and detail > 0:
            parts.append(ellipsoid((0.030, 0.042, 0.070), appearance.hair, -0.030, -0.035))
        if appearance.cap is not None:  # the peak points ahead
            parts.append(ellipsoid((0.056, 0.051, 0.042), appearance.cap, -0.006, 0.034))
            if detail > 0:
                parts.append(ellipsoid((0.040, 0.040, 0.008), appearance.cap, 0.058, 0.026, segments=6))
    if detail > 0:  # the face: eyes under their brows, nose, mouth or beard
        parts.append(ellipsoid((0.016, 0.030, 0.008), EYES, 0.038, 0.008, segments=6))
        parts.append(ellipsoid((0.014, 0.009, 0.014), appearance.skin, 0.049, -0.009, segments=6))
        if appearance.beard:
            parts.append(ellipsoid((0.026, 0.034, 0.026), appearance.hair, 0.022, -0.042, segments=6))
        elif detail == 2:
            parts.append(ellipsoid((0.012, 0.016, 0.005), LIPS, 0.036, -0.031, segments=6))
    if detail == 2:
        neck = [pose.neck - np.array([0.0, 0.0, 0.02 * height]), pose.head - [0.01 * height, 0.0, 0.02 * height]]
        parts.append(tube(neck, 0.030 * height, material=appearance.skin, segments=8))
    return parts


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
    walker = walking_pose(height, phase=phase, swing=swing, spread=spread, child=style == "child")
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
    is_child, is_still = style == "child", style == "standing" or (style == "worker" and length < 0.32 * height)
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
