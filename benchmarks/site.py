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
from pathlib import Path

import ssad

ROOT = Path(__file__).parents[1]
TOP = ("ARCHITECTURE", "CONTRIBUTING", "CHANGELOG", "SECURITY")  # pages at the top of the repository, besides README
PARTS = {
    "Start": ("index", "install", "concepts", "python", "notebooks/drive", "notebooks/perceive"),
    "Drive": ("loop", "drivers", "scenarios", "generators", "how_often", "careful", "gap"),
    "Perceive": ("detectors", "shifts", "attacks", "physical", "camera"),
    "What the numbers are": ("metrics", "results", "accuracy", "digital", "physical_results", "benchmarks"),
    "Other programs": ("interchange", "carla"),
    "Reference": ("api", "stability", *TOP),
}
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
    """All pages into a folder, their links as they are there; names of the pages."""
    shutil.copytree(ROOT / "docs", folder, ignore=shutil.ignore_patterns("*.ipynb"))
    (folder / "index.md").write_text((ROOT / "README.md").read_text())
    for name in TOP:
        (folder / f"{name}.md").write_text((ROOT / f"{name}.md").read_text())
    for notebook in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        (folder / "notebooks" / f"{notebook.stem}.md").write_text(as_page(notebook))
    (folder / "api.md").write_text(api_page())
    for page in folder.rglob("*.md"):
        parts = re.split(r"\]\(([^)\s]+)\)", page.read_text())  # text, target, text, target, ...
        page.write_text("".join(moved(part, page, folder) if k % 2 else part for k, part in enumerate(parts)))
    return sorted(page.relative_to(folder).with_suffix("").as_posix() for page in folder.rglob("*.md"))


def moved(target: str, page: Path, folder: Path) -> str:
    """A link as it is on the site; what is not there (source, licence) is left as text."""
    file, mark, anchor = target.partition("#")
    if target.startswith("http") or not file:
        return f"]({target})"
    file = file.removeprefix("docs/").removeprefix("../").replace("README.md", "index.md")
    if file.endswith(".ipynb"):
        file = file.removesuffix(".ipynb") + ".md"
    found = (page.parent / file).exists() or (folder / file).exists()
    return f"]({file}{mark}{anchor})" if found else "]"


def as_page(notebook: Path) -> str:
    """A notebook as Markdown."""
    parts = []
    for cell in json.loads(notebook.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def api_page() -> str:
    """Every public name, with the rest of `Results` and the protocols."""
    lines = ["# API", "", "The names of `ssad`, and the protocols that your own objects keep.", ""]
    named = {name: getattr(ssad, name) for name in ssad.__all__ if name != "__version__"}
    for name, value in sorted(named.items(), key=lambda item: item[0].lower()):
        home = getattr(value, "__module__", None) or "ssad"
        lines += [f"## `ssad.{name}`", "", f"::: {home}.{getattr(value, '__qualname__', name)}", ""]
    for name in MORE:
        lines += [f"## `{name}`", "", f"::: {name}", ""]
    return "\n".join(lines)


def settings() -> str:
    """mkdocs.yml."""
    lines = [SETTINGS.replace("SOURCE", str(ROOT / "src")).rstrip()]
    for part, pages in PARTS.items():
        lines += [f"  - {part}:", *(f"      - {page}.md" for page in pages)]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--pages", action="store_true", help="only write the pages and mkdocs.yml to OUT")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        work = asked.out if asked.pages else Path(place)
        pages = write_pages(work / "pages")
        (work / "mkdocs.yml").write_text(settings())
        listed = [page for part in PARTS.values() for page in part]
        if sorted(listed) != pages:
            sys.exit(f"error: pages without a place in PARTS, or the other way: {sorted(set(listed) ^ set(pages))}")
        if asked.pages:
            return
        words = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--config-file", str(work / "mkdocs.yml")]
        quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
        done = subprocess.run([*words, "--site-dir", str(asked.out.resolve())], check=False, env=quiet)
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
