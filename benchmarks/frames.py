"""Frames of the onboard camera at full size, before and after a change of the rendering: docs/results/pictures.md.

    python benchmarks/frames.py --out FOLDER [--view NAME ...] [--label before]   # renders FOLDER/LABEL-NAME.png
    python benchmarks/frames.py --store FOLDER   # makes the JPEGs of the page from the PNGs of both labels
    python benchmarks/frames.py --page           # writes the page

Each view is a step of a drive of `autopilot` through a scenario, seen by the front camera with the default quality and
the default sensor. The script uses only names that were there before the effects of the rendering. So it also runs
with an earlier source, which makes the frames before:

    git worktree add --detach EARLIER COMMIT
    PYTHONPATH=EARLIER/src python benchmarks/frames.py --out FOLDER --label before
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from PIL import Image

import ssad
from ssad.core.frames import Camera
from ssad.drivers import make_system
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.episode_scene import agent_poses
from ssad.rendering.onboard import Onboard
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PICTURES = DOCS / "images" / "frames"
PAGE = DOCS / "results" / "pictures.md"
RESULTS = ROOT / "benchmarks" / "results" / "frames.json"
SIZE = (1280, 720)
QUALITY = 88  # of the JPEGs
LABELS = ("before", "after")

DAY = SceneWeather(0.9, 2.2, 0.3)
NIGHT = SceneWeather(-0.3, 0.9, 0.3)
WET = SceneWeather(0.6, 0.9, 0.85, wet=0.9)
LOW_SUN = SceneWeather(0.15, 0.12, 0.2)


@dataclass(frozen=True, slots=True)
class FrameView:
    """Step of a drive, and its weather.

    Attributes:
        title: Title on the page.
        scenario: Name of the scenario; its first word is that of the set.
        step: Step of the drive.
        change: Sentences that say what differs between the frames.
        weather: Weather.
        faces_sun: Whether the heading of the sun counts from that of the camera.
    """

    title: str
    scenario: str
    step: int
    change: str
    weather: SceneWeather = DAY
    faces_sun: bool = False


VIEWS = {
    "day": FrameView(
        "Day",
        "natural/Crossgate_18/00",
        5,
        "The van has people, a badge, a plate and a lamp with parts; signals for walkers stand at the crossing; the "
        "glass of the offices mirrors its surroundings; parking bays interrupt the kerb.",
    ),
    "night": FrameView(
        "Night",
        "natural/Crossgate_35/01",
        131,
        "Street lamps light the road to the class of its lighting, and they and the stop lamps glow. The cyclist "
        "has a lamp and can be seen.",
        NIGHT,
    ),
    "wet": FrameView(
        "Wet road",
        "natural/Crossgate_131/02",
        98,
        "The road mirrors the sky and the buildings. Before, it was only darker. The cars have lamps with parts, "
        "spokes, joints between doors, and people.",
        WET,
    ),
    "low-sun": FrameView(
        "Low sun ahead",
        "natural/Twinford_11/12",
        140,
        "The sun veils the roofs around it, and the lens has a faint ghost on the road. Shadows are softer the "
        "farther they fall, and the crown of the tree is no longer made of shards.",
        LOW_SUN,
        faces_sun=True,
    ),
    "near-car": FrameView(
        "Near car",
        "natural/Crossgate_18/00",
        68,
        "People, seats, a badge, a plate, a divided rear lamp, spokes and joints between panels. Before, the same car "
        "was a plain body with opaque glass.",
    ),
    "far-street": FrameView(
        "Far street",
        "training/Oldmarket/RedlightRunning/03",
        178,
        "Benches, plants, parking bays and shop windows with goods are new. Haze over such a distance hardly shows.",
    ),
    "junction": FrameView(
        "Junction with signals",
        "natural/Crossgate_68/04",
        59,
        "The lit lens has the green of a signal, and the other two are dark. Signals for walkers show their state. The "
        "cars have people and spokes, and the glass of the offices mirrors what is around.",
    ),
    "motorway": FrameView(
        "Motorway",
        "training/Longreach/LaneChanging/04",
        65,
        "Crowns consist of leaves, and their shadow has a ragged edge. Before, they were shards. The cars have "
        "plates, badges and divided lamps.",
    ),
}

FLAWS = {
    "Asphalt": "One grey with soft spots and no grain: no tracks of wheels, cracks, oil or grit. Repairs are plain "
    "darker rectangles. Markings are evenly white and not worn.",
    "Facades": "One plaster or brick covers a whole wall, and gables are bare: no gutters, pipes, stains or cables "
    "(far street). A shop sign is a white bar without letters.",
    "Mirror images in glass": "Plane glass shows bent, smooth shapes, as if it were warped: all windows share one "
    "image of the surroundings (day, near car, wet road). No car and no person appears in them.",
    "Wet road": "It is an even mirror with vertical bands that have hard edges: no puddles, no tracks of tyres, no "
    "spray. Cars and people have no clear mirror image in it. The crosswalk is as white and as dull as when it is dry, "
    "and no water stands on the cars.",
    "Stop lamps at night": "Close ahead they saturate and colour the whole rear: the blue car turns violet, and its "
    "bumper is a pale band with a hard edge.",
    "Street lamps": "Each glows as an equal white ball. A hard edge divides the lit from the dark part of its pole. "
    "The people and the car under them cast no shadows.",
    "Windows at night": "Few are lit, each in one even colour. Ground floors are rows of pale panes with nothing "
    "behind them.",
    "Cars": "Surfaces are few and smooth, arches of wheels have corners, and windows have no seals. The plate has "
    "three black squares for characters. All wheels have the same five thick spokes, sharp on moving cars too: nothing "
    "is blurred by motion. The people inside are dark outlines.",
    "Lamps of cars": "A head lamp is a flat panel with a hexagon in it, and the indicator is an orange bar. The red of "
    "a rear lamp by day is one flat colour.",
    "People": "Few outfits, mostly a yellow pullover or a blue coat, and groups stand in one pose. Arms hang straight, "
    "faces have hardly any features, clothes have no folds, and the bag is a black block.",
    "Trees": "The near crown is an even hull of leaves of one size and one green, cut straight at its side, without "
    "branches; the trunk is a smooth post (motorway). Crowns farther away are two or three smooth lobes (low sun).",
    "Grass and the edge of the road": "A lawn is a flat green with long streaks, and it meets the asphalt in a clean "
    "line, without a shoulder or weeds. Sheds stand about on it (motorway).",
    "Kerbs": "The end of a parking bay is a dark slab with a visible seam (wet road).",
    "Signal heads": "The lit lens is a polygon of one flat green, without the pattern of light sources and without a "
    "glow by day.",
    "Fine lines": "Distant markings, thin frames of windows and the edges of leaves have blue and orange pixels, "
    "which the mosaic of the sensor makes of them (junction, motorway).",
    "Sky": "Clouds are a few blurred wisps of one kind.",
}
"""Faults that are visible in the frames after, by what shows them."""


def draw_frame(view: FrameView) -> Image.Image:
    """Return the picture of the front camera at a step of a drive."""
    scenario = next(
        scenario for scenario in load_scenarios(view.scenario.partition("/")[0]) if scenario.name == view.scenario
    )
    graph = load_town(scenario.town)
    episode = build_episode(scenario, graph, seed=0)
    (trace,) = rollout(World([episode], {graph.name: graph}), make_system("autopilot"))
    weather = view.weather
    if view.faces_sun:
        heading = float(agent_poses(trace)[view.step].pose[0, 2])
        weather = replace(weather, sun_heading=heading + weather.sun_heading)
    camera = Onboard(weather=weather).camera(Camera.typical(*SIZE))
    (pixels,) = camera.of_trace(trace, graph, steps=[view.step])
    return Image.fromarray(np.ascontiguousarray(pixels.transpose(1, 2, 0)))


def source_commit() -> str:
    """Return the commit of the source of `ssad`, and its date."""
    folder = str(Path(ssad.__file__).parent)
    words = ["git", "-C", folder, "log", "-1", "--format=%h (%cs)", "--abbrev=7"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def render_frames(folder: Path, label: str, names: Sequence[str]) -> None:
    """Write the frames as PNG, and the commit that rendered them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        draw_frame(VIEWS[name]).save(folder / f"{label}-{name}.png")
    source = {"commit": source_commit(), "torch": torch.__version__.partition("+")[0]}
    (folder / f"{label}.json").write_text(json.dumps(source) + "\n")


def store_frames(folder: Path) -> None:
    """Write the frames of a folder as the JPEGs of the page, and the commits that rendered them."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for label in LABELS:
        for name in VIEWS:
            with Image.open(folder / f"{label}-{name}.png") as picture:
                picture.save(PICTURES / f"{label}-{name}.jpg", quality=QUALITY, optimize=True)
    sources = {label: json.loads((folder / f"{label}.json").read_text()) for label in LABELS}
    RESULTS.write_text(json.dumps(sources, indent=1) + "\n")


def page() -> str:
    """docs/results/pictures.md, from the stored frames."""
    sources: dict[str, Any] = json.loads(RESULTS.read_text())
    before, after = (sources[label] for label in LABELS)
    lines = [
        "# Pictures before and after",
        "",
        f"> **Stored result.** Commit: {after['commit']} for the frames after, {before['commit']} for those before. "
        f"Weights: none. Torch: {after['torch']}. Make it anew: `python benchmarks/frames.py --out FOLDER`, the same "
        "with `--label before` and the earlier source in `PYTHONPATH`, `python benchmarks/frames.py --store FOLDER`, "
        "then `python benchmarks/frames.py --page`.",
        "",
        f"Eight frames of the front camera, {SIZE[0]} x {SIZE[1]} pixels, with the default quality and the default "
        "sensor, before and after the [effects of the rendering](../reference/camera.md) and the new bodies, "
        "plants and streets. Each is a step of a drive of `autopilot`. Driving did not change, so camera and "
        "traffic of a pair are in the same place. Streets are "
        "built anew, with other buildings and trees. Each frame opens at full size.",
    ]
    for name, view in VIEWS.items():
        pair = [f"../images/frames/{label}-{name}.jpg" for label in LABELS]
        shown = [f"[![{view.title}, {label}]({path})]({path})" for label, path in zip(LABELS, pair, strict=True)]
        lines += [
            "",
            f"## {view.title}",
            "",
            "| Before | After |",
            "|---|---|",
            f"| {' | '.join(shown)} |",
            "",
            f"`{view.scenario}`, step {view.step}. {view.change}",
        ]
    lines += [
        "",
        "## What still gives the pictures away",
        "",
        "Seen in the frames after, at full size:",
        "",
        *(f"* **{title}.** {sentence}" for title, sentence in FLAWS.items()),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Render frames, store them, or write the page."""
    parser = argparse.ArgumentParser(description="Frames of the onboard camera before and after.")
    parser.add_argument("--out", type=Path, help="folder of the PNGs")
    parser.add_argument("--label", choices=LABELS, default="after")
    parser.add_argument("--view", nargs="+", choices=list(VIEWS), default=list(VIEWS))
    parser.add_argument("--store", type=Path, help="folder with all PNGs of both labels")
    parser.add_argument("--page", action="store_true", help="write the page")
    options = parser.parse_args()
    if options.out:
        render_frames(options.out, options.label, options.view)
    if options.store:
        store_frames(options.store)
    if options.page:
        PAGE.write_text(page())
    if not (options.out or options.store or options.page):
        parser.error("name --out FOLDER, --store FOLDER or --page")


if __name__ == "__main__":
    main()
