"""Write docs/images/architecture.svg, with the rooms of pyproject.toml's import contract.

python benchmarks/architecture_picture.py

All text stands on boxes with a colour of their own or is mid-grey, so the picture can be read on light and dark pages.
"""

from __future__ import annotations

import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
WIDTH, TOP, PITCH, HEIGHT = 1200, 78, 40, 34  # pixels: picture, first row, from row to row, a box
GREY = "#7d8590"
COLOURS = {  # fill and border, by what a package is for
    "#d7e7fb": ("#3b76c4", ("cli", "results", "experiments", "engine", "report")),
    "#ddf0dc": ("#4a9150", ("training", "envs", "interchange", "recorders", "simulators")),
    "#fdebd0": ("#c98a2b", ("scenarios", "drivers", "detectors", "datasets")),
    "#e6def5": ("#7d5fb5", ("world", "rendering")),
    "#e3e7eb": ("#768390", ("metrics", "core")),
}
SCENARIO = (  # step, what it is, package
    ("suite", "YAML file and --set options", "experiments"),
    ("plan", "the kind makes cells with keys", "experiments"),
    ("pool", "local processes or Ray, time-outs", "engine"),
    ("episode", "a scenario built on a town", "scenarios"),
    ("drive", "world and driver, step by step", "simulators"),
    ("record", "metrics, trace, results.jsonl", "metrics"),
    ("report", "tables, figures, replays", "report"),
)
IMAGE = (
    ("scene", "street and bodies", "rendering"),
    ("image", "rendered, or from a dataset", "rendering"),
    ("shift", "snow, fog, noise, ...", "scenarios"),
    ("detect", "2D or 3D boxes for each camera", "detectors"),
    ("merge", "boxes of all cameras in the world", "detectors"),
    ("score", "mAP, NDS, mCE, uncertainty", "metrics"),
    ("report", "tables, curves, images", "report"),
)


def layers() -> list[list[str]]:
    """Rows of packages, from top to bottom: each imports only from rows below it."""
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    return [[name.strip(" ()") for name in row.split("|")] for row in contract["layers"]]


def box(x: float, y: float, width: float, title: str, *, package: str, note: str = "") -> str:
    """A box in the colour of its package."""
    fill, border = next((fill, border) for fill, (border, names) in COLOURS.items() if package in names)
    text = f'<text x="{x + width / 2:g}" y="{y + 22}" class="name" text-anchor="middle">{escape(title)}</text>'
    if note:
        text = f'<text x="{x + 10}" y="{y + 22}" class="name">{escape(title)}</text>'
        text += f'<text x="{x + 92}" y="{y + 21}" class="note">{escape(note)}</text>'
    shape = f'<rect x="{x:g}" y="{y}" width="{width:g}" height="{HEIGHT}" rx="6" fill="{fill}" stroke="{border}"/>'
    return shape + text


def arrow(x: float, top: float, bottom: float) -> str:
    """An arrow downwards."""
    return f'<path d="M{x:g} {top}V{bottom - 2}" class="line" marker-end="url(#head)"/>'


def rooms(x: float, width: float) -> list[str]:
    """The packages, a row for each layer."""
    parts = []
    for number, row in enumerate(layers()):
        share = (width - 8 * (len(row) - 1)) / len(row)
        y = TOP + PITCH * number
        parts += [box(x + k * (share + 8), y, share, name, package=name) for k, name in enumerate(row)]
    parts.append(arrow(x - 14, TOP, TOP + PITCH * (len(layers()) - 1) + HEIGHT))
    return parts


def chain(x: float, width: float, steps: tuple[tuple[str, str, str], ...]) -> list[str]:
    """Steps from top to bottom, over the height of the rooms."""
    pitch = PITCH * (len(layers()) - 1) / (len(steps) - 1)
    parts = []
    for number, (title, note, package) in enumerate(steps):
        y = round(TOP + pitch * number)
        parts.append(box(x, y, width, title, package=package, note=note))
        if number:
            parts.append(arrow(x + width / 2, round(y - pitch) + HEIGHT, y))
    return parts


def picture() -> str:
    """The picture as SVG."""
    height = TOP + PITCH * (len(layers()) - 1) + HEIGHT + 14
    heads = (
        (24, "Packages", "each imports only from rows below it"),
        (420, "A scenario, from YAML to the report", "colours as on the left"),
        (820, "An image, from the camera to a score", "colours as on the left"),
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" '
        'role="img" aria-label="Packages of SSAD, and the ways of a scenario and of an image through them">',
        "<style>text{font-family:system-ui,-apple-system,'Segoe UI',Helvetica,Arial,sans-serif}"
        ".name{font-size:14px;font-weight:600;fill:#1f2328}.note{font-size:12px;fill:#1f2328}"
        f".head{{font-size:17px;font-weight:600;fill:{GREY}}}.hint{{font-size:13px;fill:{GREY}}}"
        f".line{{stroke:{GREY};stroke-width:1.6;fill:none}}</style>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0L8 4L0 8z" fill="{GREY}"/></marker></defs>',
    ]
    for x, title, hint in heads:
        parts.append(f'<text x="{x}" y="28" class="head">{title}</text><text x="{x}" y="52" class="hint">{hint}</text>')
    parts += [*rooms(24, 356), *chain(420, 360, SCENARIO), *chain(820, 360, IMAGE), "</svg>"]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(picture())
