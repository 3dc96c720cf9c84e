"""Figures of a physical run for the documentation: python -m benchmarks.physical_distance RUN [--name physical]

RUN is what `ssad run physical` wrote. For each town, detector and carrier one SVG goes to docs/images, with AP50 and
mean score against distance, and the lines that show them in Markdown are printed.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import ssad.report
from ssad.core import safeio
from ssad.experiments.perception.physical.approach_page import approach_figures
from ssad.experiments.perception.physical.physical_run import PhysicalRun
from ssad.report.load import load_run

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
STYLE_SHEET = Path(ssad.report.__file__).parent / "templates" / "style.css"
VARIABLE = re.compile(r"--([\w-]+):([^;}]+)")
STYLE = (
    "text{{font:11px system-ui,sans-serif;fill:{soft}}}text.name{{fill:{ink};font-weight:600;font-size:12.5px}}"
    ".grid{{stroke:{line}}}"
)


def standalone(svg: str) -> str:
    """Return a figure of a page as a file of its own: with the colours of the light style, on white."""
    first_rule = safeio.read_text(STYLE_SHEET).partition("@media")[0]
    colours = dict(VARIABLE.findall(first_rule))
    svg = re.sub(r"var\(--([\w-]+)\)", lambda match: colours[match[1]], svg)
    head, rest = svg.split(">", 1)
    style = STYLE.format(**{name: colours[name] for name in ("soft", "ink", "line")})
    background = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{style}</style>{background}{rest}\n'


def write_figures(folder: Path, name: str, out: Path = IMAGES) -> list[str]:
    """Write the figures of a run, and return the Markdown that shows them."""
    lines = []
    for title, svg in approach_figures(PhysicalRun(load_run(folder))):
        slug = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
        file = out / f"{name}-{slug}.svg"
        safeio.write_atomic(file, standalone(svg))
        lines.append(f"![AP50 and mean score against distance: {title}](../images/{file.name})")
    return lines


def main() -> None:
    """Write the figures, and print the Markdown that shows them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--name", default="physical")
    options = parser.parse_args()
    print("\n\n".join(write_figures(options.run, options.name)))


if __name__ == "__main__":
    main()
