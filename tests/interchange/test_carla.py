"""CARLA: over a stand-in of its client, whose names are checked against the stubs of the real wheel."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers.command import ssad_process
from helpers.quick import others_slow

from ssad.core.errors import ConfigError
from ssad.core.types import Actor, Controller, Episode, EpisodeTrace, Limits, Pose, Scenario, SignalState
from ssad.drivers import make_system
from ssad.interchange import carla as adapter
from ssad.interchange.carla import Carla, Server
from ssad.metrics import episode_metrics
from ssad.roads import load_town, town_signals
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.rollout import rollout
from ssad.world.world import World

ROOT = Path(__file__).parent.parent.parent
STAND_IN = Path(__file__).parent.parent / "helpers" / "carla_stand_in"
SERVER = Server("here", 2000, timeout=5.0)
FEW = ("StraightObstacle/00",)


@pytest.fixture
def carla(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The stand-in as the module carla."""
    source = STAND_IN / "carla" / "__init__.py"
    spec = importlib.util.spec_from_file_location("carla", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "carla", module)
    spec.loader.exec_module(module)
    adapter._KEPT.clear()
    yield module
    adapter._KEPT.clear()


def built(scenarios: Sequence[Scenario]) -> list[Episode]:
    return [build_episode(scenario, load_town(scenario.town), seed=0) for scenario in scenarios]


def drive_there(episodes: Sequence[Episode], system: str) -> list[EpisodeTrace]:
    traces = []
    for episode in episodes:
        simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
        traces += rollout(simulator, make_system(system))
        simulator.close()
    return traces


def same(episodes: Sequence[Episode], system: str) -> None:
    here = rollout(World(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(system))
    for one, other in zip(here, drive_there(episodes, system), strict=True):
        assert one.end == other.end, one.key
        assert abs(len(one.accel) - len(other.accel)) <= 1, one.key
        rows = min(len(one.accel), len(other.accel))
        off = np.hypot(one.x[:rows] - other.x[:rows], one.y[:rows] - other.y[:rows])[one.active[:rows]]
        assert off.max() < 0.05, one.key
        measured, again = (episode_metrics(trace).as_dict() for trace in (one, other))
        for name in ("collision", "route_distance", "route_complete", "red_lights", "off_road_distance"):
            if name in measured:
                assert again[name] == pytest.approx(measured[name], rel=0.01, abs=0.05), (one.key, name)


@pytest.mark.parametrize(("names", "system"), [
    (FEW, "blind"),
    pytest.param(("precrash",), "blind", marks=pytest.mark.slow),
    pytest.param(("precrash",), "autopilot", marks=pytest.mark.slow),
])  # fmt: skip
def test_episodes_go_as_in_the_embedded_world(carla: ModuleType, names: Sequence[str], system: str) -> None:
    same(built([scenario for name in names for scenario in load_scenarios(name)]), system)
    assert carla.CALLS["Client.generate_opendrive_world"] + carla.CALLS["Client.load_world"] == 1  # one town, one load


def test_natural_traffic_comes_and_goes(carla: ModuleType) -> None:
    """Traffic that sleeps, that the Autopilot drives, that leaves at the end of its route."""
    same(built(load_scenarios("natural")[:1]), "autopilot")


def test_trajectories_are_put_and_leave(carla: ModuleType) -> None:
    rows = ((1.0, 230.0, -1.75, 0.0), (3.0, 250.0, -1.75, 0.0))
    late = Actor("late", "coupe", Pose(*rows[0][1:]), trajectory=rows)
    route = (Pose(217.0, -5.25), Pose(260.0, -5.25))
    scenario = Scenario("late", "Custom", "ProvingGround", route, actors=(late,), limits=Limits(max_steps=40))
    (trace,) = drive_there(built([scenario]), "autopilot")
    there = np.flatnonzero(trace.active[:, 1])
    assert (there[0], there[-1]) == (10, 30)
    assert trace.x[20, 1] == pytest.approx(240.0, abs=0.01)
    assert trace.speed[20, 1] == pytest.approx(10.0, abs=0.01)
    assert len(carla.SERVERS["here", 2000]._actors) == 0


def test_reset_signals_and_settings(carla: ModuleType) -> None:
    """A reset gives the same episode again; CARLA's lights show what ours say; the server's settings come back."""
    (episode,) = built(load_scenarios("RedlightRunning/00"))
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
    world = carla.SERVERS["here", 2000]
    first = rollout(simulator, make_system("blind"))[0]
    again = rollout(simulator, make_system("blind"))[0]
    assert np.array_equal(first.x, again.x)
    names = town_signals(episode.town)
    assert episode.signal_override
    for signal, state in episode.signal_override.items():
        shown = world._lights[names[signal]]._state
        assert shown.name.upper() == SignalState(state).name
    assert world._settings.synchronous_mode
    simulator.close()
    assert not world._settings.synchronous_mode


def test_what_only_carla_feels_ends_the_episode(carla: ModuleType) -> None:
    """A wall of the town, or a body of another shape."""
    (episode,) = built(load_scenarios("StraightObstacle/00"))
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
    mask = np.zeros((1, simulator.agents), bool)
    mask[0, 0] = True
    simulator.take(mask, Controller.FOLLOW, target_speed=5.0)
    simulator._hits.append((999, "static.road"))
    simulator.step()
    assert simulator.ended()[0] == 0
    simulator._hits.append((998, "static.wall"))
    simulator.step()
    assert simulator.ended()[0] == 1
    assert simulator.state().contact[0] == 8
    assert simulator.state().contact_agent[0] == -2


FAULTS = (
    "Client.get_server_version", "version", "Client.get_world", "Client.get_available_maps", "Client.load_world",
    "World.get_map", "roads", "World.get_traffic_light_from_opendrive_id", "World.get_settings",
    "World.apply_settings", "World.freeze_all_traffic_lights", "World.set_weather", "World.get_blueprint_library",
    "World.try_spawn_actor", "nothing", "World.spawn_actor:3", "Sensor.listen", "World.tick", "World.tick:20",
    "World.get_snapshot:7", "Vehicle.apply_control:9", "Walker.apply_control", "TrafficLight.set_state",
    "Actor.destroy",
)  # fmt: skip


QUICK = ("version", "nothing", "World.tick:20")


@pytest.mark.parametrize("fault", others_slow(FAULTS, QUICK))
def test_a_server_that_fails_ends_in_a_line(carla: ModuleType, fault: str) -> None:
    (episode,) = built(load_scenarios("StraightObstacle/00"))
    carla.FAULT = fault

    def drive_twice() -> None:
        simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
        rollout(simulator, make_system("blind"))
        simulator.reset()

    with pytest.raises(ConfigError, match=r"^CARLA at here:2000: ") as error:
        drive_twice()
    assert len(str(error.value)) < 400
    carla.FAULT = ""
    adapter._KEPT.clear()
    carla.SERVERS.clear()
    if fault in QUICK:
        assert drive_there([episode], "blind")[0].end == "collision"  # the next one runs


def test_a_batch_and_a_bad_address_are_refused(carla: ModuleType) -> None:
    episodes = built(load_scenarios("StraightObstacle")[:2])
    with pytest.raises(ConfigError, match="one scene at a time, not 2"):
        Carla(episodes, {episodes[0].town: load_town(episodes[0].town)}, server=SERVER)
    for address in (
        "carla:/x",
        "carla://",
        "carla://a:0",
        "carla://a:99999",
        "http://a",
        "carla://a b",
        "carla://a:-1",
    ):
        with pytest.raises(ConfigError, match="expected carla://HOST"):
            Server.of(address)
    assert Server.of("carla://a.b:3000") == Server("a.b", 3000)
    assert Server.of("carla://[::1]") == Server("::1")


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "code"), [
    ("", 0), ("World.tick:100", 1), ("version", 2), ("Client.get_server_version", 2),
])  # fmt: skip
def test_a_run_goes_on(fault: str, code: int, tmp_path: Path) -> None:
    """Through the command: a server that dies fails episodes, and one that never answers is a line."""
    path = f"{STAND_IN}:{Path(adapter.__file__).parent.parent.parent}"
    done = ssad_process(
        "run", "precrash", "--out", str(tmp_path / "run"), "--set", "simulator=carla://here:2000",
        "--set", "systems=[blind]", "--set", "scenarios=[StraightObstacle]", "--set", "repetitions=1",
        PYTHONPATH=path, CARLA_STAND_IN_FAULT=fault,
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    if code == 2:
        assert len(done.stderr.splitlines()) == 1
        return
    records = [json.loads(line) for line in (tmp_path / "run" / "results.jsonl").read_text().splitlines()]
    assert len(records) == 4
    bad = [record for record in records if record["status"] != "ok"]
    assert (len(bad) > 0) == bool(fault)
    assert all("CARLA at here:2000: cannot" in record["reason"] for record in bad)


# ---------------------------------------------------------------- the real wheel


def _wheel() -> Path:
    spec = importlib.util.find_spec("carla")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("the package carla is not installed (it has no wheel for this Python)")
    return Path(spec.submodule_search_locations[0])


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new", "code"), [
    ("hand_brake=", "hand_brake=", 0), ("hand_brake=", "handbrake=", 1), ("set_target_velocity(", "set_speed(", 1),
])  # fmt: skip
def test_mypy_checks_the_adapter_against_the_stubs(old: str, new: str, code: int, tmp_path: Path) -> None:
    """Every class, method, argument and attribute; mypy does not find the wheel's stubs by itself."""
    place = tmp_path / "stubs" / "carla"
    place.mkdir(parents=True)
    for name in ("libcarla", "command"):
        text = (_wheel() / f"{name}.pyi").read_text(encoding="utf-8")
        (place / f"{name.replace('libcarla', '__init__')}.pyi").write_text(text, encoding="utf-8")
    source = Path(adapter.__file__)
    changed = tmp_path / "adapter.py"
    changed.write_text(source.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    words = ["--strict", "--cache-dir", str(tmp_path.parent / "mypy"), str(changed)]
    path = f"{tmp_path / 'stubs'}:{source.parent.parent.parent}"
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), *words],
        env=os.environ | {"MYPYPATH": path}, capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr


def _stubs() -> dict[str, ast.ClassDef]:
    text = (_wheel() / "libcarla.pyi").read_text(encoding="utf-8")
    return {node.name: node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)}


def _members(stubs: dict[str, ast.ClassDef], name: str) -> dict[str, list[ast.AST]]:
    """Members of a class of the stubs and of its bases."""
    found: dict[str, list[ast.AST]] = {}
    for base in stubs[name].bases:
        if isinstance(base, ast.Name) and base.id in stubs:
            found |= _members(stubs, base.id)
    for node in stubs[name].body:
        if isinstance(node, ast.FunctionDef):
            found.setdefault(node.name, []).append(node)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = [node]
        elif isinstance(node, ast.Assign):
            found |= {target.id: [node] for target in node.targets if isinstance(target, ast.Name)}
    return found


def test_the_stand_in_has_nothing_that_the_wheel_has_not() -> None:
    """Classes, methods, arguments with their order, attributes: what runs here runs on no invented name."""
    stubs = _stubs()
    spec = importlib.util.spec_from_file_location("carla_stand_in", STAND_IN / "carla" / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["carla_stand_in"] = module
    spec.loader.exec_module(module)
    del sys.modules["carla_stand_in"]
    own = {name: kind for name, kind in vars(module).items()
           if inspect.isclass(kind) and kind.__module__ == "carla_stand_in"}  # fmt: skip
    assert len(own) > 20
    checked = 0
    for name, kind in own.items():
        assert name in stubs, f"carla has no {name}"
        members = _members(stubs, name)
        listed = {k for k in vars(kind) if not k.startswith("_")} | set(getattr(kind, "__dataclass_fields__", ()))
        for member in listed:
            told = ast.unparse(stubs[name])  # the presets of the weather stand in its text
            assert member in members or (name, member in told) == ("WeatherParameters", True), f"{name}.{member}"
            checked += 1
        for member in (*listed, *(["__init__"] if hasattr(kind, "__dataclass_fields__") else [])):
            method = vars(kind).get(member)
            wanted = [n for n in members.get(member, ()) if isinstance(n, ast.FunctionDef)]
            if not inspect.isfunction(method) or not wanted or name in ("WorldSettings", "CollisionEvent"):
                continue
            mine = list(inspect.signature(method).parameters)
            theirs = [[a.arg for a in node.args.args] for node in wanted]
            assert any(mine == other[: len(mine)] for other in theirs), f"carla.{name}.{member}: {mine} {theirs}"
            checked += 1
    assert checked > 80
