"""Does every reader refuse a broken file in one line? Mutations of valid files, each read by the reader of its format.

    uv run python benchmarks/fuzz_readers.py                          # all readers, 2,000 mutations each
    uv run python benchmarks/fuzz_readers.py --reader suite --count 200
    uv run python benchmarks/fuzz_readers.py --reader suite --index 17    # one mutation again, with its traceback

A reader may return, or raise an SSADError of one line. Every other error counts, and so does a read that takes more
than 10 s of the processor or 2 GiB. A mutation depends only on the seed, the name of the reader and its index, so each
can be repeated.
Bytes are mutated (bits, cuts, insertions, repetitions), and so are the tokens of texts, the values of JSON and YAML,
elements and attributes of XML, arrays of npz files, headers of safetensors, members of zip files and nodes of ONNX
graphs. Readers whose package is not installed are left out, with a line. Scenic programs have no entry: they are Python
code, which runs.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import importlib.util
import io
import json
import multiprocessing
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ssad.core.errors import SSADError
from ssad.core.import_report import ImportReport

ROOT = Path(__file__).resolve().parents[1]
SECONDS, MEMORY_BYTES = 10.0, 2 << 30
HUGE_NUMBER = "9" * 400
NUMBERS = ("0", "-1", "1", "0.5", "1e308", "-1e308", "1e999", "NaN", "Infinity", HUGE_NUMBER, "2147483648", "1e-320")
WORDS = ("null", '""', '"text"', "[]", "{}", "true", "../x", "/", "\\u0000", "~", "0x" + "f" * 100_000, "-", "é", "|")
VALUES: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    0.5,
    10**400,
    2**63,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "text",
    "../x",
    "/etc/hostname",
    "a\0b",
    "\ud800",
    "x" * 10_000,
    [],
    {},
    [[]],
    {"a": {}},
    [None],
    [0, 0],
    ["a", 1],
)
Change = Callable[[random.Random, bytes], bytes]


@dataclass(frozen=True)
class Reader:
    """A reader of one format.

    Attributes:
        make: Writes valid files into an empty folder and returns those that are mutated, by path.
        read: Reads the files of the folder.
        is_single: Whether each file stands alone, so that the others need not be read again.
        package: Package without which the reader refuses every file.
    """

    make: Callable[[Path], Sequence[Path]]
    read: Callable[[Path], object]
    is_single: bool = False
    package: str = ""

    @property
    def is_available(self) -> bool:
        """Return whether its package is installed."""
        return not self.package or importlib.util.find_spec(self.package) is not None


@dataclass
class Tally:
    """Outcomes of the mutations of a reader.

    Attributes:
        returned: Number that were read.
        refused: Number that were refused in one line.
        failures: Index of a mutation -> what went wrong, in words.
        slowest: Seconds of the slowest read.
    """

    returned: int = 0
    refused: int = 0
    failures: dict[int, str] = field(default_factory=dict)
    slowest: float = 0.0


# ---------------------------------------------------------------- mutations


def change_bytes(draw: random.Random, content: bytes) -> bytes:
    """Return the content with one to four changes of bytes."""
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 4))):
        start = draw.randrange(len(data) + 1)
        length = draw.choice((1, 1, 2, 4, 16, 256))
        action = draw.randrange(6)
        if action == 0 and start < len(data):
            data[start] ^= 1 << draw.randrange(8)
        elif action == 1:
            data[start : start + length] = draw.randbytes(length)
        elif action == 2:
            del data[start : start + length]
        elif action == 3:
            data[start:start] = draw.randbytes(length)
        elif action == 4:
            data[start:start] = data[start : start + length] * draw.choice((1, 2, 100))
        else:
            del data[start:]
    return bytes(data)


def change_tokens(draw: random.Random, content: bytes) -> bytes:
    """Return a text with one to three numbers, words or lines replaced, removed, repeated or nested."""
    text = content.decode(errors="replace")
    for _ in range(draw.choice((1, 1, 2, 3))):
        action = draw.randrange(6)
        if action < 3:
            tokens = list(re.finditer((r"-?\d+(?:\.\d+)?(?:e-?\d+)?", r"[A-Za-z_]\w*", r"[^\w\s]")[action], text))
            if tokens:
                start, end = draw.choice(tokens).span()
                words = [token[0] for token in tokens[:200]]
                text = text[:start] + draw.choice((*NUMBERS, *WORDS, *words, *words)) + text[end:]
            continue
        lines = text.splitlines(keepends=True) or [""]
        index = draw.randrange(len(lines))
        if action == 3:
            del lines[index]
        elif action == 4:
            lines.insert(draw.randrange(len(lines)), lines[index])
        else:
            opening, closing = draw.choice((("[", "]"), ("{a: ", "}"), ('{"a": ', "}"), ("<a>", "</a>"), ("- ", "")))
            depth = draw.choice((30, 70, 1000, 200_000))
            lines[index] = opening * depth + draw.choice((lines[index].strip(), "")) + closing * depth
        text = "".join(lines)
    return text.encode(errors="replace")


def change_json(draw: random.Random, content: bytes) -> bytes:
    """Return a JSON text, or JSON lines, with one or two values replaced, removed or moved."""
    lines = content.decode().splitlines() if content.count(b"\n") > 1 and content[:1] == b"{" else [content.decode()]
    try:
        documents = [json.loads(line) for line in lines]
    except ValueError:
        lines = [content.decode()]
        documents = [json.loads(content)]
    index = draw.randrange(len(documents))
    documents[index] = change_value(draw, documents[index])
    with contextlib.suppress(RecursionError):
        lines[index] = json.dumps(documents[index])
    return ("\n".join(lines) + "\n" * (len(lines) > 1)).encode()


def change_yaml(draw: random.Random, content: bytes) -> bytes:
    """Return a YAML text with one or two values replaced, removed or moved."""
    import yaml

    return bytes(yaml.safe_dump(change_value(draw, yaml.safe_load(content)), sort_keys=False).encode(errors="replace"))


def change_value(draw: random.Random, value: Any) -> Any:
    """Return plain data with one or two of its values replaced, removed or moved."""
    holder = {"": copy.deepcopy(value)}
    for _ in range(draw.choice((1, 1, 2))):
        places = list(_places(holder))
        parent, key = draw.choice(places)
        action = draw.randrange(5)
        if action == 0 and parent is not holder:
            del parent[key]
        elif action == 1:
            other_parent, other_key = draw.choice(places)
            parent[key] = copy.deepcopy(other_parent[other_key])
        elif action == 2 and isinstance(parent, list):
            parent.insert(key, copy.deepcopy(parent[key]))
        elif action == 3 and isinstance(parent[key], int | float):
            parent[key] = draw.choice((-parent[key], parent[key] * 1e6, parent[key] + 1, int(parent[key]), 10**400))
        else:
            parent[key] = copy.deepcopy(draw.choice(VALUES))
    return holder[""]


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield container and key of all values."""
    pairs = list(value.items()) if isinstance(value, dict) else list(enumerate(value))
    for key, element in pairs:
        yield value, key
        if isinstance(element, dict | list):
            yield from _places(element)


def change_xml(draw: random.Random, content: bytes) -> bytes:
    """Return an XML text with one to three attributes or elements replaced, removed, repeated or moved."""
    root = ElementTree.fromstring(content)
    for _ in range(draw.choice((1, 1, 2, 3))):
        elements = list(root.iter())
        element = draw.choice(elements)
        action = draw.randrange(6)
        if action < 3 and element.attrib:
            name = draw.choice(list(element.attrib))
            if action == 0:
                del element.attrib[name]
            else:
                others = [other.attrib[name] for other in elements if name in other.attrib]
                element.attrib[name] = draw.choice((*NUMBERS, "", "text", "../x", "x" * 10_000, *others))
        elif action == 3 and len(element):
            element.remove(draw.choice(list(element)))
        elif action == 4 and len(element):
            element.append(copy.deepcopy(draw.choice(list(element))))
        elif action == 5:
            element.text = draw.choice((*NUMBERS, "", "text"))
        elif len(element):
            draw.choice(elements).append(copy.deepcopy(draw.choice(list(element))))
    return bytes(ElementTree.tostring(root))


def change_npz(draw: random.Random, content: bytes) -> bytes:
    """Return an npz file with one or two arrays of other values, shape or type, or without one of them."""
    with np.load(io.BytesIO(content)) as archive:
        arrays = dict(archive)
    for _ in range(draw.choice((1, 1, 2))):
        name = draw.choice(list(arrays))
        array = np.array(arrays[name])
        action = draw.randrange(7)
        if action == 0 and len(arrays) > 1:
            del arrays[name]
        elif action == 1:
            arrays[name] = array.astype(draw.choice(("f4", "f8", "i4", "u1", "i8", "?", "c8", "U3", "M8[s]")))
        elif action == 2:
            arrays[name] = draw.choice(
                (array.reshape(-1), array[..., None], array[:0], array[:-1]) if array.ndim else (array[None],)
            )
        elif action == 3:
            arrays[name] = np.concatenate([array, array]) if array.ndim else array[None]
        elif action == 4:
            arrays[draw.choice(list(arrays))] = array
        elif array.size and array.dtype.kind in "fiu":
            low, high = (
                (-1e300, 1e300) if array.dtype.kind == "f" else (np.iinfo(array.dtype).min, np.iinfo(array.dtype).max)
            )
            values = (0, 1, low, high) + ((np.nan, np.inf) if array.dtype.kind == "f" else ())
            with np.errstate(over="ignore"):
                array.reshape(-1)[draw.randrange(array.size)] = draw.choice(values)
            arrays[name] = array
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def change_safetensors(draw: random.Random, content: bytes) -> bytes:
    """Return a safetensors file with another header."""
    size = int.from_bytes(content[:8], "little")
    try:
        header = json.dumps(change_value(draw, json.loads(content[8 : 8 + size]))).encode()
    except ValueError:
        return change_bytes(draw, content)
    length = draw.choice((len(header), len(header), len(header), 0, 2**63, len(header) + 1))
    return length.to_bytes(8, "little") + header + content[8 + size :]


def change_zip(draw: random.Random, content: bytes) -> bytes:
    """Return a zip file with one member changed, removed or repeated."""
    buffer = io.BytesIO()
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return change_bytes(draw, content)
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(buffer, "w") as output:
        names = archive.namelist()
        changed_name, action = draw.choice(names), draw.randrange(5)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for name in names:
                member = archive.read(name)
                if name == changed_name and action == 0:
                    continue
                output.writestr(name, change_bytes(draw, member) if name == changed_name and action > 1 else member)
                if name == changed_name and action == 1:
                    output.writestr(name, member[::-1])
    return buffer.getvalue()


def change_onnx(draw: random.Random, content: bytes) -> bytes:
    """Return an ONNX file with one or two nodes, attributes, weights or shapes replaced or removed."""
    import onnx

    model = onnx.load_model_from_string(content)
    graph = model.graph
    for _ in range(draw.choice((1, 1, 2))):
        node, weights = draw.choice(graph.node), draw.choice(graph.initializer)
        action = draw.randrange(9)
        if action == 0:
            node.op_type = draw.choice(("", "Loop", "Resize", "NonMaxSuppression", "a" * 500, *OPERATORS))
        elif action == 1:
            graph.node.remove(node)
        elif action == 2 and node.input:
            node.input[draw.randrange(len(node.input))] = draw.choice(
                ("", "none", *(one.output[0] for one in graph.node))
            )
        elif action == 3 and node.attribute:
            attribute = draw.choice(node.attribute)
            attribute.ints[:] = [draw.choice((-1, 0, 1, 2, 7, 2**31, 2**62)) for _ in range(draw.randrange(5))]
        elif action == 4:
            weights.dims[:] = [draw.choice((-1, 0, 1, 3, 7, 2**31, 2**62)) for _ in range(draw.randrange(6))]
        elif action == 5:
            weights.raw_data = change_bytes(draw, weights.raw_data)
        elif action == 6:
            weights.data_type = draw.randrange(25)
        elif action == 7:
            shape = draw.choice((graph.input[0], graph.output[0])).type.tensor_type.shape
            if shape.dim:
                draw.choice(shape.dim).dim_value = draw.choice((-1, 0, 1, 3, 64, 2**31, 2**62))
        else:
            model.opset_import[0].version = draw.choice((-1, 0, 1, 7, 13, 30, 2**40))
    return bytes(model.SerializeToString())


OPERATORS = ("Add", "Cast", "Concat", "Conv", "Gather", "Reshape", "Sigmoid", "Slice", "Split", "Transpose")
CHANGES: dict[str, tuple[Change, ...]] = {
    ".json": (change_json, change_json, change_tokens, change_bytes),
    ".jsonl": (change_json, change_json, change_tokens, change_bytes),
    ".yaml": (change_yaml, change_yaml, change_tokens, change_bytes),
    ".xml": (change_xml, change_xml, change_tokens, change_bytes),
    ".xodr": (change_xml, change_xml, change_tokens, change_bytes),
    ".osm": (change_xml, change_xml, change_tokens, change_bytes),
    ".xosc": (change_xml, change_xml, change_tokens, change_bytes),
    ".npz": (change_npz, change_npz, change_zip, change_bytes),
    ".safetensors": (change_safetensors, change_bytes),
    ".onnx": (change_onnx, change_onnx, change_bytes),
    ".pth": (change_zip, change_bytes),
    ".obj": (change_tokens, change_bytes),
    ".mtl": (change_tokens, change_bytes),
    ".gltf": (change_json, change_tokens),
    ".txt": (change_tokens, change_bytes),
}
"""Changes by the suffix of a file; others change in their bytes alone."""


def mutate(draw: random.Random, path: Path, content: bytes) -> bytes:
    """Return the content of a file after one mutation of its format."""
    change = draw.choice(CHANGES.get(path.suffix, (change_bytes,)))
    try:
        return change(draw, content)
    except (ArithmeticError, TypeError, ValueError, RecursionError):  # a combination that the format cannot express
        return change_bytes(draw, content)


# ---------------------------------------------------------------- readers


MAP = """<OpenDRIVE><header revMajor="1" revMinor="6"><geoReference>+proj=tmerc +lat_0=0 +lon_0=0</geoReference>
<offset x="5" y="5" z="0" hdg="0"/></header>
<road id="1" length="100" junction="-1" rule="RHT"><link><successor elementType="road" elementId="2"
contactPoint="start"/></link><type s="0" type="town"><speed max="50" unit="km/h"/></type><planView>
<geometry s="0" x="0" y="0" hdg="0" length="40"><line/></geometry>
<geometry s="40" x="40" y="0" hdg="0" length="20"><spiral curvStart="0" curvEnd="0.01"/></geometry>
<geometry s="60" x="60" y="0.7" hdg="0.1" length="40"><arc curvature="0.01"/></geometry></planView>
<elevationProfile><elevation s="0" a="0" b="0.01" c="0" d="0"/></elevationProfile>
<lateralProfile><superelevation s="0" a="0" b="0.001" c="0" d="0"/></lateralProfile>
<lanes><laneOffset s="0" a="0" b="0" c="0" d="0"/><laneSection s="0"><left><lane id="1" type="driving"><width
sOffset="0"
a="3.5" b="0" c="0" d="0"/></lane></left><center><lane id="0" type="none"><roadMark sOffset="0" type="broken"
color="white"/></lane></center><right><lane id="-1" type="driving"><link><successor id="-1"/></link><width sOffset="0"
a="3.5" b="0" c="0" d="0"/><speed sOffset="0" max="13.9"/></lane><lane id="-2" type="sidewalk"><border
sOffset="0" a="-5"
b="0" c="0" d="0"/></lane></right></laneSection></lanes><objects><object id="7" type="crosswalk" s="50" t="0" hdg="0"
length="4" width="7"><outline><cornerLocal u="-2" v="-3"/><cornerLocal u="2" v="-3"/><cornerLocal u="2"
v="3"/></outline>
</object></objects><signals><signal id="9" s="95" t="-4" type="1000001" subtype="-1" country="OpenDRIVE" dynamic="yes"
orientation="+"><validity fromLane="-1" toLane="-1"/></signal><signal id="10" s="10" t="-4" type="274" subtype="-1"
country="DE" value="30" unit="km/h" dynamic="no" orientation="+"/></signals></road>
<road id="2" length="60" junction="-1"><link><predecessor elementType="road" elementId="1" contactPoint="end"/></link>
<planView><geometry s="0" x="98" y="8" hdg="0.5" length="30"><paramPoly3 pRange="arcLength" aU="0" bU="1"
cU="0" dU="0"
aV="0" bV="0" cV="0.001" dV="0"/></geometry><geometry s="30" x="124" y="23" hdg="0.5" length="30"><poly3 a="0" b="0"
c="0.001" d="0"/></geometry></planView><lanes><laneSection s="0"><center><lane id="0" type="none"/></center><right>
<lane id="-1" type="driving"><link><predecessor id="-1"/></link><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
</right></laneSection></lanes></road>
<junction id="5" name="a"><connection id="0" incomingRoad="1" connectingRoad="2"
contactPoint="start"><laneLink from="-1"
to="-1"/></connection></junction><controller id="3"><control signalId="9" type="0"/></controller></OpenDRIVE>"""


def _map(folder: Path) -> Sequence[Path]:
    (folder / "map.xodr").write_text(MAP)
    return [folder / "map.xodr"]


def _read_map(folder: Path) -> object:
    from ssad.world.roads.bake import import_map

    return import_map(folder / "map.xodr", "a", folder.with_name("home"))


def _lanelet_map(folder: Path) -> Sequence[Path]:
    from helpers.lanelet_maps import MapWriter, crossing_map

    crossing = crossing_map()
    post = crossing.way([(0.0, 70.0), (0.0, 71.0)], type="traffic_sign", subtype="de274-60")
    limit = crossing.rule("speed_limit", [("refers", post)])
    crossing.lanelet([(-6.0, 10.0), (-6.0, 60.0)], [(-2.0, 10.0), (-2.0, 60.0)], limit, region="de", one_way="yes")
    crossing.lanelet([(-9.0, 30.0), (9.0, 30.0)], [(-9.0, 27.0), (9.0, 27.0)], subtype="crosswalk")
    degrees = MapWriter(local=False)
    degrees.lanelet([(8.4, 49.00002), (8.401, 49.00002)], [(8.4, 49.0), (8.401, 49.0)], speed_limit="30 km/h")
    return [crossing.write(folder / "crossing.osm"), degrees.write(folder / "degrees.osm")]


def _read_lanelet_maps(folder: Path) -> object:
    from ssad.world.roads import import_map

    for path in folder.glob("*.osm"):
        import_map(path, "a", folder.with_name("home"))
    return None


def _scenarios() -> Sequence[Any]:
    from ssad.scenarios.dynamic import load_scenarios

    return [*load_scenarios("RightTurn/00"), *load_scenarios("StraightObstacle/01")]


def _scenario_file(folder: Path) -> Sequence[Path]:
    from ssad.scenarios.dynamic import save_scenarios

    save_scenarios(folder / "a.yaml", _scenarios())
    return [folder / "a.yaml"]


def _read_scenario_file(folder: Path) -> object:
    from ssad.scenarios.dynamic.yamlio import read_scenarios

    return read_scenarios(folder / "a.yaml")


def _openscenario(folder: Path) -> Sequence[Path]:
    from ssad.interchange.export import export_openscenario

    export_openscenario(_scenarios()[:1], folder)
    return list(folder.glob("*.xosc"))


def _read_openscenario(folder: Path) -> object:
    from ssad.interchange.openscenario_reader import read_openscenario

    return [read_openscenario(path) for path in folder.glob("*.xosc")]


def _commonroad(folder: Path) -> Sequence[Path]:
    def bound(tag: str, y: float) -> str:
        return f"<{tag}>" + "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x in (0, 50, 100, 200)) + f"</{tag}>"

    def state(tag: str, time_step: int, x: float) -> str:
        place = f"<position><point><x>{x}</x><y>1.75</y></point></position>"
        angle, speed = (
            f"<{name}><exact>{value}</exact></{name}>" for name, value in (("orientation", 0), ("velocity", 8))
        )
        return f"<{tag}>{place}{angle}<time><exact>{time_step}</exact></time>{speed}</{tag}>"

    (folder / "a.xml").write_text(
        '<commonRoad benchmarkID="a" commonRoadVersion="2020a" timeStepSize="0.1" author="" affiliation="" source="" '
        'date="2020-01-01"><location><geoNameId>1</geoNameId><gpsLatitude>0</gpsLatitude><gpsLongitude>0</gpsLongitude>'
        f'</location><lanelet id="1">{bound("leftBound", 3.5)}{bound("rightBound", 0)}<laneletType>urban</laneletType>'
        "</lanelet>"
        '<dynamicObstacle id="2"><type>car</type><shape><rectangle><length>4.5</length><width>1.8</width></rectangle>'
        f"</shape>{state('initialState', 0, 40)}<trajectory>{state('state', 1, 41)}{state('state', 2, 42)}</trajectory>"
        "</dynamicObstacle>"
        '<staticObstacle id="3"><type>parkedVehicle</type><shape><rectangle><length>4.5</length><width>1.8</width>'
        f"</rectangle></shape>{state('initialState', 0, 150)}</staticObstacle>"
        f'<planningProblem id="4">{state("initialState", 0, 10)}<goalState><position><rectangle><length>10</length>'
        "<width>3</width><center><x>120</x><y>1.75</y></center></rectangle></position><time><intervalStart>10"
        "</intervalStart><intervalEnd>200</intervalEnd></time></goalState></planningProblem></commonRoad>"
    )
    return [folder / "a.xml"]


def _read_commonroad(folder: Path) -> object:
    from ssad.interchange.commonroad_reader import read_commonroad

    return [read_commonroad(path) for path in folder.glob("*.xml")]


def _leaderboard(folder: Path) -> Sequence[Path]:
    from ssad.interchange.leaderboard import export_leaderboard

    export_leaderboard(_scenarios(), folder)
    return [folder / "routes.xml"]


def _read_leaderboard(folder: Path) -> object:
    from ssad.interchange.leaderboard import read_leaderboard

    return read_leaderboard(folder / "routes.xml")


def _routes(folder: Path) -> Sequence[Path]:
    from ssad.interchange.leaderboard import export_leaderboard1

    export_leaderboard1(_scenarios(), folder)
    return [path for path in folder.rglob("*") if path.suffix in (".xml", ".json")]


def _read_routes(folder: Path) -> object:
    from ssad.scenarios.dynamic import import_routes

    return import_routes(folder, report=ImportReport(str(folder)))


def _suite(folder: Path) -> Sequence[Path]:
    shutil.copy(ROOT / "suites" / "precrash.yaml", folder / "a.yaml")
    return [folder / "a.yaml"]


def _read_suite(folder: Path) -> object:
    from ssad.experiments.suites import load_suite

    return load_suite(str(folder / "a.yaml"))


def _run(folder: Path, *, is_sealed: bool = True) -> Sequence[Path]:
    from helpers.run_folder import DRIVING_HEADER, driving_line, write_run

    from ssad.core.seals import unsealed

    lines = [
        driving_line(f"{system}{group}", group, f"{group}/0", system=system, collision=system == "b", time=9.0)
        for system in ("a", "b")
        for group in ("RightTurn", "LaneChanging", "Town02")
    ]
    lines.append(driving_line("lost", "RightTurn", "RightTurn/0", status="timeout"))
    episodes = [{"key": line["key"], "raw": 1.5} for line in lines[:3]]
    write_run(folder, DRIVING_HEADER, lines, episodes)
    if not is_sealed:
        header = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps({key: value for key, value in header.items() if key != "sealed"}))
        for name in ("results.jsonl", "episodes.jsonl"):
            records = [unsealed(json.loads(line)) for line in (folder / name).read_text().splitlines()]
            (folder / name).write_text("".join(json.dumps(record) + "\n" for record in records))
        (folder / "seal.json").unlink()
    return sorted(folder.glob("*.json*"))


def _unsealed_run(folder: Path) -> Sequence[Path]:
    return _run(folder, is_sealed=False)


def _read_run(folder: Path) -> object:
    from ssad.report.load import load_run

    return load_run(folder)


def _read_report(folder: Path) -> object:
    from ssad.experiments.runs import report_markdown, summary, write_report
    from ssad.report import check_artefacts

    return write_report(folder), check_artefacts(folder), summary(folder), report_markdown([folder])


def _two_runs(folder: Path) -> Sequence[Path]:
    paths = _unsealed_run(folder / "first")
    _run(folder / "second")
    return paths


def _read_comparison(folder: Path) -> object:
    from ssad.report.compare import write_comparison

    return write_comparison([folder / "first", folder / "second"], folder / "out", [])


def _drive(folder: Path) -> Sequence[Path]:
    return _nuscenes(folder, samples=6)


def _read_drive(folder: Path) -> object:
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.interchange.drive_log import scenario_of_drive

    with NuScenes(folder) as data:
        return scenario_of_drive(data, data.scenes()[0].name if data.scenes() else "none", town="a")


def _trace(folder: Path) -> Sequence[Path]:
    from helpers.metric_traces import make_trace

    from ssad.core.traces import save_trace

    save_trace(folder / "a.npz", make_trace(5))
    return [folder / "a.npz"]


def _read_trace(folder: Path) -> object:
    from ssad.core.traces import load_trace, trace_hash

    return trace_hash(load_trace(folder / "a.npz"))


def _graph(folder: Path) -> Sequence[Path]:
    from ssad.core.lane_graph import save_graph
    from ssad.world.roads import load_town

    save_graph(load_town("ProvingGround"), folder / "a.npz")
    return [folder / "a.npz"]


def _read_graph(folder: Path) -> object:
    from ssad.core.lane_graph import load_graph

    return load_graph(folder / "a.npz")


def _policy(folder: Path) -> Sequence[Path]:
    import ssad

    for suffix in (".safetensors", ".json"):
        path = next(Path(ssad.__file__).parent.rglob(f"ppo{suffix}"))
        shutil.copy(path, folder / f"ppo{suffix}")
    return sorted(folder.iterdir())


def _read_policy(folder: Path) -> object:
    from ssad.world.policy import load_policy

    return load_policy(folder / "ppo.safetensors")


def _checkpoint(folder: Path) -> Sequence[Path]:
    import torch

    state = {"epoch": 3, "state_dict": {"a.weight": torch.arange(12.0).reshape(3, 4), "a.bias": torch.zeros(3)}}
    torch.save(state, folder / "a.pth")
    torch.save(state, folder / "b.pth", _use_new_zipfile_serialization=False)
    return [folder / "a.pth", folder / "b.pth"]


def _read_checkpoint(folder: Path) -> object:
    from ssad.core.checkpoints import load_weights

    return [load_weights(path) for path in sorted(folder.glob("*.pth"))]


def _nuscenes(folder: Path, *, samples: int = 2) -> Sequence[Path]:
    from helpers.tiny import make_tiny

    make_tiny(folder, scenes=1, samples=samples, size=(64, 36))
    return sorted(folder.glob("v1.0-*/*.json"))


def _read_nuscenes(folder: Path) -> object:
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.datasets.nuscenes.truth import read_truth

    with NuScenes(folder) as data:
        scenes = [data.scene(record.name) for record in data.scenes()]
        return scenes, read_truth(folder, data.version)


def _results(folder: Path) -> Sequence[Path]:
    boxes = {"translation": [1.0, 2.0, 0.5], "size": [2.0, 4.0, 1.5], "rotation": [1.0, 0.0, 0.0, 0.0]}
    boxes |= {"velocity": [1.0, 0.0], "detection_name": "car", "detection_score": 0.5}
    rows = [{"sample_token": "a", "attribute_name": "vehicle.moving", **boxes}] * 2
    use = dict.fromkeys(("use_camera", "use_lidar", "use_radar", "use_map", "use_external"), False)
    (folder / "a.json").write_text(json.dumps({"meta": use, "results": {"a": rows, "b": []}}))
    return [folder / "a.json"]


def _read_results(folder: Path) -> object:
    from ssad.datasets.nuscenes.results import read_results

    return read_results(folder / "a.json")


def _coco(folder: Path) -> Sequence[Path]:
    annotation = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [10.0, 10.0, 20.0, 20.0], "area": 400.0}
    content = {
        "info": {},
        "images": [{"id": 1, "file_name": "a.jpg", "width": 64, "height": 48}],
        "annotations": [annotation | {"iscrowd": 0, "segmentation": []}, annotation | {"id": 2, "iscrowd": 1}],
        "categories": [{"id": 1, "name": "car", "supercategory": "road"}],
    }
    (folder / "a.json").write_text(json.dumps(content, indent=1))
    return [folder / "a.json"]


def _read_coco(folder: Path) -> object:
    from ssad.datasets.coco import read_coco

    return read_coco(folder / "a.json")


def _points(folder: Path) -> Sequence[Path]:
    values = np.random.default_rng(0).uniform(size=(20, 5)).astype("<f4")
    rows = "".join(f"{x:.3f} {y:.3f} {z:.3f} {intensity:.3f}\n" for x, y, z, intensity in values[:, :4])
    pcd = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    pcd += "WIDTH 20\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 20\nDATA "
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    ply, packed = "ply\nformat ascii 1.0\nelement vertex 20\n", np.ascontiguousarray(values[:, :4]).tobytes()
    # LZF with literal runs alone, of at most 32 bytes, of the columns one after another
    columns = np.ascontiguousarray(values[:, :4].T).tobytes()
    runs = [columns[start : start + 32] for start in range(0, len(columns), 32)]
    lzf = b"".join(bytes([len(run) - 1]) + run for run in runs)
    sizes = b"".join(len(part).to_bytes(4, "little") for part in (lzf, columns))
    contents = {
        "a.bin": values.tobytes(),
        "ascii.pcd": f"{pcd}ascii\n{rows}".encode(),
        "binary.pcd": f"{pcd}binary\n".encode() + packed,
        "packed.pcd": f"{pcd}binary_compressed\n".encode() + sizes + lzf,
        "ascii.ply": f"{ply}{properties}end_header\n{rows}".encode(),
        "binary.ply": f"ply\nformat binary_little_endian 1.0\nelement vertex 20\n{properties}end_header\n".encode()
        + packed,
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return sorted(folder.iterdir())


def _read_points(folder: Path) -> object:
    from ssad.datasets.point_files import encode_points_like, read_point_file

    def write_anew(path: Path) -> bytes:
        point_file = read_point_file(path)
        return encode_points_like(point_file, point_file.points)

    return _read_each(folder, write_anew)


def _read_each(folder: Path, *readers: Callable[[Path], object]) -> object:
    """Read all files of a folder by themselves. SSADError if one is refused, after all were read."""
    error: SSADError | None = None
    for path in sorted(folder.iterdir()):
        for read in readers:
            try:
                read(path)
            except SSADError as refusal:
                error = refusal
    if error is not None:
        raise error
    return None


def _images(folder: Path) -> Sequence[Path]:
    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    for name in ("a.jpg", "b.png", "c.webp", "d.bmp", "e.tif", "f.ppm"):
        Image.fromarray(pixels).save(folder / name)
    exif = Image.Exif()
    exif[0x0112] = 6  # turned
    Image.fromarray(pixels).save(folder / "g.jpg", exif=exif, progressive=True)
    Image.fromarray(pixels).convert("CMYK").save(folder / "h.jpg")
    Image.fromarray(pixels[..., 0].astype(np.uint16) * 257).save(folder / "i.png")
    Image.fromarray(pixels).convert("P").save(folder / "j.png")
    return sorted(folder.iterdir())


def _read_images(folder: Path) -> object:
    from ssad.core.image_files import encode_like, read_image_file
    from ssad.detectors.images import as_images

    def write_anew(path: Path) -> bytes:
        image_file = read_image_file(path)
        return encode_like(image_file, image_file.rgb)

    return _read_each(folder, write_anew, as_images)


def _mesh(folder: Path) -> Sequence[Path]:
    from ssad.rendering.meshes.mesh import Material, box
    from ssad.rendering.meshes.obj_writer import write_obj

    write_obj(folder / "a.obj", box((1.0, 2.0, 3.0), material=Material("paint", (0.5, 0.5, 0.5))))
    return [folder / "a.obj", folder / "a.mtl"]


def _read_mesh(folder: Path) -> object:
    from ssad.rendering.meshes.obj import read_obj

    return read_obj(folder / "a.obj")


def _gltf(folder: Path) -> Sequence[Path]:
    import base64

    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    points += np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(points).decode()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [1.0, 0.0, 0.0], "children": [1]}, {"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, 1.0]}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36, "byteOffset": 0},
            {"buffer": 0, "byteLength": 24, "byteOffset": 36},
        ],
        "buffers": [{"byteLength": 60, "uri": uri}],
    }
    (folder / "a.gltf").write_text(json.dumps(content))
    return [folder / "a.gltf"]


def _read_gltf(folder: Path) -> object:
    from ssad.rendering.meshes.gltf import read_gltf

    return read_gltf(folder / "a.gltf")


def _safetensors(folder: Path) -> Sequence[Path]:
    import torch

    from ssad.core.checkpoints import WeightsCard, save_weights

    state = {"a.weight": torch.arange(12.0).reshape(3, 4), "b.weight": torch.ones(4, 2), "b.bias": torch.zeros(3)}
    card = WeightsCard("a", "b", 0, ("car",), {"AP50": 0.5}, {"width": 3}, "")
    save_weights(folder / "whole.safetensors", state, card=card)
    save_weights(folder / "parts.safetensors", state, card=card, shard_mb=1e-4)
    parts = sorted(path.name for path in folder.glob("parts-*.safetensors"))
    weight_map = dict(zip(state, [*parts, *parts], strict=False))
    (folder / "model.index.json").write_text(json.dumps({"metadata": {}, "weight_map": weight_map}))
    return sorted(folder.iterdir())


def _read_safetensors(folder: Path) -> object:
    from ssad.core.checkpoints import load_card, load_weights

    whole, parts = load_card(folder / "whole.json"), load_card(folder / "parts.json")
    return whole, parts, load_weights(folder / "whole.safetensors"), load_weights(folder / "model.index.json")


def _onnx(folder: Path) -> Sequence[Path]:
    """A detector with the output of YOLOv8: boxes and three classes at 126 places of images of 64 x 96."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    generator = np.random.default_rng(0)
    nodes, weights = [], [numpy_helper.from_array(np.array([1, 7, -1], np.int64), "shape")]
    for stride in (8, 16, 32):
        kernel = generator.normal(size=(7, 3, stride, stride)).astype("<f4") / stride
        weights.append(numpy_helper.from_array(kernel, f"kernel{stride}"))
        options = {"kernel_shape": [stride, stride], "strides": [stride, stride]}
        nodes += [
            helper.make_node("Conv", ["images", f"kernel{stride}"], [f"map{stride}"], **options),
            helper.make_node("Sigmoid", [f"map{stride}"], [f"share{stride}"]),
            helper.make_node("Reshape", [f"share{stride}", "shape"], [f"rows{stride}"]),
        ]
    nodes.append(helper.make_node("Concat", ["rows8", "rows16", "rows32"], ["rows"], axis=2))
    weights.append(numpy_helper.from_array(np.array([[[4], [4], [64], [64], [1], [1], [1]]], np.float32), "scale"))
    centres = np.zeros((1, 7, 126), np.float32)
    places = [
        (x * stride, y * stride) for stride in (8, 16, 32) for y in range(64 // stride) for x in range(96 // stride)
    ]
    centres[0, :2] = np.transpose(places)
    weights.append(numpy_helper.from_array(centres, "centres"))
    nodes.append(helper.make_node("Mul", ["rows", "scale"], ["scaled"]))
    nodes.append(helper.make_node("Add", ["scaled", "centres"], ["output"]))
    images, output = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
        for name, shape in (("images", [1, 3, 64, 96]), ("output", [1, 7, 126]))
    )
    graph = helper.make_graph(nodes, "a", [images], [output], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    onnx.save(model, folder / "a.onnx")
    return [folder / "a.onnx"]


def _read_onnx(folder: Path) -> object:
    import torch

    from ssad.detectors.adapters.onnx_detector import onnx_detector

    detector = onnx_detector(folder / "a.onnx", classes=["car", "person", "bus"])
    return detector.predict(torch.zeros(1, 3, 64, 96))


def _darknet(folder: Path) -> Sequence[Path]:
    import torch

    from ssad.detectors import make_detector
    from ssad.detectors.yolo.darknet import convolutions

    torch.manual_seed(0)
    tensors = [tensor for layer in convolutions(make_detector("yolov3-tiny", weights="random"))[:2] for tensor in layer]
    values = b"".join(tensor.detach().numpy().astype("<f4").tobytes() for tensor in tensors)
    (folder / "a.weights").write_bytes(np.array([0, 2, 5], "<i4").tobytes() + np.array([7], "<i8").tobytes() + values)
    return [folder / "a.weights"]


@cache
def _tiny_yolo() -> Any:
    from ssad.detectors import make_detector

    return make_detector("yolov3-tiny", weights="random")


def _read_darknet(folder: Path) -> object:
    from ssad.detectors.yolo.darknet import read_darknet

    return read_darknet(_tiny_yolo(), folder / "a.weights", layers=2)


def _texture(folder: Path) -> Sequence[Path]:
    import torch

    from ssad.rendering.target import parse_target
    from ssad.scenarios.static.physical import make_carrier
    from ssad.scenarios.static.physical.textures.export import PrintedTexture, export_texture

    options = {"width": 0.6, "height": 0.3, "panel": "rear"}
    size = make_carrier("patch", options).on(parse_target("sedan:silver:0").mesh()).size
    texture = PrintedTexture(torch.full((3, *size), 0.25), "patch", options, "sedan:silver:0")
    export_texture(folder, texture, dots=50, name="a")
    return [folder / "texture.json", folder / "texture.npz"]


def _light(folder: Path) -> Sequence[Path]:
    import torch

    from ssad.scenarios.static.physical.lights import make_light
    from ssad.scenarios.static.physical.lights.export import LightSetup, export_light
    from ssad.scenarios.static.physical.lights.light import TargetSize

    ranges = make_light("flashlight", {}).ranges(TargetSize(4.9, 2.06, 1.51))
    values = {name: low + 0.5 * (high - low) for name, (low, high) in ranges.items()}
    target = "sedan:black:0"
    export_light(folder / "flashlight", LightSetup("flashlight", {}, "night", target, values))
    size = make_light("projector", {"lumens": 800.0}).surface(TargetSize(4.9, 2.06, 1.51)).size
    picture = torch.full((3, *size), 0.5)
    export_light(folder / "projector", LightSetup("projector", {"lumens": 800.0}, "night", target, {}, picture))
    return [*folder.glob("*/light.json"), folder / "projector" / "picture.npz"]


def _read_exports(folder: Path) -> object:
    """Read exports of textures and lights, and put them on their target."""
    from ssad.rendering.target import parse_target
    from ssad.scenarios.static.physical.lights.export import load_exported_attack

    edits = []
    for file in (*folder.glob("*/light.json"), *folder.glob("texture.json")):
        attack = load_exported_attack(file.parent)
        edits.append((attack.edit(parse_target(attack.target).mesh()), attack.live(1)))
    return edits


def _shifted(folder: Path) -> Sequence[Path]:
    from ssad.recorders.shifted import Options, write_shifted_roots

    _nuscenes(folder / "clean", samples=2)
    (written,) = write_shifted_roots(Options(folder / "clean", folder / "out", "v1.0-mini", ("fog",), (3,)), workers=0)
    return [written.root / "manifest.json", *sorted((written.root / "manifest").glob("*.json*"))]


def _read_shifted(folder: Path) -> object:
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.recorders.shifted import check_manifest, verify
    from ssad.recorders.shifted.manifest import read_lines
    from ssad.recorders.shifted.scene_writer import read_finished_labels

    root = folder / "out" / "fog-3"
    with NuScenes(root) as data:
        names = [scene.name for scene in data.scenes()]
    lines = [read_lines(root / "manifest" / f"{name}.jsonl") for name in names]
    return lines, [read_finished_labels(root, name) for name in names], verify(root), check_manifest(root, names)


def _older_commonroad(folder: Path) -> Sequence[Path]:
    """Version 2018b of the file of `_commonroad`, and protobuf as commonroad-io writes it."""
    from commonroad.common.file_reader import CommonRoadFileReader
    from commonroad.common.file_writer import CommonRoadFileWriter
    from commonroad.common.util import FileFormat
    from commonroad.common.writer.file_writer_interface import OverwriteExistingFile

    from ssad.interchange.export import export_commonroad

    (file, *_), _ = export_commonroad(_scenarios()[:1], folder.with_name("new"), system="autopilot")
    text = file.read_text()
    content, problems = CommonRoadFileReader(str(file)).open()
    writer = CommonRoadFileWriter(content, problems, "", "", "", set(), file_format=FileFormat.PROTOBUF)
    writer.write_to_file(str(folder / "a.pb"), OverwriteExistingFile.ALWAYS)
    text = text.replace('commonRoadVersion="2020a"', 'commonRoadVersion="2018b" tags="highway"')
    text = re.sub(r'<(dynamic|static)Obstacle id="(\d+)">', r'<obstacle id="\2"><role>\1</role>', text)
    (folder / "a.xml").write_text(re.sub(r"</(?:dynamic|static)Obstacle>", "</obstacle>", text))
    return [folder / "a.pb", folder / "a.xml"]


def _read_older_commonroad(folder: Path) -> object:
    from ssad.interchange.commonroad_reader import read_commonroad

    return _read_each(folder, read_commonroad)


READERS: dict[str, Reader] = {
    "suite": Reader(_suite, _read_suite),
    "scenarios": Reader(_scenario_file, _read_scenario_file),
    "map": Reader(_map, _read_map),
    "lanelet2": Reader(_lanelet_map, _read_lanelet_maps),
    "town": Reader(_graph, _read_graph),
    "openscenario": Reader(_openscenario, _read_openscenario),
    "commonroad": Reader(_commonroad, _read_commonroad),
    "leaderboard": Reader(_leaderboard, _read_leaderboard),
    "routes": Reader(_routes, _read_routes),
    "run": Reader(_run, _read_run),
    "unsealed-run": Reader(_unsealed_run, _read_run),
    "report": Reader(_unsealed_run, _read_report),
    "compare": Reader(_two_runs, _read_comparison),
    "trace": Reader(_trace, _read_trace),
    "policy": Reader(_policy, _read_policy),
    "checkpoint": Reader(_checkpoint, _read_checkpoint, is_single=True),
    "nuscenes": Reader(_nuscenes, _read_nuscenes),
    "drive": Reader(_drive, _read_drive),
    "results": Reader(_results, _read_results),
    "coco": Reader(_coco, _read_coco),
    "points": Reader(_points, _read_points, is_single=True),
    "images": Reader(_images, _read_images, is_single=True),
    "obj": Reader(_mesh, _read_mesh),
    "gltf": Reader(_gltf, _read_gltf),
    "safetensors": Reader(_safetensors, _read_safetensors),
    "onnx": Reader(_onnx, _read_onnx, package="onnx2torch"),
    "darknet": Reader(_darknet, _read_darknet),
    "texture": Reader(_texture, _read_exports),
    "light": Reader(_light, _read_exports),
    "shifted": Reader(_shifted, _read_shifted),
    "older-commonroad": Reader(_older_commonroad, _read_older_commonroad, is_single=True, package="commonroad"),
}


# ---------------------------------------------------------------- the run


class TooLong(BaseException):
    """A read took longer than it may; no reader catches it as an error of the file."""


def check_line(error: SSADError) -> str:
    """Return the message of an error. ValueError if it is not one line of readable length."""
    message = str(error)
    if not message or "\n" in message or len(message) > 4000:
        raise ValueError(f"{type(error).__name__} of {message.count(chr(10)) + 1} lines, {len(message)} characters")
    message.encode()  # else it cannot be printed
    return message


@contextlib.contextmanager
def bounded(seconds: float = SECONDS, memory_bytes: int = MEMORY_BYTES) -> Iterator[None]:
    """Limit the processor time and the additional memory of a block: TooLong or MemoryError."""

    def stop(*_: object) -> None:
        raise TooLong(f"takes longer than {seconds:g} s of the processor")

    page_count = int(Path("/proc/self/statm").read_text().split()[0])
    limits = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (page_count * resource.getpagesize() + memory_bytes, limits[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_AS, limits)


def fuzz(name: str, indices: Sequence[int], *, seed: int = 0, show: bool = False) -> Tally:
    """Read mutations of the valid files of a reader, after these files themselves.

    Args:
        name: Name of the reader.
        indices: Which mutations.
        seed: Seed of them all.
        show: Whether the traceback of a failure is printed.

    Raises:
        SSADError: The valid files are refused.
    """
    reader, tally = READERS[name], Tally()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(temporary) / "files"
        folder.mkdir()
        paths = sorted(reader.make(folder))
        contents = {path: path.read_bytes() for path in paths}
        reader.read(folder)
        for path in paths if reader.is_single else ():
            path.unlink()
        for index in indices:
            draw = random.Random(f"{seed} {name} {index}")
            path = draw.choice(paths)
            path.write_bytes(mutate(draw, path, contents[path]))
            began = time.perf_counter()
            try:
                with bounded():
                    try:
                        reader.read(folder)
                        tally.returned += 1
                    except SSADError as error:
                        check_line(error)
                        tally.refused += 1
            except (Exception, TooLong) as error:
                frame = traceback.extract_tb(error.__traceback__)[-1]
                place = f"{Path(frame.filename).name}:{frame.lineno}"
                tally.failures[index] = f"{path.name}: {type(error).__name__} at {place}: {str(error)[:120]}"
                if show:
                    traceback.print_exception(error)
            tally.slowest = max(tally.slowest, time.perf_counter() - began)
            if reader.is_single:
                path.unlink()
            else:
                path.write_bytes(contents[path])
    return tally


def _work(arguments: tuple[str, Sequence[int], int, bool], results: multiprocessing.Queue[Tally]) -> None:
    name, indices, seed, show = arguments
    results.put(fuzz(name, indices, seed=seed, show=show))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each reader, and its failures; 1 if there are any."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--reader", action="append", choices=list(READERS), help="default: all")
    parser.add_argument("--count", type=int, default=2000, help="mutations of each reader")
    parser.add_argument("--index", type=int, help="this mutation alone, with its traceback")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    sys.path.insert(0, str(ROOT / "tests"))  # helpers that make valid files
    failed = 0
    for name in options.reader or READERS:
        if not READERS[name].is_available:
            print(f"{name}: not run: the package {READERS[name].package} is not installed", flush=True)
            continue
        indices = range(options.count) if options.index is None else [options.index]
        began = time.perf_counter()
        # A process of its own: a crash of native code ends one reader, not the run.
        results: multiprocessing.Queue[Tally] = multiprocessing.Queue()
        work = (name, indices, options.seed, options.index is not None)
        process = multiprocessing.Process(target=_work, args=(work, results))
        process.start()
        tally = None
        while tally is None and (process.is_alive() or not results.empty()):
            with contextlib.suppress(Exception):
                tally = results.get(timeout=1.0)
        process.join()
        if tally is None:
            failed += 1
            print(f"{name}: the process ended with code {process.exitcode}", flush=True)
            continue
        failed += len(tally.failures)
        print(
            f"{name}: {len(indices)} mutations, {tally.returned} read, {tally.refused} refused in one line, "
            f"{len(tally.failures)} other; slowest {tally.slowest:.1f} s, {time.perf_counter() - began:.0f} s in all",
            flush=True,
        )
        kinds = Counter(re.sub(r"^[^:]*: ", "", text)[:60] for text in tally.failures.values())
        for kind, count in kinds.most_common(12):
            index, text = next(item for item in tally.failures.items() if re.sub(r"^[^:]*: ", "", item[1])[:60] == kind)
            print(f"  {count} times, such as --index {index}: {text}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
