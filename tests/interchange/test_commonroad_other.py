"""CommonRoad protobuf and XML 2018b, through commonroad-io.

Most need its environment: `python -m benchmarks.extras commonroad`.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad

from ssad.core.errors import FormatError
from ssad.interchange.commonroad_reader import read_commonroad
from ssad.interchange.export import export_commonroad
from ssad.scenarios.dynamic import load_scenarios, read_scenarios
from tests.interchange.test_commonroad import FOREIGN

installed = pytest.mark.skipif(
    importlib.util.find_spec("commonroad") is None, reason="the extra 'commonroad' is not installed"
)
absent = pytest.mark.skipif(
    importlib.util.find_spec("commonroad") is not None, reason="the extra 'commonroad' is installed"
)
# a file's information with version and identifier, and nothing else
HEAD = b"\n\x0c\n\n2020a\x12\x01x\x12\x02\x08\x01"


def older(text: str) -> str:
    """Return a file as version 2018b has it: obstacles with roles, tags as an attribute, speed limits at lanelets."""
    text = text.replace('commonRoadVersion="2020a"', 'commonRoadVersion="2018b" tags="highway"')
    for role in ("static", "dynamic"):
        text = re.sub(rf'<{role}Obstacle id="(\d+)">', rf'<obstacle id="\1"><role>{role}</role>', text)
        text = text.replace(f"</{role}Obstacle>", "</obstacle>")
    for element in ("location", "scenarioTags", 'trafficSign id="9"'):
        text = re.sub(rf"(?s)<{element}>.*?</{element.split()[0]}>", "", text)
    limit = "<speedLimit>25</speedLimit>"
    return text.replace('<laneletType>highway</laneletType><trafficSignRef ref="9"/>', limit)


@absent
@pytest.mark.parametrize(("name", "form"), [("a.pb", "CommonRoad protobuf"), ("a.xml", "CommonRoad XML 2018b")])
def test_without_commonroad_io_it_is_said_what_to_install(name: str, form: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(HEAD if name == "a.pb" else older(FOREIGN).encode())
    done = ssad("import", "commonroad", tmp_path / name, tmp_path / "out.yaml")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert f"{name}: {form} needs the extra commonroad" in done.stderr
    assert "--extra commonroad" in done.stderr


def test_protobuf_is_told_from_xml_by_its_content(tmp_path: Path) -> None:
    (tmp_path / "a.pb").write_text(FOREIGN)
    assert read_commonroad(tmp_path / "a.pb").scenario.name == "USA_Test-1_1_T-1"


@installed
@pytest.mark.filterwarnings("ignore")
def test_protobuf_is_the_same_scenario(tmp_path: Path) -> None:
    """What commonroad-io writes as protobuf of an exported file comes back as the scenario of that file."""
    from commonroad.common.file_reader import CommonRoadFileReader
    from commonroad.common.file_writer import CommonRoadFileWriter
    from commonroad.common.util import FileFormat
    from commonroad.common.writer.file_writer_interface import OverwriteExistingFile

    (file, *_), _ = export_commonroad(load_scenarios("CrossingNegotiation/00"), tmp_path / "out", system="autopilot")
    content, problems = CommonRoadFileReader(str(file)).open()
    writer = CommonRoadFileWriter(
        content, problems, "", "", content.source, set(), file_format=FileFormat.PROTOBUF, decimal_precision=9
    )
    writer.write_to_file(str(tmp_path / "a.pb"), OverwriteExistingFile.ALWAYS)
    done = ssad("import", "commonroad", tmp_path / "a.pb", tmp_path / "a.yaml")
    assert done.returncode == 0, done.stderr
    (found,) = read_scenarios(tmp_path / "a.yaml")
    expected = read_commonroad(file).scenario
    assert found.town == expected.town == "ProvingGround"
    assert len(found.actors) == len(expected.actors)
    for actor, original in zip(found.actors, expected.actors, strict=True):
        assert np.array(actor.trajectory) == pytest.approx(np.array(original.trajectory), abs=1e-3)
    ends = [(pose.x, pose.y) for pose in found.route]
    assert np.array(ends) == pytest.approx(np.array([(pose.x, pose.y) for pose in expected.route]), abs=1e-2)


@installed
@pytest.mark.filterwarnings("ignore")
def test_the_version_of_2018_is_the_same_scenario(tmp_path: Path) -> None:
    (tmp_path / "new.xml").write_text(FOREIGN)
    (tmp_path / "old.xml").write_text(older(FOREIGN))
    new = read_commonroad(tmp_path / "new.xml", town="new")
    old = read_commonroad(tmp_path / "old.xml", town="old")
    assert old.scenario.name == new.scenario.name
    assert [actor.model for actor in old.scenario.actors] == [actor.model for actor in new.scenario.actors]
    assert [actor.trajectory for actor in old.scenario.actors] == [actor.trajectory for actor in new.scenario.actors]
    assert old.scenario.route == new.scenario.route
    assert old.graph.xy == pytest.approx(new.graph.xy)
    assert old.graph.speed_limit.tolist() == new.graph.speed_limit.tolist() == [25.0, 25.0]


@installed
@pytest.mark.filterwarnings("ignore")
def test_broken_protobuf_is_refused_in_one_line(tmp_path: Path) -> None:
    noise = b"\x0a" + bytes(range(1, 200))
    for name, content, message in (("cut", HEAD, "timeStepSize is 0 s"), ("noise", noise, "commonroad-io cannot read")):
        (tmp_path / f"{name}.pb").write_bytes(content)
        with pytest.raises(FormatError, match=rf"{name}\.pb: .*{message}") as error:
            read_commonroad(tmp_path / f"{name}.pb")
        assert "\n" not in str(error.value)
