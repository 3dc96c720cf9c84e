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


def test_the_kind_runs(tmp_path: Path) -> None:
    import ssad

    suite = tmp_path / "coin.yaml"
    suite.write_text("kind: example-coin\nname: coin\nsystems: [penny, dime]\ntosses: 100\n")
    found = ssad.run(suite, out=tmp_path / "run", workers=0, quiet=True)
    assert [0.2 < row["metrics"]["heads"] < 0.8 for row in found.rows] == [True, True]
    assert found.report.is_file()


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
