"""Maps of OpenSCENARIO documents: the one beside the file comes in, and no other of its name takes its place."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.command import ssad
from helpers.openscenario import document, lane_position, road, start

from ssad.core.errors import FormatError
from ssad.core.safeio import home_folder
from ssad.interchange.openscenario_reader import read_openscenario
from ssad.scenarios.dynamic import read_scenarios
from ssad.world.roads import import_map, load_town

STARTS = start("Ego", lane_position(-1, 50), "${$v / 3.6}") + start("Target", lane_position(-2, 80, 0.5), 0)
SPEED = '<ParameterDeclaration name="v" parameterType="double" value="50"/>'


def written(folder: Path, map_file: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.xosc"
    path.write_text(document(STARTS, parameters=SPEED, map_file=map_file))
    return path


def test_the_map_beside_the_file_comes_in(tmp_path: Path) -> None:
    """The speed is the expression's; lanes and offsets are where the map has them."""
    path = written(tmp_path / "in", "beside.xodr")
    (path.parent / "beside.xodr").write_text(road())
    done = ssad("import", "openscenario", path, tmp_path / "out.yaml")
    assert done.returncode == 0, done.stderr
    assert "map beside.xodr imported as town 'beside'" in done.stdout
    (scenario,) = read_scenarios(tmp_path / "out.yaml")
    assert scenario.town == "beside"
    assert scenario.parameters["ego_speed"] == pytest.approx(50 / 3.6, abs=1e-4)
    (target,) = scenario.actors
    assert (target.pose.x, target.pose.y) == pytest.approx((80.0 + 1.4, -5.25 + 0.5), abs=1e-6)
    done = ssad("import", "openscenario", path, tmp_path / "again.yaml")
    assert "imported as" not in done.stdout


def test_another_town_of_the_same_name_is_not_taken(tmp_path: Path) -> None:
    other = tmp_path / "elsewhere" / "alike.xodr"
    other.parent.mkdir()
    other.write_text(road(3))
    import_map(other, None, home_folder())
    path = written(tmp_path / "in", "alike.xodr")
    (path.parent / "alike.xodr").write_text(road(2))
    towns = {read_openscenario(path).scenario.town for _ in range(2)}
    assert len(towns) == 1
    (town,) = towns
    assert town.startswith("alike-")
    assert load_town(town).lane_count == 2
    assert load_town("alike").lane_count == 3
    (path.parent / "alike.xodr").write_text(road(3))
    assert read_openscenario(path).scenario.town == "alike"


def test_a_missing_map_is_named_with_its_line(tmp_path: Path) -> None:
    path = written(tmp_path, "nowhere.xodr")
    with pytest.raises(FormatError, match=r"scene\.xosc:4: LogicFile: its map is 'nowhere\.xodr', which is not there"):
        read_openscenario(path)
    done = ssad("import", "openscenario", written(tmp_path, "ProvingGround.xodr"), tmp_path / "out.yaml")
    assert "the map 'ProvingGround.xodr' is not there: the town 'ProvingGround' stands in for it" in " ".join(
        done.stdout.split()
    )
