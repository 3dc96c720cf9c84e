"""Kind `physical`: its plan, and a small run from the recording to the report, resumed and replotted."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.command import ssad

from ssad.core import safeio
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.images import read_image
from ssad.engine.kind import Job, Resources
from ssad.engine.run import run
from ssad.experiments.perception.physical.kind import Physical, PhysicalSuite, attacks_of
from ssad.experiments.perception.physical.target_table import rows_of
from ssad.experiments.runs import write_report
from ssad.experiments.suites import load_suite
from ssad.scenarios.static.physical import Expectation, TextureSpec, make_physical

ROOT = Path(__file__).parents[4]
PAIR = {"train": "Twinford", "test": "Oldmarket", "train_images": 2, "test_images": 2}
SETTINGS: dict[str, Any] = {"detectors": {}, "target": "sedan:silver:0", "seed": 0, "floor": 0.0, "replicates": 0}


def suite(**changes: Any) -> PhysicalSuite:
    """A suite that takes seconds."""
    given: dict[str, Any] = {
        "kind": "physical",
        "name": "small",
        "detectors": ["yolov5n"],
        "pairs": [PAIR],
        "epochs": 1,
        "seeds": 1,
        "size": 320,
        "behind": 10.0,
        "replicates": 0,
        "floor": 0.0,
        "attacks": [{"name": "random", "carrier": "patch"}, "vanishing", {"name": "shuffled", "of": "vanishing"}],
    }
    return PhysicalSuite.model_validate(given | changes)


def test_cells_are_attacks_by_detector_and_towns() -> None:
    plan = Physical().plan(suite(detectors=["yolov5n", "yolov3-tiny"], transfer=True, seeds=2))
    rows = [(c.fields["detector"], c.fields["attack"], c.fields["source"], c.fields["number"]) for c in plan.cells]
    assert rows[:8] == [
        ("yolov5n", "clean", "", 0),
        ("yolov5n", "random", "", 0),
        ("yolov5n", "random", "", 1),
        ("yolov5n", "vanishing", "yolov5n", 0),
        ("yolov5n", "vanishing", "yolov3-tiny", 0),
        ("yolov5n", "shuffled vanishing", "yolov5n", 0),
        ("yolov5n", "shuffled vanishing", "yolov5n", 1),
        ("yolov3-tiny", "clean", "", 0),
    ]
    assert len({cell.key for cell in plan.cells}) == len(plan.cells) == 2 * 7
    trained = {TextureSpec.of_row(cell.spec).name for cell in plan.cells if cell.spec["source"]}
    assert len(trained) == 2, "a texture for each detector, shown to both and shuffled"


def test_stealth_is_in_the_title_and_the_loud_one_is_shuffled() -> None:
    quiet = {"name": "vanishing", "settings": {"stealth": 0.5}}
    plan = Physical().plan(suite(attacks=["vanishing", quiet, {"name": "shuffled", "of": "vanishing"}], seeds=1))
    by_title = {cell.fields["attack"]: TextureSpec.of_row(cell.spec).name for cell in plan.cells if cell.spec["source"]}
    assert set(by_title) == {"vanishing", "vanishing, stealth 0.5", "shuffled vanishing"}
    assert by_title["shuffled vanishing"] == by_title["vanishing"] != by_title["vanishing, stealth 0.5"]


def titles(attacks: list[Any], **changes: Any) -> dict[str, str]:
    """Of what is trained, in a suite with these attacks: title and carrier -> name of the texture."""
    plan = Physical().plan(suite(attacks=attacks, **changes))
    cells = [cell for cell in plan.cells if cell.spec["source"]]
    return {f"{c.fields['attack']} | {c.fields['carrier']}": TextureSpec.of_row(c.spec).name for c in cells}


WIDE = {"width": 1.9, "height": 0.86}


def test_shuffled_says_by_carrier_options_and_settings_which_attack_is_meant() -> None:
    patches = [{"name": "adv-patch", "options": WIDE}, {"name": "adv-patch", "options": {"width": 0.8}}]
    found = titles([*patches, {"name": "shuffled", "of": "adv-patch", "options": {"width": 1.9}}])
    assert len(found) == 3
    wide = "patch, height 0.86, width 1.9"
    assert found[f"shuffled adv-patch | {wide}"] == found[f"adv-patch | {wide}"]
    found = titles([patches[0], "adv-patch", {"name": "shuffled", "of": "adv-patch"}])
    assert found["shuffled adv-patch | patch"] == found["adv-patch | patch"], "the one that says nothing more"
    roads = [{"name": "das", "carrier": "road"}, "das", {"name": "shuffled", "of": "das", "carrier": "road"}]
    found = titles(roads)
    assert found["shuffled das | road"] == found["das | road"] != found["das | camouflage"]
    slow = {"rate": 0.01}
    rows = ["vanishing", {"name": "vanishing", "settings": slow}]
    found = titles([*rows, {"name": "shuffled", "of": "vanishing", "settings": slow}])
    assert found["shuffled vanishing, rate 0.01 | camouflage"] == found["vanishing, rate 0.01 | camouflage"]
    shown = [{"name": "das", "texture": f"das-{which}yolov5n-twinford"} for which in ("", "all-sides-")]
    found = titles([*shown, {"name": "shuffled", "of": "das", "texture": shown[1]["texture"]}])
    own = f"das, texture {shown[1]['texture']} | camouflage"
    assert found[f"shuffled {own}"] == found[own]


def test_shuffled_of_one_of_several_ends_in_a_line_that_names_them() -> None:
    patches = [{"name": "adv-patch", "options": WIDE}, {"name": "adv-patch", "options": {"width": 0.8}}]
    several = "several fit, say carrier, .* of one: patch, height 0.86, width 1.9; patch, width 0.8"
    for options, message in (({}, several), ({"width": 3.0}, "none fits, say carrier, .* patch, width 0.8")):
        with pytest.raises(ConfigError, match=message) as found:
            titles([*patches, {"name": "shuffled", "of": "adv-patch", "options": options}])
        assert "\n" not in str(found.value)
    rows = [{"name": "das", "settings": {"rate": rate}} for rate in (0.01, 0.1)]
    with pytest.raises(ConfigError, match=r"one: camouflage, rate 0\.01; camouflage, rate 0\.1"):
        titles([*rows, {"name": "shuffled", "of": "das"}])


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ([{}, {"rate": 0.01}], ["vanishing", "vanishing, rate 0.01"]),
        ([{"batch": 16}, {"batch": 16, "stealth": 0.5}], ["vanishing", "vanishing, stealth 0.5"]),
        ([{"batch": 16}, {"batch": 4}], ["vanishing, batch 16", "vanishing, batch 4"]),
        ([{}, {"epochs": 3}], ["vanishing", "vanishing, epochs 3"]),
        ([{}, {"expectation": {"noise": 0.2}}], ["vanishing", "vanishing, expectation noise 0.2"]),
        ([{"batch": 16}], ["vanishing"]),
    ],
)
def test_titles_tell_rows_of_one_attack_apart(settings: list[dict[str, Any]], names: list[str]) -> None:
    found = titles([{"name": "vanishing", "settings": one} for one in settings])
    assert list(found) == [f"{name} | camouflage" for name in names]
    lights = [{"name": "laser", "settings": one} for one in ({}, {"searches": 4})]
    plan = Physical().plan(suite(attacks=[], lights=lights))
    assert [c.fields["attack"] for c in plan.cells] == ["clean", "laser", "random laser", "laser, searches 4"]


def test_titles_tell_textures_apart_that_are_shown_or_trained_from_more_sides() -> None:
    rows = [{"name": "das", "texture": "das-yolov5n-twinford"}, {"name": "das", "around": 2}]
    more = [{"name": "das", "texture": "das-all-sides-yolov5n-twinford"}, {"name": "das", "around": 3}]
    usual = [cell.fields["attack"] for cell in Physical().plan(suite(attacks=rows)).cells]
    assert usual == ["clean", "das", "das, all sides"]
    found = [cell.fields["attack"] for cell in Physical().plan(suite(attacks=rows + more)).cells]
    assert found == [
        "clean",
        "das, texture das-yolov5n-twinford",
        "das, all sides, around 2",
        "das, texture das-all-sides-yolov5n-twinford",
        "das, all sides, around 3",
    ]


def test_titles_of_the_suites_whose_tables_are_kept_stay_as_they_are() -> None:
    """They name sides, stealth and loss alone; a stored table would not be found again under another."""
    files = [path for folder in ("suites", "benchmarks") for path in (ROOT / folder).glob("physical*.yaml")]
    assert len(files) >= 11
    usual = re.compile(r"(shuffled |random )?[a-z-]+(, all sides)?(, stealth [0-9.]+)?(, objective hide)?")
    for path in files:
        names = {row.fields["attack"] for row in rows_of(load_suite(str(path)))}
        assert [name for name in names if not usual.fullmatch(name)] == [], path.name


def test_a_key_covers_what_decides_the_result() -> None:
    one = {cell.name: cell.key for cell in Physical().plan(suite()).cells}
    assert {cell.name: cell.key for cell in Physical().plan(suite()).cells} == one
    for change in ({"epochs": 2}, {"behind": 12.0}, {"target": "suv:red:0"}):
        other = {cell.name: cell.key for cell in Physical().plan(suite(**change)).cells}
        assert (
            other["yolov5n/Oldmarket/vanishing/camouflage/yolov5n/0"]
            != one["yolov5n/Oldmarket/vanishing/camouflage/yolov5n/0"]
        ), change


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"detectors": ["fcos3d-light"], "lights": ["laser"]}, ConfigError, "fcos3d-light is no 2D detector; lights"),
        ({"pairs": [PAIR | {"test": "Nowhere"}]}, ConfigError, "unknown town 'Nowhere'"),
        ({"target": "stop_sign"}, ConfigError, "no panel 'rear'"),
        ({"target": "stop_sign", "attacks": [], "lights": ["laser"]}, ConfigError, "lights and around are for cars"),
        ({"judges": ["yolov5n"]}, ConfigError, "yolov5n appears twice"),
        ({"grid": {"distances": [1.0]}}, ConfigError, "distances: 3 to 80 m"),
        ({"grid": {"weathers": ["hail"]}}, UnknownNameError, "hail"),
        ({"approach": {"distances": [5.0, 90.0]}}, ConfigError, "give distances from 3 to 80 m"),
        ({"approach": {"distances": [5.0, 80.0], "size": 320}}, ConfigError, "a car 80 m away needs 431"),
        ({"attacks": [{"name": "random", "project": True}]}, ConfigError, "project is for a texture"),
        ({"lights": [{"name": "projector", "settings": {"inks": True}}]}, ConfigError, "light, not print"),
        ({"grid": {"towns": ["Twinford"]}}, ConfigError, "no pair is tested in Twinford"),
        ({"attacks": [{"name": "random", "around": 2}]}, ConfigError, "is not trained"),
        ({"attacks": ["vanish"]}, UnknownNameError, "vanishing"),
        ({"attacks": [{"name": "vanishing", "settings": {"speed": 3}}]}, ConfigError, "no setting 'speed'"),
        *(
            ({"attacks": [{"name": "vanishing", "settings": {key: value}}]}, ConfigError, f"attack vanishing: .*{key}")
            for key, value in {
                "rate": float("nan"),
                "name": "x",
                "expectation": 3,
                "batch": 2.5,
                "epochs": 2.5,
                "smooth": -1,
                "objective": "hid",
                "window": "wide",
            }.items()
        ),
        *(
            ({"attacks": [{"name": "adv-patch", "options": {key: value}}]}, ConfigError, f"attack adv-patch: .*{key}")
            for key, value in (("centre", [0.5]), ("centre", "mid"), ("texels", 64.5), ("width", "x"))
        ),
        (
            {"attacks": [{"name": "das", "carrier": "road", "options": {"texels": 9.5}}]},
            ConfigError,
            r"attack das: road: texels=9\.5",
        ),
        ({"lights": [{"name": "projector", "settings": {"expectation": 3}}]}, ConfigError, "projector: expectation=3"),
        ({"lights": [{"name": "projector", "settings": {"stealth": 1}}]}, ConfigError, "projector: stealth=1"),
        ({"lights": [{"name": "laser", "options": {"search": "luck"}}]}, ConfigError, "laser: search='luck'"),
        ({"lights": [{"name": "laser", "settings": {"search": "luck"}}]}, ConfigError, "laser: search='luck'"),
        ({"attacks": [{"name": "random", "settings": {"rate": 1.0}}]}, ConfigError, "is not trained"),
        ({"attacks": [{"name": "shuffled"}]}, ConfigError, "of which attack"),
        ({"attacks": ["das", {"name": "vanishing", "of": "das"}]}, ConfigError, "of which attack"),
        ({"attacks": [{"name": "shuffled", "of": "das"}]}, ConfigError, "there must be one such attack"),
        ({"attacks": [{"name": "adv-patch", "options": {"panel": "wing"}}]}, ConfigError, "no panel 'wing'"),
        ({"attacks": [{"name": "adv-patch", "options": {"width": 9.0}}]}, ConfigError, "does not fit"),
        ({"attacks": [{"name": "adv-patch", "options": {"colour": 1}}]}, ConfigError, "colour"),
        ({"lights": ["lazer"]}, UnknownNameError, "laser"),
        ({"lights": [{"name": "laser", "hour": "dawn"}]}, UnknownNameError, "noon"),
        ({"lights": [{"name": "laser", "options": {"watts": -1.0}}]}, ConfigError, r"laser: watts=-1\.0"),
        ({"lights": [{"name": "laser", "settings": {"epochs": 3}}]}, ConfigError, "epochs"),
        ({"lights": [{"name": "projector", "settings": {"members": 3}}]}, ConfigError, "members"),
    ],
)
def test_a_wrong_suite_ends_in_one_line(change: Mapping[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as found:
        Physical().plan(suite(**change))
    assert "\n" not in str(found.value)


def test_a_town_of_the_training_is_no_town_of_the_test(tmp_path: Path) -> None:
    written = safeio.dump_json({**suite().model_dump(), "pairs": [PAIR]})
    path = tmp_path / "small.yaml"
    path.write_text(written)
    with pytest.raises(
        ConfigError, match=r"pairs.*: trained and tested in Twinford: name another town for the test$"
    ) as found:
        load_suite(str(path), ["pairs=[{train: Twinford, test: Twinford}]"])
    assert "\n" not in str(found.value)


def test_an_expectation_stands_in_a_suite_as_a_mapping() -> None:
    settings = {"expectation": {"noise": 0.2, "contrast": [0.7, 1.3]}}
    plan = Physical().plan(suite(attacks=[{"name": "vanishing", "settings": settings}]))
    spec = TextureSpec.of_row(plan.cells[1].spec)
    assert make_physical(spec.attack, **spec.settings).expectation == Expectation((0.7, 1.3), noise=0.2)


def test_a_centre_of_one_number_ends_the_command_in_one_line(tmp_path: Path) -> None:
    written = {**suite().model_dump(), "attacks": [{"name": "adv-patch", "options": {"centre": [0.5]}}]}
    path = tmp_path / "small.yaml"
    path.write_text(safeio.dump_json(written))
    done = ssad("run", str(path), "--dry-run", "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "attack adv-patch: patch: centre" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_judges_are_shown_what_is_trained_against_others_and_the_grid_is_scored_apart() -> None:
    grid = {"distances": [10.0], "azimuths": [0.0, 180.0], "elevations": [15.0], "weathers": ["day", "night"]}
    plan = Physical().plan(suite(judges=["yolov3-tiny", "fcos3d-light"], grid=grid))
    rows = [(c.fields["view"], c.fields["detector"], c.fields["attack"], c.fields["source"]) for c in plan.cells]
    assert len(rows) == 2 * 3 * 4
    assert ("grid", "fcos3d-light", "vanishing", "yolov5n") in rows
    assert ("drive", "yolov3-tiny", "shuffled vanishing", "yolov5n") in rows
    assert {source for *_, source in rows} == {"", "yolov5n"}, "nothing is trained against a judge"
    drive, other = (
        {c.key for c in Physical().plan(suite(grid=one)).cells if c.fields["view"] == "drive"}
        for one in (grid, grid | {"distances": [5.0]})
    )
    assert drive == other, "the pictures from behind do not depend on the grid"


def test_an_approach_has_cells_of_its_own_and_textures_are_trained_on_its_distances(tmp_path: Path) -> None:
    """With `train: false` they are trained from behind, as without an approach, and are others."""
    approach = {"distances": [5.0, 40.0], "images": 3, "size": 640}
    given = suite(approach=approach)
    plan = Physical().plan(given)
    views = [(cell.fields["view"], cell.fields["attack"]) for cell in plan.cells]
    attacks = ["clean", "random", "vanishing", "shuffled vanishing"]
    assert views == [(view, attack) for view in ("drive", "approach") for attack in attacks]
    recorded = {recording.out.name: recording for recording in given.recordings(tmp_path, "cpu")}
    assert set(recorded) == {"Oldmarket", "Oldmarket-approach", "Twinford-approach"}
    assert recorded["Twinford-approach"].images == (("Twinford", 2),)
    assert recorded["Oldmarket-approach"].images == (("Oldmarket", 3),)
    assert (recorded["Oldmarket"].size, recorded["Oldmarket"].approach) == (320, ())
    assert (recorded["Oldmarket-approach"].size, recorded["Oldmarket-approach"].approach) == (640, (5.0, 40.0))
    specs = [
        TextureSpec.of_row(Physical().plan(one).cells[2].spec)
        for one in (given, suite(), suite(approach=approach | {"train": False}), suite(inks=False))
    ]
    assert [spec.approach for spec in specs] == [True, False, False, False]
    assert [spec.inks for spec in specs] == [True, True, True, False]
    assert specs[1].name == specs[2].name
    assert len({spec.name for spec in specs}) == 3
    keys = [{cell.key for cell in Physical().plan(one).cells} for one in (suite(), given)]
    assert len(keys[0] & keys[1]) == 2, "clean ones and controls from behind do not depend on the approach"


def test_a_texture_is_projected_on_request() -> None:
    shown = {"name": "das", "texture": "das-yolov5n-twinford"}
    specs = {
        cell.fields["attack"]: TextureSpec.of_row(cell.spec)
        for cell in Physical().plan(suite(attacks=[shown, shown | {"project": True}])).cells[1:]
    }
    assert [spec.inks for spec in specs.values()] == [False, True]
    assert list(specs)[1] == "das, project True"


def test_a_texture_can_be_trained_from_all_sides_too_and_the_grid_be_of_one_town() -> None:
    attacks = ["vanishing", {"name": "vanishing", "around": 3}, {"name": "shuffled", "of": "vanishing", "around": 3}]
    pairs = [PAIR, PAIR | {"train": "Crossgate", "test": "Larkhill"}]
    plan = Physical().plan(suite(attacks=attacks, pairs=pairs, grid={"towns": ["Larkhill"]}))
    names = ["clean", "vanishing", "vanishing, all sides", "shuffled vanishing, all sides"]
    seen: dict[str, list[str]] = {}
    for cell in plan.cells:
        seen.setdefault(f"{cell.fields['test']} {cell.fields['view']}", []).append(cell.fields["attack"])
    assert seen == dict.fromkeys(("Oldmarket drive", "Larkhill drive", "Larkhill grid"), names)
    textures = {cell.fields["attack"]: TextureSpec.of_row(cell.spec) for cell in plan.cells[1:4]}
    assert textures["vanishing"].name != textures["vanishing, all sides"].name
    assert textures["vanishing, all sides"].name == textures["shuffled vanishing, all sides"].name


@pytest.mark.parametrize("name", ["physical", "physical-quick"])
def test_the_shipped_suites_can_be_planned(name: str) -> None:
    assert len(load_suite(name).attacks) >= 5


def test_lights_are_cells_with_a_clean_one_for_each_hour_and_random_ones_beside() -> None:
    rows = [{"name": "laser", "hour": "night"}, {"name": "shadow", "hour": "noon"}]
    plan = Physical().plan(suite(attacks=[], lights=rows, seeds=2))
    fields = [(c.fields["attack"], c.fields["carrier"], c.fields["source"], c.fields["number"]) for c in plan.cells]
    assert fields == [
        ("clean", "light, night", "", 0),
        ("clean", "light, noon", "", 0),
        ("laser", "light, night", "yolov5n", 0),
        ("random laser", "light, night", "", 0),
        ("random laser", "light, night", "", 1),
        ("shadow", "light, noon", "yolov5n", 0),
        ("random shadow", "light, noon", "", 0),
        ("random shadow", "light, noon", "", 1),
    ]
    other = Physical().plan(suite(attacks=[], lights=[rows[0] | {"options": {"watts": 0.1}}, rows[1]], seeds=2))
    same = {cell.key for cell in plan.cells} & {cell.key for cell in other.cells}
    assert len(same) == len(plan.cells) - 3
    named = {cell.fields["carrier"] for cell in other.cells if cell.fields["attack"] != "clean"}
    assert named == {"light, night, watts 0.1", "light, noon"}, "lasers of two powers are two rows"
    assert len(load_suite("physical-lights").lights) >= 4
    with_textures = Physical().plan(suite(lights=rows, seeds=1))
    assert sum(cell.fields["attack"] == "clean" for cell in with_textures.cells) == 3


@pytest.mark.slow
def test_a_run_of_lights_from_the_search_to_the_picture(tmp_path: Path) -> None:
    settings = {"settings": 4, "members": 2, "window": None}
    rows = [
        {"name": "laser", "settings": settings},
        {"name": "shadow", "hour": "noon", "settings": settings},
        {"name": "projector", "options": {"lumens": 50.0}, "settings": {"epochs": 1, "window": None}},
    ]
    plan = Physical().plan(suite(attacks=[], lights=rows))
    records = run(plan, tmp_path, Resources(workers=2))
    assert [(record["reason"], record["status"]) for record in records] == [("", "ok")] * len(records)
    by_name = {(record["attack"], record["carrier"]): record for record in records}
    laser = by_name["laser", "light, night"]
    assert laser["queries"] == 8
    assert 0.0 <= laser["lumens"] <= 0.5 * 683.0
    assert laser["loss_after"] >= laser["loss_before"]
    assert by_name["shadow", "light, noon"]["lumens"] is None
    assert by_name["random laser", "light, night"]["queries"] == 0
    assert by_name["projector", "light, night, lumens 50.0"]["lumens"] <= 50.0
    assert "ASR_25" not in by_name["clean", "light, night"]["metrics"]
    kept = {path.name: path.read_bytes() for path in (tmp_path / "lights").glob("*.json")}
    plan.kind.finish(plan, tmp_path)
    assert read_image(tmp_path / "pictures" / "lights.jpg").shape[1] == 3 * 644
    for path in (tmp_path / "lights").iterdir():
        path.unlink()
    job = Job(tmp_path, "cpu", SETTINGS)
    again = Physical().execute(plan.cells, job)
    assert {cell.key: again[cell.key]["metrics"] for cell in plan.cells} == {r["key"]: r["metrics"] for r in records}
    assert {path.name: path.read_bytes() for path in (tmp_path / "lights").glob("*.json")} == kept


def test_textures_of_a_run_are_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A control can be made any time; what is not trained, or shows no texture, is one line."""
    attacks = [{"name": "random", "carrier": "patch", "options": {"width": 1.2, "height": 0.3}}, "vanishing"]
    plan = Physical().plan(suite(attacks=attacks))
    monkeypatch.setattr("ssad.experiments.perception.physical.kind.read_plan", lambda folder: plan)
    monkeypatch.setattr("ssad.engine.store.read_run", lambda folder: {})  # the command looks for the run first
    clean, random, vanishing = plan.cells
    done = ssad("export", "texture", str(tmp_path), random.key, str(tmp_path / "out"), "--dots", "400")
    assert str(tmp_path / "out" / "target.obj") in done.stdout.replace("\n", ""), done.stderr[-300:]
    assert read_image(tmp_path / "out" / "print.png").shape == (120, 480, 3)
    for cell, message in ((clean, "shows no texture"), (vanishing, "is not trained yet")):
        failed = ssad("export", "texture", str(tmp_path), cell.key, str(tmp_path / "other"))
        assert failed.returncode == 2
        assert message in failed.stderr.replace("\n", " ")
        assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_a_run_from_the_recording_to_the_picture(tmp_path: Path) -> None:
    rows = [{"name": "random", "carrier": "patch"}, {"name": "vanishing", "around": 1}]
    plan = Physical().plan(suite(attacks=[*rows, {"name": "shuffled", "of": "vanishing", "around": 1}]))
    records = run(plan, tmp_path, Resources(workers=2))
    assert [record["status"] for record in records] == ["ok"] * 4
    clean, random, trained, shuffled = records
    assert clean["metrics"]["AP50"] > 0.5
    assert "ASR_25" not in clean["metrics"]
    assert trained["epochs"] == 1
    assert "epochs" not in random
    job = Job(tmp_path, "cpu", SETTINGS)
    cell = next(cell for cell in plan.cells if cell.fields["attack"] == "vanishing, all sides")
    spec = TextureSpec.of_row(cell.spec)
    colour = attacks_of(job).texture(spec).make()
    picture = read_image(tmp_path / trained["artefacts"]["texture"])
    assert picture.shape == (128, 128, 3)
    kept = np.abs(picture / 255 - colour.permute(1, 2, 0).numpy()).max(2) < 0.005
    assert kept.mean() > 0.3, "what is on the body; the gutter is grey"
    assert shuffled["artefacts"]["texture"] != trained["artefacts"]["texture"]
    plan.kind.finish(plan, tmp_path)
    assert read_image(tmp_path / "pictures" / "drive-oldmarket.jpg").shape[1] == 3 * 644
    results = (tmp_path / "results.jsonl").read_bytes()
    assert run(plan, tmp_path, Resources(workers=1)) == records
    assert (tmp_path / "results.jsonl").read_bytes() == results
    texture = tmp_path / trained["artefacts"]["texture"].replace(".png", ".npz")
    texture.unlink()
    assert np.array_equal(attacks_of(job).texture(spec).make(), colour), "the checkpoint goes on where it ended"
    texture.unlink()
    texture.with_suffix(".checkpoint.npz").unlink()
    Physical().execute([cell], job)  # which needs no piece of work done before it
    assert np.array_equal(attacks_of(job).texture(spec).make(), colour), "trained anew, the same to the bit"


@pytest.mark.slow  # test_optimise.py shows a small one whole pictures with their cameras
def test_a_texture_is_trained_against_a_3d_detector(tmp_path: Path) -> None:
    """It is shown whole pictures with their camera, whatever the window; its loss on them rises."""
    given = suite(
        detectors=["fcos3d-light"],
        attacks=[{"name": "vanishing", "settings": {"batch": 2}}],
        epochs=12,
        window=192,
        pairs=[PAIR | {"test_images": 1}],
    )
    plan = Physical().plan(given)
    records = run(plan, tmp_path, Resources(workers=1))
    assert [(record["reason"], record["status"]) for record in records] == [("", "ok")] * 2
    plan.kind.finish(plan, tmp_path)
    assert (tmp_path / "pictures" / "drive-oldmarket.jpg").is_file()
    own = next(record for record in records if record["attack"] == "vanishing")
    assert own["loss_after"] > own["loss_before"]


@pytest.mark.slow
def test_the_grid_is_recorded_and_a_panel_that_nobody_sees_is_refused_there_alone(tmp_path: Path) -> None:
    """A patch on the front is not seen from behind, and is from the front; a 3D detector judges."""
    grid = {"distances": [8.0], "azimuths": [0.0, 180.0], "elevations": [10.0], "weathers": ["overcast"]}
    attacks = [{"name": "random", "carrier": "patch", "options": {"panel": "front"}}]
    plan = Physical().plan(suite(grid=grid, attacks=attacks, judges=["fcos3d-light"]))
    by_name = dict(zip([cell.name for cell in plan.cells], run(plan, tmp_path, Resources(workers=2)), strict=True))
    behind = by_name["yolov5n/Oldmarket/random/patch, panel front/yolov5n/0"]
    assert behind["status"] == "failed"
    assert "never in view in the 2 pictures of Oldmarket" in behind["reason"]
    around = by_name["yolov5n/Oldmarket/random/patch, panel front/yolov5n/0/grid"]
    assert around["status"] == "ok"
    assert sorted(view[1] for view in around["views"]) == [0.0, 180.0]
    assert {view[3] for view in around["views"]} == {"overcast"}
    assert [cell[2] for cell in around["cells"]] == [1, 1]
    judged = by_name["fcos3d-light/Oldmarket/clean//fcos3d-light/0"]
    assert judged["status"] == "ok"
    assert judged["metrics"]["AP50"] is not None
    plan.kind.finish(plan, tmp_path)
    assert (tmp_path / "pictures" / "grid-oldmarket.jpg").is_file()
    assert "Views from all around" in write_report(tmp_path).read_text()


def test_a_clean_car_that_is_not_found_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No attack is reported where the detector does worse than the floor without it."""
    from ssad.engine.kind import CellError
    from ssad.metrics.target_attacks import TargetSighting

    nothing = TargetSighting("a", np.zeros((0, 4)), np.zeros(0), np.array([[0.0, 0.0, 9.0, 9.0]]), np.zeros(1, bool))
    monkeypatch.setattr("ssad.experiments.perception.open_loop._clean_sightings", lambda *given: (nothing,))
    plan = Physical().plan(suite(floor=0.9))
    job = Job(tmp_path, "cpu", SETTINGS | {"floor": 0.9})
    (clean,) = Physical().execute([plan.cells[0]], job).values()
    assert clean["metrics"]["AP50"] == 0.0
    for target, noun in (("sedan:silver:0", "car"), ("stop_sign", "stop sign"), ("pedestrian", "pedestrian")):
        other = replace(job, settings={**job.settings, "target": target})
        with pytest.raises(CellError, match=rf"the clean {noun} with AP50 0\.000, which is less than the floor of 0\."):
            Physical().execute([plan.cells[1]], other)
    assert safeio.dump_json(dict(clean))
