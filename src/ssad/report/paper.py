"""Tables of the paper, shown beside ours.

Source: Li et al., "Towards Benchmarking and Assessing the Safety and Robustness of Autonomous Driving on
Safety-critical Scenarios". They were measured in CARLA 0.9.13 with SafeBench's agents; ours come from another
simulator. A test compares them with the source of the paper.
"""

from __future__ import annotations

SOURCE = "published by the paper: CARLA 0.9.13, SafeBench's agents"

SCENARIOS: dict[str, str] = {
    "StraightObstacle": "Straight Obstacle",
    "TurningObstacle": "Turning Obstacle",
    "LaneChanging": "Lane Changing",
    "VehiclePassing": "Vehicle Passing",
    "RedlightRunning": "Red-light Running",
    "UnprotectedLeftTurn": "Unprotected Left-turn",
    "RightTurn": "Right-turn",
    # the table's head says "Dynamic Object Crossing", the text "Crossing Negotiation"
    "CrossingNegotiation": "Crossing Negotiation",
}

# metric -> system -> eight scenarios in the order of SCENARIOS, then the average
PRECRASH: dict[str, dict[str, tuple[float, ...]]] = {
    "CR": {
        "PPO": (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.25),
        "SAC": (1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.63),
        "TD3": (1.0, 0.25, 0.75, 0.0, 1.0, 1.0, 1.0, 1.0, 0.75),
    },
    "OR": {
        "PPO": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.00),
        "SAC": (0.44, 0.71, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.14),
        "TD3": (0.0, 0.0, 0.34, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04),
    },
    "DR": {
        "PPO": (0.43, 0.59, 0.71, 0.44, 0.43, 0.45, 0.51, 0.44, 0.50),
        "SAC": (0.0, 0.77, 1.12, 1.23, 0.41, 0.45, 0.70, 0.44, 0.64),
        "TD3": (0.35, 0.72, 0.44, 1.04, 0.68, 0.33, 0.40, 0.35, 0.54),
    },
    "RC": {
        "PPO": (1.0, 1.0, 0.66, 0.60, 1.0, 1.0, 1.0, 1.0, 0.91),
        "SAC": (0.74, 0.77, 1.0, 1.0, 0.53, 0.46, 1.0, 0.62, 0.77),
        "TD3": (0.74, 0.95, 0.75, 1.0, 0.53, 0.47, 0.50, 0.62, 0.70),
    },
}

# (system under test, surrounding vehicles) -> town -> CR, OR, DR
NATURAL: dict[tuple[str, str], dict[str, tuple[float, float, float]]] = {
    ("Autopilot", "Autopilot"): {"Town02": (0.01, 0.00, 0.03), "Town05": (0.00, 0.00, 0.07)},
    ("PPO", "Autopilot"): {"Town02": (0.34, 0.04, 0.19), "Town05": (0.11, 0.01, 0.16)},
    ("Autopilot", "Adv. PPO"): {"Town02": (0.17, 0.00, 0.07), "Town05": (0.21, 0.00, 0.06)},
    ("PPO", "Adv. PPO"): {"Town02": (0.81, 0.05, 0.22), "Town05": (0.59, 0.03, 0.12)},
}

# shift -> detector -> mAP, NDS in percent; nuScenes val, severities drawn from 1 to 5 ("" : clean)
SHIFTS: dict[str, dict[str, tuple[float, float]]] = {
    "": {"FCOS3D": (29.8, 37.7), "PGD": (31.7, 39.3)},
    "snow": {"FCOS3D": (2.07, 5.87), "PGD": (3.45, 13.21)},
    "rain": {"FCOS3D": (16.98, 29.08), "PGD": (18.24, 29.60)},
    "fog": {"FCOS3D": (17.97, 29.50), "PGD": (17.48, 28.21)},
    "sunlight": {"FCOS3D": (27.31, 36.92), "PGD": (30.68, 38.59)},
    "uniform": {"FCOS3D": (5.53, 11.69), "PGD": (2.60, 10.75)},
    "gaussian": {"FCOS3D": (3.62, 6.47), "PGD": (4.57, 7.30)},
    "impulse": {"FCOS3D": (6.35, 10.97), "PGD": (5.86, 15.48)},
    "scale": {"FCOS3D": (6.57, 19.53), "PGD": (6.82, 21.55)},
    "shear": {"FCOS3D": (21.57, 31.63), "PGD": (23.63, 33.24)},
    "rotation": {"FCOS3D": (13.25, 22.52), "PGD": (12.46, 20.46)},
    "motion_blur": {"FCOS3D": (9.34, 20.30), "PGD": (8.19, 18.95)},
}
DETECTORS = {"fcos3d": "FCOS3D", "pgd-det": "PGD"}  # how a detector's name begins -> its column in the paper

# digital attack -> detector -> mAP, NDS in percent; nuScenes val, L-infinity ("": clean)
DIGITAL: dict[str, dict[str, tuple[float, float]]] = {
    "": {"FCOS3D": (29.8, 37.7), "PGD": (31.74, 39.34)},
    "PGD": {"FCOS3D": (3.90, 18.73), "PGD": (19.61, 31.42)},
    "FGSM": {"FCOS3D": (8.30, 21.44), "PGD": (8.77, 17.99)},
    "C&W": {"FCOS3D": (2.59, 7.18), "PGD": (2.71, 8.28)},
}
DIGITAL_STEPS = {"FGSM": 1, "PGD": 10, "C&W": 10}

# town -> row of the table -> detector -> AP (0.5), ASR in percent (None where the paper has a dash); class car, a
# camera 20 m behind. Trained on Town06 and Town05.
PHYSICAL: dict[str, dict[str, dict[str, tuple[float, float | None]]]] = {
    "Town04": {
        "Benign": {"YoloV5": (99.8, None), "YoloV3": (99.5, None)},
        "Random patch": {"YoloV5": (24.3, 75.4), "YoloV3": (45.4, 66.8)},
        "Adv. Patch": {"YoloV5": (16.5, 86.5), "YoloV3": (36.0, 83.3)},
        "Random camouflage": {"YoloV5": (98.2, None), "YoloV3": (99.3, None)},
        "DAS": {"YoloV5": (56.2, 80.3), "YoloV3": (65.8, 74.2)},
        "TPA": {"YoloV5": (62.5, 75.1), "YoloV3": (63.9, 76.3)},
    },
    "Town03": {
        "Benign": {"YoloV5": (99.1, None), "YoloV3": (99.3, None)},
        "Random patch": {"YoloV5": (58.2, 64.2), "YoloV3": (95.9, 65.8)},
        "Adv. Patch": {"YoloV5": (37.2, 74.7), "YoloV3": (73.6, 76.1)},
        "Random camouflage": {"YoloV5": (95.6, 8.7), "YoloV3": (99.5, None)},
        "DAS": {"YoloV5": (49.5, 91.5), "YoloV3": (54.9, 88.3)},
        "TPA": {"YoloV5": (50.6, 87.8), "YoloV3": (56.9, 86.7)},
    },
}
