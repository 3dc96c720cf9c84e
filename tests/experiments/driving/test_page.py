"""The report: its tables against hand counts, its page as a browser would take it, its data back to the traces."""

from __future__ import annotations

import base64
import csv
import html.parser
import io
import itertools
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.browser import ask
from helpers.metric_traces import make_trace
from helpers.run_folder import DRIVING_HEADER, driving_line, driving_lines, reseal, write_run
from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import ConfigError, StoreError
from ssad.core.lane_strips import simplify_polyline
from ssad.core.safeio import to_plain_json
from ssad.core.traces import load_trace, save_trace
from ssad.core.types import TurnSignal
from ssad.drivers import make_system
from ssad.experiments.driving.driving_tables import average_note, full_table, precrash_table, summary_table
from ssad.experiments.driving.embed import SCALE, encode_int16, episode_data, origin, town_data
from ssad.experiments.driving.episodes import load_episodes
from ssad.experiments.driving.page import _system_tile
from ssad.experiments.runs import write_report
from ssad.metrics import episode_metrics
from ssad.report import write_video
from ssad.report.load import load_run
from ssad.report.paper import NATURAL, PRECRASH, SCENARIOS
from ssad.report.tables import tex, to_csv, to_latex, to_markdown
from ssad.report.terminal import terminal_table
from ssad.report.video import frames
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town, save_graph
from ssad.world.rollout import rollout
from ssad.world.world import World

HOSTILE = "<script>alert(1)</script>"


def unpack(text: str, rows: int) -> Any:
    """The inverse of `pack`: int16 [rows, T], as the page does it in JavaScript."""
    flat = np.frombuffer(zlib.decompress(base64.b64decode(text)), "<i2").reshape(rows, -1)
    return np.cumsum(flat, axis=1, dtype=np.int64).astype(np.int16)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Real episodes of two systems, one failed cell, one hostile name, and a torn last line."""
    folder = tmp_path_factory.mktemp("run")
    names = ["StraightObstacle/00", "StraightObstacle/01", "RedlightRunning/00", "natural/Twinford_03/00"]
    scenarios = [load_scenarios(n)[0] for n in names]
    graphs = {s.town: load_town(s.town) for s in scenarios}
    for name, graph in graphs.items():
        save_graph(graph, folder / "towns" / f"{name}.npz")
    lines, episodes, cells = [], [], []
    for system in ("autopilot", "blind"):
        built = [build_episode(s, graphs[s.town], seed=1) for s in scenarios]
        for k, (s, trace) in enumerate(zip(scenarios, rollout(World(built, graphs), make_system(system)), strict=True)):
            key = f"{system}{k}"
            save_trace(folder / "traces" / f"{key}.npz", trace)
            name = HOSTILE if k == 1 else s.name
            common = {"key": key, "suite": "t", "system": system, "group": s.group, "seed": 1}
            spec = {"scenario": {"name": name, "type": s.type, "town": s.town}, "system": system, "repetition": 0}
            line = common | {"status": "ok", "reason": "", "spec": spec, "n": 1, "versions": {}, "wall_s": 0.1}
            line["metrics"] = to_plain_json(episode_metrics(trace).as_dict())
            line["artefacts"] = {"trace": f"traces/{key}.npz"}
            lines.append(line)
            episodes.append(common | {"scenario": name, "end": trace.end, "town": s.town})
            cells.append({"key": key})
    failed = {k: v for k, v in lines[0].items() if k not in ("metrics", "artefacts")}
    failed |= {"key": "broken", "status": "timeout", "reason": f"no answer {HOSTILE} in 120 s", "metrics": {}}
    lines.append(failed)
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / "results.jsonl").write_text(text + '{"key": "torn')
    (folder / "episodes.jsonl").write_text("".join(json.dumps(e) + "\n" for e in episodes))
    header = {"suite": {"name": "t", "title": "A <b>title</b>", "seed": 1}, "versions": {"ssad": "0"}, "cells": cells}
    (folder / "run.json").write_text(json.dumps(header))
    reseal(folder)
    return folder


def test_precrash_table_counts_failed_episodes_and_holds_the_papers_rows(run_folder: Path) -> None:
    table = precrash_table(load_episodes(load_run(run_folder)))
    assert table is not None
    rows = {row.head: row for row in table.rows}
    column = list(SCENARIOS).index("StraightObstacle")
    ours = rows["CR", "autopilot"].cells[column]
    assert (ours.n, ours.failed, ours.mean) == (2, 1, 0.0)
    assert (ours.low, ours.high) == (0.0, 0.5), "the failed one may have collided: then half of its route's drives have"
    assert rows["RC", "autopilot"].cells[column].mean == pytest.approx(1.0, abs=1e-6)
    assert rows["CR", "blind"].cells[column].mean == 1.0
    assert rows["CR", "blind"].cells[list(SCENARIOS).index("RightTurn")].text == "n/a"
    assert rows["CR", "TD3"].published
    assert rows["CR", "TD3"].cells[-1].mean == 0.75
    read = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert len(read) == len(table.rows) * 9
    assert {r["source"] for r in read} == {"ours", "published"}
    assert to_markdown(table).count("\n|") == len(table.rows) + 2


def test_latex_is_balanced_and_escaped(run_folder: Path) -> None:
    table = precrash_table(load_episodes(load_run(run_folder)))
    assert table is not None
    text = to_latex(table)
    body = [line for line in text.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
    assert {len(re.findall(r"(?<!\\)&", line)) for line in body} == {10}
    assert text.count("{") == text.count("}")
    assert tex("50 % & a_b #1 {x} ~ ^ \\") == (
        r"50 \% \& a\_b \#1 \{x\} \textasciitilde{} \textasciicircum{} \textbackslash{}"
    )


def test_tables_say_what_an_average_averages_and_what_is_in_none(tmp_path: Path) -> None:
    """On the terminal, on the page, in Markdown and in LaTeX; a group without an average is named."""
    groups = ("StraightObstacle", "RightTurn", "CutIn")
    lines = [driving_line(group, group, f"{group}/00") for group in groups]
    run = load_episodes(load_run(write_run(tmp_path / "one", DRIVING_HEADER, lines)))
    note = "Avg. is the mean of Straight Obstacle and Right-turn, each weighed the same. CutIn is in no average."
    tables = [summary_table(run), precrash_table(run), full_table(run)]
    assert all(table is not None and note in table.note for table in tables)
    assert note in to_latex(tables[2])
    assert note in to_markdown(tables[2])
    console = Console(file=io.StringIO(), width=200)
    console.print(terminal_table(run.run, tables[0]))
    assert note in " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]
    lines = driving_lines() + [driving_line(f"{name}{k}", name, name) for k, name in enumerate(("CutIn", "CutOut"))]
    run = load_episodes(load_run(write_run(tmp_path / "all", DRIVING_HEADER, lines)))
    assert average_note(run) == (
        "Avg. is the mean of the eight pre-crash scenarios, each weighed the same. Avg. natural is the mean of "
        "Natural: Town02 and Natural: Town05, each weighed the same. Avg. other is the mean of CutIn and CutOut, each "
        "weighed the same."
    )
    alone = load_episodes(load_run(write_run(tmp_path / "custom", DRIVING_HEADER, lines[-1:])))
    assert average_note(alone) == "", "there is no average to explain"


class _Page(html.parser.HTMLParser):
    """Open elements, addresses and script texts of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.loads: list[str] = []
        self.keys: list[str] = []
        self.scripts = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "input", "br", "link", "img", "line", "circle"):
            self.stack.append(tag)
        named = dict(attrs)
        self.scripts += tag == "script"
        self.loads += [v for k, v in attrs if k in ("src", "href") and v and not v.startswith("#")]
        if "data-key" in named:
            self.keys.append(str(named["data-key"]))

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("line", "circle"):
            assert self.stack.pop() == tag


def test_page_is_well_formed_self_contained_and_escapes_names(run_folder: Path) -> None:
    path = write_report(run_folder)
    text = path.read_text()
    page = _Page()
    page.feed(text)
    assert page.stack == []
    assert page.scripts == 2
    assert all(link.startswith("tables/") for link in page.loads)
    assert all((run_folder / link).is_file() for link in page.loads)
    assert HOSTILE not in text
    assert "A &lt;b&gt;title" in text
    assert sorted(page.keys) == sorted(line["key"] for line in load_run(run_folder).lines)
    assert "no answer &lt;script&gt;" in text


def test_embedded_replay_gives_back_the_trace(run_folder: Path) -> None:
    text = write_report(run_folder).read_text()
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    assert found
    data = json.loads(found[1])
    assert set(data["episodes"]) == {line["key"] for line in load_run(run_folder).lines if line.get("artefacts")}
    for key, episode in data["episodes"].items():
        trace = load_trace(run_folder / "traces" / f"{key}.npz")
        agents = len(trace.names)
        columns = unpack(episode["motion"], 3 * agents + -(-agents // 15))
        ox, oy = data["towns"][trace.town]["origin"]
        for a in range(agents):
            here = trace.active[:, a]
            np.testing.assert_allclose(columns[3 * a][here] * SCALE + ox, trace.x[here, a], atol=SCALE)
            np.testing.assert_allclose(columns[3 * a + 1][here] * SCALE + oy, trace.y[here, a], atol=SCALE)
            np.testing.assert_array_equal((columns[3 * agents + a // 15] >> (a % 15)) & 1, here)
        assert len(episode["hits"]) == np.count_nonzero(trace.contact)


@pytest.mark.parametrize(("offset", "stretch"), [(0.0, 1.0), (1500.0, 1.0), (-4000.0, 1.0), (0.0, 40.0)])
def test_a_replay_far_from_the_origin_or_of_a_long_way_gives_back_the_trace(
    run_folder: Path, offset: float, stretch: float
) -> None:
    trace = load_trace(next((run_folder / "traces").glob("*.npz")))
    graph = load_town(trace.town)
    shifted = replace(
        trace,
        x=trace.x * np.float32(stretch) + np.float32(offset),
        route=trace.route * np.float32([stretch, 1.0]) + np.float32([offset, 0.0]),
    )
    episode = episode_data(shifted, graph)
    agents, scale = len(trace.names), episode["scale"]
    assert scale == pytest.approx(SCALE) if stretch == 1.0 else SCALE < scale < 0.5
    columns = unpack(episode["motion"], 3 * agents + -(-agents // 15))
    x = columns[: 3 * agents : 3] * scale + origin(graph)[0] + episode["anchor"][0]
    here = trace.active.T
    np.testing.assert_allclose(x[here], shifted.x.T[here], atol=scale)


def test_pack_survives_wrap_around() -> None:
    columns = np.array([[32767, -32767, 0, 12], [-5, -5, 7, 32767]], np.int16)
    np.testing.assert_array_equal(unpack(encode_int16(columns), 2), columns)


def test_thin_keeps_the_shape() -> None:
    angle = np.linspace(0, np.pi / 2, 200)
    arc = 20 * np.stack([np.cos(angle), np.sin(angle)], 1)
    kept = simplify_polyline(arc, 0.05)
    assert len(kept) < 20
    middle = 0.5 * (kept[1:] + kept[:-1])
    assert np.abs(np.hypot(*middle.T) - 20).max() < 0.06


def test_episode_record_is_in_thousandths(run_folder: Path) -> None:
    trace = load_trace(run_folder / "traces" / "blind0.npz")
    graph = load_town(trace.town)
    record = unpack(episode_data(trace, graph)["record"], 7)
    np.testing.assert_allclose(record[0] * 0.01, trace.speed[:, 0], atol=0.01)
    np.testing.assert_allclose(record[4] / 10, trace.route_complete, atol=0.1)
    low, high = graph.xy.min(axis=0), graph.xy.max(axis=0)
    np.testing.assert_allclose(origin(graph), 0.5 * (low + high), atol=0.06)


def test_turn_signals_are_in_the_replay_where_they_change_and_flash_in_the_video(run_folder: Path) -> None:
    trace = load_trace(run_folder / "traces" / "blind0.npz")
    graph = load_town(trace.town)
    assert episode_data(trace, graph)["turn_signals"] == []
    signals = np.zeros(trace.x.shape, np.int8)
    signals[4:9, 0] = TurnSignal.RIGHT
    indicating = replace(trace, turn_signal=signals)
    assert episode_data(indicating, graph)["turn_signals"] == [[0, [[0, 0], [4, -1], [9, 0]]]]
    dark, lit = (list(itertools.islice(frames(each, graph, size=(320, 180)), 10)) for each in (trace, indicating))
    differs = [step for step in range(10) if (dark[step] != lit[step]).any()]
    assert differs == [step for step in range(4, 9) if int(3.0 * step * trace.dt + 1e-6) % 2 == 0]
    assert differs


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_video_has_the_episodes_frames(run_folder: Path, tmp_path: Path, suffix: str) -> None:
    trace = load_trace(run_folder / "traces" / "blind0.npz")
    path = write_video(trace, load_town(trace.town), tmp_path / f"a{suffix}")
    if suffix == ".mp4":
        reader = cv2.VideoCapture(str(path))
        count = 0
        while reader.read()[0]:
            count += 1
        assert count == len(trace.accel)
    else:
        from PIL import Image

        with Image.open(path) as picture:
            assert picture.n_frames == -(-len(trace.accel) // 2)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_bad_folders_and_suffixes_end_in_one_line(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"run\.json is missing"):
        write_report(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(StoreError, match="no results yet"):
        write_report(tmp_path)
    (tmp_path / "results.jsonl").write_text('nonsense\n{"key": "a"}\n')
    with pytest.raises(StoreError, match=r"results\.jsonl:1"):
        write_report(tmp_path)
    trace = load_trace(run_folder / "traces" / "blind0.npz")
    with pytest.raises(ConfigError, match=r"\.mp4 or \.gif"):
        write_video(trace, load_town(trace.town), tmp_path / "a.avi")


def test_a_lost_trace_costs_only_its_replay(run_folder: Path, tmp_path: Path) -> None:
    for name in ("run.json", "results.jsonl", "episodes.jsonl", "seal.json"):
        (tmp_path / name).write_bytes((run_folder / name).read_bytes())
    text = write_report(tmp_path).read_text()
    assert "8 episodes have no replay" in text
    assert "Missing or altered files: 8" in text
    assert (tmp_path / "tables" / "precrash.csv").is_file()


@pytest.mark.data
def test_the_papers_tables_are_as_the_paper_has_them(data_dir: Path) -> None:
    sources = sorted((data_dir.parent / "paper").glob("*.txt"))
    if not sources:
        pytest.skip("the paper's source is not beside the data folder")
    text = sources[0].read_text()
    block = text[text.index("pre-crash safety-critical scenarios. CR") : text.index("tablescenario1")]
    metric = ""
    seen = 0
    for line in block.splitlines():
        name = re.search(r"\{\*\}\{(CR|OR|DR|RC)\}", line)
        metric = name[1] if name else metric
        row = re.search(r"&(PPO|SAC|TD3)&(.*?)\\\\", line)
        if row and metric:
            assert tuple(float(v) for v in row[2].split("&")) == PRECRASH[metric][row[1]]
            seen += 1
    assert seen == 12
    block = text[text.index("Adv.PPO on Town02 and Town05 maps") : text.index("label{tablescenario2}")]
    rows = re.findall(r"^(Autopilot|PPO)&(Autopilot|Adv\. PPO)&(.*?)\\\\", block, re.MULTILINE)
    assert len(rows) == 4
    for system, traffic, numbers in rows:
        values = tuple(float(v) for v in numbers.split("&"))
        assert (values[:3], values[3:]) == tuple(NATURAL[system, traffic][t] for t in ("Town02", "Town05"))


def test_report_needs_no_world(run_folder: Path) -> None:
    import subprocess
    import sys

    code = (
        "import sys\nfrom pathlib import Path\nfrom ssad.experiments.runs import write_report\n"
        "write_report(Path(sys.argv[1]))\n"
        "assert not {'torch', 'warp', 'carla', 'gymnasium'} & set(sys.modules), 'heavy imports'"
    )
    done = subprocess.run(  # noqa: PLW1510
        [sys.executable, "-c", code, str(run_folder)], capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    assert safeio.read_json(run_folder / "run.json")["suite"]["name"] == "t"


def test_the_first_screen_says_what_was_found_when_where_and_with_which_table(tmp_path: Path) -> None:
    lines = driving_lines()
    header = {
        "suite": {"name": "quick", "kind": "driving", "title": "Stock title", "description": "Stock text."},
        "kind": "driving",
        "command": "ssad run quick --set 'scenarios=[RightTurn]' --set pictures=[]",
        "code": "c0de",
        "started": "2026-01-02T03:04:05+00:00",
        "machine": {"processor": "Some CPU", "cores": "2", "system": "Linux x86_64"},
    }
    page = write_report(write_run(tmp_path / "a", header, lines)).read_text()
    first = page[: page.index("<main>")]
    hit = sum(bool(line["metrics"].get("collision")) for line in lines if line["system"] == "a")
    assert "<h1>quick with scenarios RightTurn</h1>" in first
    assert "Stock text." not in first, "it describes another run"
    told = (f"a collided in {hit} of ", f"1 of {len(lines)} cells failed", "2026-01-02 03:04 UTC", "Some CPU, 2 cores")
    for words in (*told, "code c0de"):
        assert words in first, words
    found = re.search(r'equal hashes">([0-9a-f]{12})<', first)
    assert found
    assert f">{found[1]}<" in write_report(write_run(tmp_path / "b", header, lines)).read_text()
    lines[0]["metrics"]["distance_to_route"] += 1e-9
    assert f">{found[1]}<" not in write_report(write_run(tmp_path / "c", header, lines)).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 400, 1280])
def test_nothing_is_wider_than_the_window_and_the_seek_bar_can_be_used(
    width: int, run_folder: Path, tmp_path: Path
) -> None:
    """A browser lays the page out; a frame of that width shows it, and a script tells what sticks out.

    The main table begins on the first screen, which is 900 pixels high here, with a number in sight.
    """
    script = """<script>addEventListener("load", () => setTimeout(() => {
        const wide = [...document.querySelectorAll("body *")].filter(e => !e.closest(".scroll, svg")
            && e.getBoundingClientRect().right > innerWidth + 1).map(e => e.tagName + "." + e.className);
        wide.push(...[...document.querySelectorAll(".plot circle, .plot text")].filter(e =>
            e.getBoundingClientRect().right > innerWidth || e.getBoundingClientRect().left < 0).map(e => e.tagName));
        const seek = document.getElementById("seek").getBoundingClientRect();
        const number = document.querySelector("#results td b").getBoundingClientRect();
        tell({inner: innerWidth, wide, seek: [seek.width, seek.height], number: [number.right, number.bottom]});
    }, 300))</script>"""
    page = write_report(run_folder).read_text().replace("</body>", script + "</body>")
    found, console = ask(page, tmp_path, width=width)
    assert console == []
    assert found["inner"] == width
    assert found["wide"] == []
    assert found["seek"][0] > 150
    assert found["seek"][1] >= 12
    assert found["number"][0] < width
    assert found["number"][1] < 900


@pytest.mark.slow
def test_a_replay_plays_and_seeks_in_a_browser(run_folder: Path, tmp_path: Path) -> None:
    script = """<script>const nap = (ms) => new Promise((then) => setTimeout(then, ms));
    addEventListener("load", async () => {
        await nap(500);
        const seek = document.getElementById("seek"), picture = () => document.getElementById("canvas").toDataURL();
        const to = async (part) => {
            seek.value = Math.round(seek.max * part);
            seek.dispatchEvent(new Event("input"));
            await nap(200);
            return [Number(seek.value), picture()];
        };
        document.getElementById("play").click();  // it plays from the start: now it stands
        const [first, early] = await to(0.2), [second, late] = await to(0.8), [, again] = await to(0.2);
        document.getElementById("play").click();
        await nap(1000);
        tell({steps: Number(seek.max), first, second, changed: early !== late, same: early === again,
              played: Number(seek.value) - first});
    })</script>"""
    found, console = ask(write_report(run_folder).read_text().replace("</body>", script + "</body>"), tmp_path)
    assert console == []
    assert found["first"] == round(found["steps"] * 0.2)
    assert found["second"] == round(found["steps"] * 0.8)
    assert found["changed"]
    assert found["same"]
    assert found["played"] >= 2


@pytest.mark.slow
def test_a_video_plays_and_seeks_in_a_browser(run_folder: Path, tmp_path: Path) -> None:
    trace = load_trace(run_folder / "traces" / "blind0.npz")
    film = write_video(trace, load_town(trace.town), tmp_path / "film.mp4")
    page = f"""<!DOCTYPE html><html><head><title>film</title></head><body>
    <video id=film src={film.name} muted preload=auto></video><script>
    const film = document.getElementById("film"), happens = (name) => new Promise((then) => film.addEventListener(
        name, then, {{once: true}}));
    const look = () => {{
        const canvas = Object.assign(document.createElement("canvas"), {{width: 96, height: 54}});
        const pen = canvas.getContext("2d");
        pen.drawImage(film, 0, 0, 96, 54);
        return pen.getImageData(0, 0, 96, 54).data.reduce((a, b, k) => (a * 31 + b * (k % 7 + 1)) % 1000003, 0);
    }};
    film.addEventListener("error", () => tell({{error: film.error.message}}));
    film.addEventListener("canplaythrough", async () => {{
        const size = [film.videoWidth, film.videoHeight], seen = [];
        for (const part of [0.1, 0.9, 0.1]) {{
            const there = happens("seeked");
            film.currentTime = film.duration * part;
            await there;
            seen.push(look());
        }}
        const ended = happens("ended");
        film.playbackRate = 8;
        await film.play();
        await ended;
        tell({{size, duration: film.duration, seen, at: film.currentTime}});
    }}, {{once: true}});
    </script></body></html>"""
    found, console = ask(page, tmp_path)
    assert console == []
    assert found["size"] == [960, 540]
    assert found["duration"] == pytest.approx(len(trace.accel) * trace.dt, abs=0.2)
    assert found["seen"][0] == found["seen"][2] != found["seen"][1]
    assert found["at"] == pytest.approx(found["duration"], abs=0.2)


def test_a_tile_says_where_it_averages_several_groups(run_folder: Path) -> None:
    names = [part["name"] for part in _system_tile(load_episodes(load_run(run_folder)), "blind")["parts"]]
    assert names == ["pre-crash, mean of the groups", "natural traffic"]


def test_the_roads_beside_a_route_are_kept() -> None:
    """Lanes of the cell of the grid that a route of one point lies in are kept, those far away are not."""
    graph = load_town("Twinford")
    lane = max(range(graph.lane_count), key=lambda n: float(graph.length[n]))
    middle = graph.xy[graph.points(lane)][len(graph.xy[graph.points(lane)]) // 2].astype(np.float64)
    trace = make_trace(2, [(*middle, 0.0, 0.0)])
    near = town_data(graph, [replace(trace, route=np.array([middle], np.float32))])
    far = town_data(graph, [replace(trace, route=np.array([middle + 1e5], np.float32))])
    assert len(near["strips"]) > len(far["strips"]) == 0
