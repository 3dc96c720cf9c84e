"""Whatever a suite names may be an object of a package: in every kind, under every key.

`names_in` finds all keys of all kinds that take text. Each is either in `CASES`, which names an object of
`templates/ssad-plugin` there, or in `NOT_OBJECTS`, which says why no package can bring one. A new key, a new kind and a
key that is gone fail the first test.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
import pytest
from helpers.photographs import write_list
from helpers.quick import others_slow
from helpers.sharing import Shared
from helpers.template import PACKAGE, PROJECT, installed_template
from helpers.tiny import make_tiny
from pydantic import BaseModel

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.registry import names
from ssad.detectors import cached_detector
from ssad.experiments.suites import KINDS, kind_of, load_suite
from ssad.rendering.camera.scene import SceneObject
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.catalogue import PerturbationEntry, parse_perturbation

Options = Mapping[str, Any]


@dataclass(frozen=True)
class Plugin:
    """An object of the template.

    Attributes:
        target: "module:object", below the package.
        name: Name of its entry point.
        options: Arguments that change what it does; empty: it takes none.
    """

    target: str
    name: str
    options: Options = field(default_factory=dict)

    @property
    def module(self) -> str:
        """Module of the object, below the package."""
        return self.target.partition(":")[0]


PLUGINS = {
    "system": Plugin("driver:Careful", "example-careful", {"reach": 8}),
    "perceiver": Plugin("perceiver:Clusters", "example-clusters", {"reach": 30}),
    "tracker": Plugin("tracker:Nearest", "example-nearest", {"gate": 3}),
    "planner": Plugin("planner:Brake", "example-brake", {"reach": 10}),
    "detector": Plugin("detector:smoothed", "example-smoothed", {"width": 5}),
    "attack": Plugin("attack:Steps", "example-steps", {"steps": 2}),
    "loss": Plugin("loss:TopScores", "example-top", {"places": 50}),
    "defence": Plugin("defence:Grey", "example-grey", {"share": 0.5}),
    "shift": Plugin("shift:Haze", "example-haze", {"share": 0.1}),
    "physical-attack": Plugin("texture:pale", "example-pale", {"epochs": 2}),
    "light": Plugin("light:Spot", "example-spot", {"lumens": 500.0}),
    "perturbation": Plugin("perturbation:Sticker", "example-sticker"),
    "fault": Plugin("fault:WetLens", "example-wet-lens", {"period": 2.0}),
    "generator": Plugin("generator:Corners", "example-corners", {"margin": 0.1}),
    "adversary": Plugin("adversary:BrakeTest", "example-brake-test", {"radius": 15.0}),
    "scenario": Plugin("scenario:SCENARIO", "ExampleWalkers"),
    "simulator": Plugin("simulator:WornBrakes", "example-worn-brakes", {"brake": 0.5}),
    "kind": Plugin("kind:Coin", "example-coin"),
}

SUITES: dict[str, dict[str, Any]] = {
    "driving": {"systems": ["blind"], "scenarios": ["SHORT"]},
    "adversarial": {"systems": ["blind"], "scenarios": ["SHORT"], "generators": ["random"], "budget": 2, "batch": 2},
    "how-often": {"systems": ["blind"], "scenarios": ["SHORT"], "methods": ["monte-carlo"], "episodes": 10},
    "gap": {"systems": [{"name": "s", "detector": "truth"}], "scenarios": ["SHORT"], "ceilings": []},
    "perception": {"detectors": ["yolov5n"]},
    "detection": {"detectors": ["fcos3d-light"], "shifts": ["fog"], "severities": [3]},
    "digital": {"detectors": ["yolov5n"], "attacks": ["fgsm"]},
    "physical": {"detectors": ["yolov5n"], "attacks": ["grey"], "seeds": 1},
    "reality": {"detectors": ["yolov5n"], "data": "PHOTOGRAPHS"},
    "tour": {"parts": [{"name": "part", "suite": "quick"}]},
    "example-coin": {"systems": ["penny"]},
}
"""The smallest suite of each kind; a case changes one key of it. SHORT: a scenario of a second; PHOTOGRAPHS: a folder
of two."""


def reference(name: str, options: Options, label: str = "") -> str:
    """Return a name with arguments on one line, as `ssad.core.registry.Reference` reads it."""
    arguments = "&".join(f"{key}={value}" for key, value in options.items())
    return f"{name}{'?' * bool(options)}{arguments}{'@' * bool(label)}{label}"


def entry(name: str, options: Options) -> Any:
    """Return a name with arguments below it."""
    return {name: dict(options)} if options else name


def named(key: str, *, also: Sequence[str] = ()) -> Callable[[str, Options], dict[str, Any]]:
    """Return the suite that lists a reference, behind other names, under a key."""
    return lambda name, options: {key: [*also, reference(name, options, "mine" if options else "")]}


def row(key: str, **more: Any) -> Callable[[str, Options], dict[str, Any]]:
    """Return the suite with an entry {name, options} in the list of a key."""
    return lambda name, options: {key: [{"name": name, "options": dict(options), **more}]}


def system(key: str, **more: Any) -> Callable[[str, Options], dict[str, Any]]:
    """Return the suite of kind `gap` whose system has a part."""
    return lambda name, options: {"systems": [{"name": "s", **more, key: entry(name, options)}]}


def perturbation(cameras: Options, name: str, options: Options) -> dict[str, Any]:
    """Return the suite with a perturbation."""
    return {"perturbations": [entry(name, options)], **cameras}


def loss_of(make: Callable[[str], dict[str, Any]], name: str, options: Options) -> dict[str, Any]:
    """Return a suite with a loss, whose arguments stand behind its name."""
    return make(reference(name, options))


def members(name: str, options: Options) -> dict[str, Any]:
    """Return the suite of kind `digital` with an ensemble of attacks."""
    return {"attacks": [{"name": "ensemble", "members": ["fgsm", {"name": name, "options": dict(options)}]}]}


def shuffled(name: str, options: Options) -> dict[str, Any]:
    """Return the suite of kind `physical` with an attack and its control."""
    return {"attacks": [{"name": name, "settings": dict(options)}, {"name": "shuffled", "of": name}]}


CAR_AHEAD: dict[str, Options] = {"gap": {"scenarios": ["LaneChanging/00"]}}
"""What a light needs: in the loop, a car that it can shine on."""

RUNS: dict[str, dict[str, Any]] = {
    "driving": {
        "systems": ["ssad_example.driver:Careful?reach=8@short"],
        "scenarios": ["ssad_example.scenario:SCENARIO"],
        "simulator": "example-worn-brakes?brake=0.1",
    },
    "adversarial": {
        "systems": ["example-careful"],
        "generators": ["ssad_example.generator:Corners?margin=0.2@inner"],
        "transfer": ["ssad_example.driver:Careful"],
        "keep": 1,
    },
    "how-often": {"systems": ["example-careful?reach=8"], "methods": "auto", "particles": 10, "repeats": 2},
    "gap": {
        "systems": [{"name": "s", "detector": "truth", "tracker": "example-nearest", "planner": "example-brake"}],
        "ceilings": ["example-careful"],
    },
    "perception": {
        "detectors": ["helpers.linear3d:build"],
        "perturbations": [
            "ssad_example.shift:Haze",
            "example-sticker",
            {"example-steps": {"loss": "example-top", "radius": 5}},
        ],
        "data": "TINY",
    },
    "detection": {"detectors": ["helpers.linear3d:build"], "shifts": ["example-haze?share=0.15@haze"], "data": "TINY"},
    "digital": {
        "detectors": ["helpers.linear3d:build"],
        "attacks": [
            {
                "name": "ssad_example.attack:Steps",
                "loss": "ssad_example.loss:TopScores?places=5",
                "defence": {"name": "ssad_example.defence:Grey", "options": {"share": 0.5}},
                "aware": True,
            }
        ],
        "data": "TINY",
    },
    "physical": {
        "detectors": ["example-smoothed"],
        "attacks": [{"name": "ssad_example.texture:pale", "settings": {"epochs": 1, "batch": 2}}],
        "lights": [{"name": "ssad_example.light:Spot", "settings": {"settings": 2, "members": 2}}],
        "pairs": [{"train": "Twinford", "test": "Oldmarket", "train_images": 2, "test_images": 1}],
        "size": 128,
        "floor": 0.0,
    },
    "reality": {"detectors": ["example-smoothed"]},
    "tour": {"parts": [{"name": "part", "suite": "COIN ssad_example.kind:Coin"}]},
    "example-coin": {"kind": "ssad_example.kind:Coin"},
}
"""Suites that run with objects of the template. TINY: a data set of one scene."""

Case = tuple[str, Callable[[str, Options], dict[str, Any]]]
"""The kind of object, and the suite that names it with its arguments."""

CASES: dict[tuple[str, str], Case] = {
    ("driving", "systems"): ("system", named("systems")),
    ("driving", "scenarios"): ("scenario", named("scenarios")),
    ("driving", "simulator"): ("simulator", lambda name, options: {"simulator": reference(name, options)}),
    ("adversarial", "systems"): ("system", named("systems")),
    ("adversarial", "transfer"): ("system", named("transfer")),
    ("adversarial", "generators"): ("generator", named("generators")),
    ("adversarial", "scenarios"): ("scenario", named("scenarios")),
    ("how-often", "systems"): ("system", named("systems")),
    ("how-often", "scenarios"): ("scenario", named("scenarios")),
    ("gap", "scenarios"): ("scenario", named("scenarios")),
    ("gap", "ceilings"): ("system", named("ceilings")),
    ("gap", "systems.detector"): (
        "detector",
        lambda name, options: {"systems": [{"name": "s", "detector": reference(name, options)}]},
    ),
    ("gap", "systems.perceiver"): ("perceiver", system("perceiver")),
    ("gap", "systems.tracker"): ("tracker", system("tracker", detector="truth")),
    ("gap", "systems.planner"): ("planner", system("planner", detector="truth")),
    ("perception", "detectors"): ("detector", named("detectors")),
    ("detection", "detectors"): (
        "detector",
        lambda name, options: {"detectors": [reference(name, {"detector": "fcos3d-light", **options})]},
    ),
    ("detection", "shifts"): ("shift", named("shifts", also=["fog"])),
    ("digital", "detectors"): ("detector", named("detectors")),
    ("digital", "hardened"): ("detector", named("hardened")),
    ("digital", "transfer_detectors"): (
        "detector",
        lambda name, options: {"transfer_detectors": [reference(name, options)], "transfer": ["fgsm"]},
    ),
    ("digital", "attacks.name"): ("attack", row("attacks")),
    ("digital", "attacks.loss"): ("loss", partial(loss_of, lambda loss: {"attacks": [{"name": "fgsm", "loss": loss}]})),
    ("digital", "attacks.defence.name"): (
        "defence",
        lambda name, options: {"attacks": [{"name": "fgsm", "defence": {"name": name, "options": dict(options)}}]},
    ),
    ("digital", "attacks.members.name"): ("attack", members),
    ("digital", "attacks.members.loss"): (
        "loss",
        partial(
            loss_of,
            lambda loss: {"attacks": [{"name": "ensemble", "members": ["fgsm", {"name": "pgd", "loss": loss}]}]},
        ),
    ),
    ("digital", "sweeps.name"): ("attack", row("sweeps", radii=[2])),
    ("digital", "sweeps.loss"): (
        "loss",
        partial(loss_of, lambda loss: {"sweeps": [{"name": "fgsm", "loss": loss, "radii": [2]}]}),
    ),
    ("digital", "transfer.name"): (
        "attack",
        lambda name, options: {**row("transfer")(name, options), "detectors": ["yolov5n", "yolov3-tiny"]},
    ),
    ("digital", "transfer.loss"): (
        "loss",
        partial(
            loss_of,
            lambda loss: {"transfer": [{"name": "fgsm", "loss": loss}], "detectors": ["yolov5n", "yolov3-tiny"]},
        ),
    ),
    ("physical", "detectors"): ("detector", named("detectors")),
    ("physical", "judges"): ("detector", named("judges")),
    ("physical", "attacks.name"): (
        "physical-attack",
        lambda name, options: {"attacks": [{"name": name, "settings": dict(options)}]},
    ),
    ("physical", "attacks.of"): ("physical-attack", shuffled),
    ("physical", "attacks.settings"): (
        "loss",
        partial(loss_of, lambda loss: {"attacks": [{"name": "vanishing", "settings": {"objective": loss}}]}),
    ),
    ("physical", "lights.name"): ("light", row("lights", hour="night")),
    ("reality", "detectors"): ("detector", named("detectors")),
    ("tour", "parts.suite"): ("kind", lambda name, options: {"parts": [{"name": "part", "suite": f"COIN {name}"}]}),
    ("example-coin", "kind"): ("kind", lambda name, options: {"kind": name}),
} | {
    (kind, f"perturbations[{family}].{key}"): case
    for kind, cameras in (("gap", {"systems": [{"name": "s", "detector": "yolov5n"}]}), ("perception", {}))
    for (family, key), case in {
        ("shift", "name"): ("shift", partial(perturbation, cameras)),
        ("digital", "name"): ("attack", partial(perturbation, cameras)),
        ("digital", "loss"): (
            "loss",
            partial(loss_of, lambda loss, cameras=cameras: perturbation(cameras, "fgsm", {"loss": loss, "radius": 2})),
        ),
        ("light", "name"): ("light", partial(perturbation, {**cameras, **CAR_AHEAD.get(kind, {})})),
        ("fault", "name"): ("fault", partial(perturbation, cameras)),
        ("own", "name"): ("perturbation", partial(perturbation, cameras)),
    }.items()
}

NOT_OBJECTS: dict[str, str] = {
    # of all kinds
    "SuiteBase.name": "the suite's own name",
    "SuiteBase.kind": "the base of the kinds: each has a key of its own",
    "SuiteBase.title": "prose",
    "SuiteBase.description": "prose",
    "SuiteBase.reference": "a table of the paper, which the report has",
    "DetectorTable.name": "the suite's own name",
    "AttackTable.name": "the suite's own name",
    "TargetTable.name": "the suite's own name",
    # choices that the kinds themselves make, in code of their own
    "ScenarioSuite.cluster": "what is drawn independently",
    "TrafficSuite.drivers": "how the drivers of background traffic are drawn",
    "PerceivingSystem.steers_by": "the route, or the lane keeper of SSAD",
    "ScenarioSuite.sweep": "values of parameters, or the word `grid`",
    "ScenarioSuite.sweep_mode": "how the values of a sweep are combined",
    "ScenarioSuite.matrix": "parameters of a sweep",
    "ScenarioSuite.matrix_metric": "a column of the kind",
    "DrivingSuite.pictures": "pictures of the report",
    "HowOftenSuite.methods": "estimators, which branch the world",
    "DetectionSuite.calibration": "tables of severities of SSAD's shifts",
    "AttackTable.precision": "type of the gradients",
    "Method.precision": "type of the gradients",
    "Method.norm": "norms of a budget",
    "DigitalEntry.norm": "norms of a budget",
    "Entry.carrier": "surfaces that a texture can cover",
    "PerceivingSystem.cameras": "cameras of nuScenes' rig",
    # files and data
    "DetectorTable.data": "a folder",
    "DetectorTable.version": "a version of its data",
    "DetectorTable.split": "a split of its data",
    "RealitySuite.data": "a folder",
    "RealitySuite.split": "a split of its data",
    "RealitySuite.textures": "a texture is data: its card, or an exported folder",
    "RealitySuite.controls": "untrained textures, of the kind's own",
    "RecordedData.towns": "towns: maps that are imported, not code",
    "PerceptionSuite.target_town": "a town",
    "Pair.train": "a town",
    "Pair.test": "a town",
    "Grid.towns": "towns",
    "Grid.weathers": "weathers of the renderer",
    "TargetTable.target": "a body of the renderer",
    "TargetLightEntry.hour": "an hour of the day",
    "Entry.texture": "a file",
    "PerceivingSystem.weights": "a file",
    # labels, classes and arguments
    "PerceivingSystem.name": "a label",
    "PerturbationEntry.label": "a label",
    "PerturbationEntry.options": "arguments of the named object",
    "Method.options": "arguments of the named object",
    "Guard.options": "arguments of the named object",
    "Entry.options": "arguments of the carrier",
    "TargetLightEntry.options": "arguments of the named object",
    "TargetLightEntry.settings": "arguments of the search",
    "DigitalEntry.classes": "classes of detectors",
    "AttackEntry.classes": "classes of detectors",
    "AttackEntry.becomes": "classes of detectors",
    "AttackEntry.object": "an object of the data",
    "TextureEntry.name": "a texture is data: its card, or an exported folder",
    "Part.name": "a label",
    "Part.settings": "keys of another suite, of which each has its case",
    "Part.question": "prose",
    "Part.limits": "prose",
    "TourSuite.limits": "prose",
    "CoinSuite.systems": "words: no code stands behind a coin",
}
"""Keys that take text but no object of a package, as "Schema.key", and what they take."""


@dataclass(frozen=True)
class TextKey:
    """Key of a suite that takes text.

    Attributes:
        kind: Kind of the suite.
        path: The key below the suite, such as "systems.detector", or "perturbations[shift].name".
        schemas: "Schema.key" for the schema that has the key and those that it inherits it from.
    """

    kind: str
    path: str
    schemas: tuple[str, ...]


def names_in(kind: str) -> list[TextKey]:
    """Return all keys of a kind's suites that take text; a key with one possible text says nothing."""
    return list(_keys(kind, kind_of(kind).suite, ""))


def _keys(kind: str, schema: type[BaseModel], prefix: str) -> Iterator[TextKey]:
    for key, info in schema.model_fields.items():
        holders = [base for base in schema.__mro__ if key in inspect.get_annotations(base)]
        for part in _parts(info.annotation):
            if isinstance(part, type) and issubclass(part, BaseModel):
                family = ""
                if issubclass(part, PerturbationEntry):
                    family = f"[{get_args(part.model_fields['family'].annotation)[0]}]"
                yield from _keys(kind, part, f"{prefix}{key}{family}.")
        if any(part in (str, Any) for part in _parts(info.annotation)):
            yield TextKey(kind, prefix + key, tuple(f"{holder.__name__}.{key}" for holder in [schema, *holders]))


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield the plain types of an annotation; `str` for a choice of several words."""
    origin = get_origin(annotation)
    if origin is Literal:
        if len([value for value in get_args(annotation) if isinstance(value, str)]) > 1:
            yield str
    elif origin is Annotated:
        yield from _parts(get_args(annotation)[0])
    elif origin in (typing.Union, UnionType, list, dict, tuple):
        for argument in get_args(annotation):
            yield from _parts(argument)
    else:
        yield annotation


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy of the template, installed; modules may be edited."""
    with installed_template(tmp_path_factory.mktemp("plugins") / "site", copy=True) as folder:
        yield folder


@pytest.fixture
def folder(package: Path, tmp_path: Path) -> Path:
    """A folder with a scenario of a second."""
    (tmp_path / "short.yaml").write_text(
        "name: short\ntype: StraightObstacle\ntown: ProvingGround\nlimits: {max_steps: 10}\n"
        "route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]\n"
    )
    return tmp_path


def suite_file(folder: Path, kind: str, changes: Mapping[str, Any]) -> Path:
    """Write the smallest suite of a kind with some changes."""
    data = {"kind": kind, "name": "contract", **SUITES[kind], **changes}
    if "SHORT" in data.get("scenarios", ()):
        data["scenarios"] = [str(folder / "short.yaml")]
    if data.get("data") == "PHOTOGRAPHS":
        data["data"] = str(write_list(folder / "photographs"))
    for part in data.get("parts", ()):
        if part["suite"].startswith("COIN "):
            coin = {"kind": part["suite"].removeprefix("COIN "), "name": "coin", "systems": ["penny"]}
            part["suite"] = str(folder / "coin.yaml")
            (folder / "coin.yaml").write_text(safeio.dump_json(coin))
    path = folder / "suite.yaml"
    path.write_text(safeio.dump_json(data))
    return path


def keys_of(folder: Path, kind: str, changes: Mapping[str, Any], *, check: bool = False) -> set[str]:
    """Return the keys of the cells of the smallest suite of a kind with some changes."""
    suite = load_suite(str(suite_file(folder, kind, changes)))
    return {cell.key for cell in kind_of(suite.kind).plan(suite, check=check).cells}


def test_every_key_that_takes_text_names_an_object_or_says_why_not(package: Path) -> None:
    keys = [key for kind in names("kind", KINDS) for key in names_in(kind)]
    assert set(SUITES) == {key.kind for key in keys}
    open_keys = [
        f"{key.kind}: {key.path} ({key.schemas[0]})"
        for key in keys
        if (key.kind, key.path) not in CASES and not set(key.schemas) & set(NOT_OBJECTS)
    ]
    assert open_keys == [], "add a case to CASES, or a reason to NOT_OBJECTS"
    assert set(CASES) <= {(key.kind, key.path) for key in keys}
    assert set(NOT_OBJECTS) <= {schema for key in keys for schema in key.schemas}


def test_the_template_has_an_object_of_every_group(package: Path) -> None:
    in_table = {plugin.name for plugin in PLUGINS.values()}
    registered = {name: value for group in PROJECT["entry-points"].values() for name, value in group.items()}
    assert registered == {plugin.name: f"{PACKAGE}.{plugin.target}" for plugin in PLUGINS.values()}
    # An adversary is named under the key of the generator, which has one case.
    assert {kind for kind, _ in CASES.values()} == set(PLUGINS) - {"adversary"}
    assert len(in_table) == len(PLUGINS)


@pytest.mark.parametrize(("kind", "path"), list(CASES), ids=[f"{kind}-{path}" for kind, path in CASES])
def test_a_key_takes_the_object_of_a_package(package: Path, folder: Path, kind: str, path: str) -> None:
    object_kind, suite_with = CASES[kind, path]
    plugin = PLUGINS[object_kind]
    target = f"{PACKAGE}.{plugin.target}"
    suites = {"target": suite_with(target, {}), "name": suite_with(plugin.name, {})}
    keys = {form: keys_of(folder, kind, changes, check=form == "target") for form, changes in suites.items()}
    assert keys["target"]
    if plugin.options:
        assert keys_of(folder, kind, suite_with(target, plugin.options)) != keys["target"]
    source = package / f"{plugin.module}.py"
    source.write_text(source.read_text() + "# edited\n")
    for form, changes in suites.items():
        edited = keys_of(folder, kind, changes)
        assert edited != keys[form], f"the source of {source.name} decides the results, and is in no key ({form})"


def test_an_attack_of_a_user_on_signs_changes_them_in_the_loop(package: Path, folder: Path) -> None:
    """The attack of the guide, as a module of the package."""
    guide = (Path(__file__).parents[2] / "docs/how-to/attack-lane-keeping.md").read_text()
    source = package / "signs.py"
    source.write_text(guide.partition("```python\n")[2].partition("```")[0])
    name = f"{PACKAGE}.signs:SlowDown"
    system = {"name": "reads limits", "detector": "truth", "steers_by": "markings", "set_speed": 20.0}
    changes = {"systems": [system], "perturbations": [name]}
    keys = keys_of(folder, "gap", changes)
    attack = parse_perturbation(name).make(1)
    edit = attack.in_loop(SensorSuite(), target=0, victim=None, seed=0).street_edit
    assert edit is not None
    (key,) = edit.meshes()
    shown = edit.objects((SceneObject(3, np.eye(4)),), np.zeros((2, 2)), {key: 8}, {3: "limit_sign:60"})
    assert [entry.mesh for entry in shown] == [8]
    source.write_text(source.read_text().replace('"20"', '"30"'))
    assert len(keys_of(folder, "gap", changes) & keys) == len(keys) - 1, "the cell of the attack has another key"


@pytest.fixture(scope="session")
def scene(shared: Shared) -> Path:
    """A data set of one sample: six images of 160 x 90."""
    return shared("one-sample", lambda out: make_tiny(out, scenes=1, samples=1, sweeps=0, size=(160, 90)))


@pytest.fixture
def known_scene(scene: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The scene that the linear detector knows; a process keeps detectors by name, also those of other tests."""
    monkeypatch.setenv("LINEAR_DATA", str(scene))
    cached_detector.cache_clear()
    yield scene
    cached_detector.cache_clear()


@pytest.mark.parametrize(  # a texture is trained in seconds at best
    "kind", others_slow(SUITES, [kind for kind in SUITES if kind != "physical"])
)
def test_a_suite_with_the_objects_runs(package: Path, folder: Path, known_scene: Path, kind: str) -> None:
    import ssad

    changes = {key: str(known_scene) if value == "TINY" else value for key, value in RUNS[kind].items()}
    if "data" in changes:
        changes |= {"split": "all", "replicates": 0}
    results = ssad.run(suite_file(folder, kind, changes), out=folder / "run", workers=0, quiet=True)
    assert [row.get("reason") for row in results.rows if row["status"] != "ok"] == []
    assert results.report.is_file()


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        ("driving", {"simulator": "embeded"}, r"unknown simulator 'embeded'; closest: embedded"),
        ("driving", {"simulator": "example-worn-brakes?breaks=1"}, r"simulator '.*': got an unexpected .* 'breaks'"),
        ("driving", {"scenarios": ["ssad.scenarios.dynamic.knowledge.right_turn:SCENARIO"]}, "brings no scenarios"),
        ("adversarial", {"generators": ["example-corners?size=1"]}, "generator .* unexpected keyword argument 'size'"),
        ("detection", {"shifts": ["foggy"]}, "unknown shift 'foggy'; closest: fog"),
        ("detection", {"shifts": ["helpers.own_perturbations:Wrong"]}, "has no severities: give its class"),
        ("digital", {"attacks": [{"name": "fgsm", "loss": "ful"}]}, "unknown loss 'ful'; closest: full"),
        ("digital", {"attacks": [{"name": "fgsm", "loss": "example-top?place=1"}]}, "loss .* argument 'place'"),
        ("digital", {"attacks": [{"name": "fgsm", "loss": "ssad_example.defence:Grey"}]}, "lacks needs_objects"),
        ("digital", {"attacks": [{"name": "fgsm", "defence": "jpg"}]}, "unknown defence 'jpg'; closest: jpeg"),
        (
            "digital",
            {"attacks": [{"name": "fgsm", "defence": {"name": "example-grey", "options": {"shade": 1}}}]},
            "defence .* argument 'shade'",
        ),
    ],
)
def test_a_wrong_name_or_argument_is_refused_in_one_line(
    package: Path, folder: Path, kind: str, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        keys_of(folder, kind, changes, check=True)
    assert "\n" not in str(error.value)
