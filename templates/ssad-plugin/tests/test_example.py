"""Each part under its name, held to its protocol: `python -m pytest tests` where the package is installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1]


def test_the_driver_keeps_its_promises_and_stops_for_walkers() -> None:
    from ssad import World, build_episode, load_scenarios, load_town, make_system, rollout
    from ssad.world.check import check_driver

    (scenario,) = load_scenarios(FOLDER / "walkers.yaml")
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    assert [agent.model for agent in episode.agents[1:]] == ["walker"] * 3
    world = World([episode], {town.name: town})
    traces = {name: rollout(world, make_system(name))[0] for name in ("blind", "example-careful")}
    assert [bool(trace.contact.any()) for trace in traces.values()] == [True, False]

    def simulator(assign):
        return World([episode] * 2, {town.name: town}, assign=np.array(assign))

    check_driver(lambda: make_system("example-careful"), simulator, episodes=2, steps=10)


def test_the_generator_proposes_the_corners_first() -> None:
    from ssad import load_scenarios, load_town, make_system
    from ssad.scenarios.dynamic.generate import Trials, generator_factory, search

    scenario = load_scenarios("StraightObstacle/00")[0]
    trials = Trials(lambda: make_system("example-careful"))
    base = trials.base(scenario, load_town(scenario.town), seed=0)
    made = generator_factory("example-corners")([base], seeds=[0], budget=4)
    ((first, *others),) = [search(made, [base], trials, budget=4, batch=2)]
    assert len(first) == 4
    assert not others
    assert len({tuple(sorted(o.proposal.scenario.parameters.items())) for o in first}) == 4


def test_the_adversary_proves_that_the_driver_follows_too_closely(tmp_path: Path) -> None:
    """A driver that looks 4 m ahead, from its middle, sees nobody in time; one with a safe gap would have stopped."""
    import ssad

    results = ssad.run(
        "adversarial-quick",
        set={
            "systems": ["example-careful?reach=4@short", "autopilot"],
            "generators": ["example-brake-test"],
            "scenarios": [str(FOLDER / "lead.yaml")],
        },
        out=tmp_path / "run",
        workers=0,
        quiet=True,
    )
    assert not results.failures
    proven = {row["system"]: row["metrics"]["proven"] for row in results.rows}
    assert proven == {"short": True, "autopilot": False}


def test_the_kind_runs(tmp_path: Path) -> None:
    import ssad

    suite = tmp_path / "coin.yaml"
    suite.write_text("kind: example-coin\nname: coin\nsystems: [penny, dime]\ntosses: 100\n")
    results = ssad.run(suite, out=tmp_path / "run", workers=0, quiet=True)
    assert [0.2 < row["metrics"]["heads"] < 0.8 for row in results.rows] == [True, True]
    assert results.report.is_file()


def test_the_detector_keeps_its_promises_and_the_attack_its_budget() -> None:
    torch = pytest.importorskip("torch")
    from ssad import make_detector
    from ssad.core.detections import Truth
    from ssad.detectors.check import check_detector
    from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack

    detector = make_detector("example-smoothed?width=5")
    check_detector(detector, size=(64, 96))
    noise = np.random.default_rng(0).integers(0, 256, (1, 3, 64, 96))
    images = torch.from_numpy(noise.astype(np.float32)) / 255
    truth = [Truth(torch.tensor([0]), torch.tensor([[16.0, 16.0, 64.0, 56.0]]))]
    done = run_attack(make_attack("example-steps", steps=2), detector, images, truth, Budget(px(5)), objective="full")
    assert float((done.images - images).abs().max()) <= 5 / 255 + 1e-6
    assert float(done.after) > float(done.before)


def test_the_loss_lowers_scores_behind_the_defence() -> None:
    torch = pytest.importorskip("torch")
    from ssad import make_detector
    from ssad.core.detections import Truth
    from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack
    from ssad.scenarios.static.digital.defences import Defended, make_defence

    grey = make_defence("example-grey", share=1.0)
    image = torch.randint(0, 256, (1, 3, 64, 96), generator=torch.Generator().manual_seed(0)) / 255
    np.testing.assert_allclose(grey(image).std(1), 0.0, atol=1e-6)
    detector, truth = make_detector("yolov5n"), [Truth(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4))]
    done = run_attack(
        make_attack("example-steps"), detector, image, truth, Budget(px(5)), objective="example-top?places=5"
    )
    assert float(done.after) > float(done.before)
    scores = [float(detector.dense(images).logit.sigmoid().amax()) for images in (image, done.images)]
    assert scores[1] < scores[0]
    assert Defended(detector, grey).name == "yolov5n+grey-1"


def test_the_shift_and_the_sticker_get_stronger_with_their_severity() -> None:
    pytest.importorskip("torch")
    from ssad.scenarios.static.catalogue import parse_perturbation

    black = np.zeros((1, 60, 60, 3), np.uint8)
    hazes = [parse_perturbation("example-haze").make(severity).shift for severity in (1, 5)]
    brightness = [haze.shift(black, [], []).mean() for haze in hazes]
    assert 0.0 < brightness[0] < brightness[1] < 255.0
    stickers = [parse_perturbation("example-sticker").make(severity) for severity in (1, 5)]
    covered = [(sticker.apply(black.transpose(0, 3, 1, 2), None, None, None) > 0).mean() for sticker in stickers]
    assert 0.0 < covered[0] < covered[1] < 1.0
    assert stickers[0].family == "occlusion"


def test_the_light_shines_on_the_rear_and_the_texture_has_its_settings() -> None:
    pytest.importorskip("torch")
    from ssad.scenarios.static.physical import make_physical
    from ssad.scenarios.static.physical.lights import TargetSize, make_light

    light, target = make_light("example-spot", {"lumens": 500.0}), TargetSize(4.5, 1.8, 1.5)
    assert light.ranges(target)["lumens"] == (0.0, 500.0)
    (lamp,) = light.edit({"lumens": 400.0, "aim_up": 1.0}, target).lamps
    assert (lamp.power, lamp.pose[0, 3]) == (400.0, target.rear - 8.0)
    assert make_physical("example-pale", epochs=3).epochs == 3


def test_the_simulator_keeps_its_protocol_and_its_brakes_are_worn() -> None:
    from ssad import build_episode, load_scenarios, load_town, make_system, rollout
    from ssad.simulators.closed_loop import make_simulator
    from ssad.world.check import check_simulator

    (scenario,) = load_scenarios("ExampleWalkers")  # the class brings one
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)

    def simulator(assign):
        from ssad_example.simulator import WornBrakes

        return WornBrakes([episode] * 2, {town.name: town}, assign=np.array(assign))

    check_simulator(simulator, episodes=2, steps=10)
    collides = {}
    for name in ("embedded", "example-worn-brakes?brake=0.05"):
        world = make_simulator(name, [episode], {town.name: town}, device="cpu")
        (trace,) = rollout(world, make_system("example-careful"))
        collides[name] = bool(trace.contact.any())
    assert list(collides.values()) == [False, True]


def test_the_planner_keeps_its_protocol() -> None:
    pytest.importorskip("torch")
    from ssad import World, build_episode, load_scenarios, load_town
    from ssad.drivers.perceiving.check import check_planner
    from ssad.drivers.perceiving.parts import make_planner

    scenarios = load_scenarios("LaneChanging")[:2]
    town = load_town(scenarios[0].town)
    episodes = [build_episode(scenario, town, seed=0) for scenario in scenarios]

    def simulator(assign):
        return World(episodes, {town.name: town}, assign=np.array(assign))

    check_planner(lambda: make_planner("example-brake", reach=10.0), simulator, episodes=2, steps=10)


def test_the_perceiver_and_the_tracker_keep_their_protocols() -> None:
    pytest.importorskip("torch")
    from ssad import World, build_episode, load_scenarios, load_town
    from ssad.drivers.perceiving.check import check_perceiver, check_tracker
    from ssad.drivers.perceiving.parts import make_perceiver, make_tracker

    scenarios = load_scenarios("LaneChanging")[:2]
    town = load_town(scenarios[0].town)
    episodes = [build_episode(scenario, town, seed=0) for scenario in scenarios]

    def simulator(assign):
        return World(episodes, {town.name: town}, assign=np.array(assign))

    check_perceiver(lambda: make_perceiver("example-clusters", reach=80.0), simulator, episodes=2, steps=2)
    check_tracker(lambda: make_tracker("example-nearest"), episodes=episodes)


def test_the_perceiver_boxes_a_cluster_of_points() -> None:
    from ssad.drivers.perceiving.parts import make_perceiver
    from ssad.rendering.lidar import HDL32E

    side = np.linspace(-0.9, 0.9, 10)
    points = np.stack([np.full(10, 12.0), side, np.full(10, 1.0), np.ones(10)], 1) @ np.linalg.inv(HDL32E.to_ego).T
    rows = np.column_stack([points[:, :3], np.ones(10), np.zeros(10)]).astype(np.float32)
    boxes = make_perceiver("example-clusters").boxes(rows)
    assert boxes.label.tolist() == [0]
    np.testing.assert_allclose(boxes.centre[0], [12.0, 0.0, 1.0], atol=1e-4)
