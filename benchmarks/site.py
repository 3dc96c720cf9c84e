"""Build the site of the documentation: the pages of this repository, the notebooks, and the API from docstrings.

uv run --group site python benchmarks/site.py build/site

It needs no network, and fails on a link that leads nowhere. `--pages` writes the pages alone, without mkdocs.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import ssad

ROOT = Path(__file__).parents[1]
TOP = ("ARCHITECTURE", "CONTRIBUTING", "CHANGELOG", "SECURITY")  # pages at the top of the repository; no README
PARTS = {
    "Home": ("index",),
    "Tutorials": ("tutorials/*",),
    "How-to guides": ("how-to/*",),
    "Reference": ("reference/*", "SECURITY", "CHANGELOG"),
    "Explanation": ("explanation/*", "ARCHITECTURE", "CONTRIBUTING"),
    "Results": ("results/*",),
}
"""Part of the site -> its pages in order; a star stands for the pages of a folder that are not named, by name."""
ORDER = {
    "tutorials/*": ("first-run", "my-driver", "my-detector", "camera-to-collision", "drive", "perceive"),
    "how-to/*": ("install",),
    "explanation/*": ("concepts", "intervals"),
    "results/*": ("index",),
}
"""Pages of a folder that come first."""
MORE = (  # beside the names of `ssad`
    "ssad.core.driving.Driver",
    "ssad.core.driving.Observation",
    "ssad.core.driving.Simulator",
    "ssad.core.protocols.Detector",
    "ssad.core.generators.Generator",
    "ssad.world.check.check_driver",
    "ssad.world.check.check_simulator",
    "ssad.detectors.check.check_detector",
    "ssad.world.env.VectorEnv",
)
SETTINGS = """site_name: SSAD
site_description: A testbed for the safety and robustness of autonomous driving in safety-critical scenarios
docs_dir: pages
use_directory_urls: false
strict: true
theme:
  name: material
  font: false
  features: [navigation.top, navigation.indexes, content.code.copy, toc.follow]
  palette:
    - {media: "(prefers-color-scheme: light)", scheme: default, primary: indigo}
    - {media: "(prefers-color-scheme: dark)", scheme: slate, primary: indigo}
markdown_extensions: [tables, fenced_code, attr_list, admonition, md_in_html, {toc: {permalink: true}}]
plugins:
  - search
  - mkdocstrings:
      handlers:
        python:
          paths: [SOURCE]
          options: {docstring_style: google, show_root_heading: true, show_source: false, heading_level: 3,
                    members_order: source, show_signature_annotations: true, separate_signature: true}
validation: {links: {not_found: warn, anchors: warn, unrecognized_links: warn}, nav: {omitted_files: info}}
nav:
"""


def write_pages(folder: Path) -> list[str]:
    """Write all pages into a folder, with their links as they are there; return the names of the pages."""
    shutil.copytree(ROOT / "docs", folder, ignore=shutil.ignore_patterns("*.ipynb"))
    for name in TOP:
        (folder / f"{name}.md").write_text((ROOT / f"{name}.md").read_text())
    for notebook in sorted((ROOT / "docs").rglob("*.ipynb")):
        (folder / notebook.relative_to(ROOT / "docs")).with_suffix(".md").write_text(as_page(notebook))
    (folder / "reference" / "api.md").write_text(api_page())
    pages = sorted(page.relative_to(folder) for page in folder.rglob("*.md"))
    for page in pages:
        source = ROOT / page.name if page.stem in TOP else ROOT / "docs" / page
        parts = re.split(r"\]\(([^)\s]+)\)", (folder / page).read_text())  # text, target, text, target, ...
        moved = (moved_link(part, source, page, folder) if k % 2 else part for k, part in enumerate(parts))
        (folder / page).write_text("".join(moved))
    return [page.with_suffix("").as_posix() for page in pages]


def moved_link(target: str, source: Path, page: Path, folder: Path) -> str:
    """Return a link as it is on the site; the text alone if its target is not there (source, licence).

    Args:
        target: Target of the link, relative to the page's source.
        source: The page in the repository.
        page: The page on the site, relative to the folder.
        folder: Folder of the site's pages.
    """
    file, mark, anchor = target.partition("#")
    if target.startswith("http") or not file:
        return f"]({target})"
    place = (source.parent / file).resolve()
    docs = ROOT / "docs"
    if place == ROOT / "README.md":
        inside = Path("index.md")
    elif place.parent == ROOT:
        inside = Path(place.name)
    elif place.is_relative_to(docs):
        inside = place.relative_to(docs)
    else:
        return "]"
    if inside.suffix == ".ipynb":
        inside = inside.with_suffix(".md")
    if not (folder / inside).is_file():
        return "]"
    return f"]({os.path.relpath(folder / inside, (folder / page).parent)}{mark}{anchor})"


def navigation(pages: Sequence[str]) -> dict[str, list[str]]:
    """Return part -> its pages in order.

    Raises:
        SystemExit: A page has no place, or a place has no page.
    """
    named = {name for names in PARTS.values() for name in names if not name.endswith("*")}
    parts: dict[str, list[str]] = {}
    for part, names in PARTS.items():
        found: list[str] = []
        for name in names:
            if name.endswith("*"):
                inside = [page for page in pages if page.startswith(name[:-1]) and page not in named]
                first = [name[:-1] + page for page in ORDER.get(name, ())]
                found += [*first, *(page for page in inside if page not in first)]
            else:
                found.append(name)
        parts[part] = found
    listed = [page for found in parts.values() for page in found]
    if sorted(listed) != sorted(pages):
        sys.exit(f"error: pages without a place in PARTS, or the other way: {sorted(set(listed) ^ set(pages))}")
    return parts


def as_page(notebook: Path) -> str:
    """A notebook as Markdown."""
    parts = []
    for cell in json.loads(notebook.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def api_page() -> str:
    """Return the page of every public name, with the protocols."""
    lines = ["# API", "", "The names of `ssad`, and the protocols that your own objects keep.", ""]
    named = {name: getattr(ssad, name) for name in ssad.__all__ if name != "__version__"}
    for name, value in sorted(named.items(), key=lambda item: item[0].lower()):
        home = getattr(value, "__module__", None) or "ssad"
        lines += [f"## `ssad.{name}`", "", f"::: {home}.{getattr(value, '__qualname__', name)}", ""]
    for name in MORE:
        lines += [f"## `{name}`", "", f"::: {name}", ""]
    return "\n".join(lines)


def settings(pages: Sequence[str]) -> str:
    """Return mkdocs.yml."""
    lines = [SETTINGS.replace("SOURCE", str(ROOT / "src")).rstrip()]
    for part, found in navigation(pages).items():
        lines += [f"  - {part}:", *(f"      - {page}.md" for page in found)]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--pages", action="store_true", help="only write the pages and mkdocs.yml to OUT")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        work = asked.out if asked.pages else Path(place)
        pages = write_pages(work / "pages")
        (work / "mkdocs.yml").write_text(settings(pages))
        if asked.pages:
            return
        words = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--config-file", str(work / "mkdocs.yml")]
        quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
        done = subprocess.run([*words, "--site-dir", str(asked.out.resolve())], check=False, env=quiet)
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
