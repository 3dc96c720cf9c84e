"""The source that a result depends on is found, all of it and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from ssad.core.source import plugin_version, source_files, source_version
from ssad.experiments.driving.kind import Driving
from ssad.experiments.perception.shifts.kind import Detection

Write = Callable[[Mapping[str, str]], None]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Writes modules into a folder that is imported from."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def inner(files: Mapping[str, str]) -> None:
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return inner


def led_to(module: str) -> set[str]:
    return set(source_files(module))


def test_a_module_without_source_leads_to_nothing() -> None:
    for name in ("no_such_module_anywhere", "sys", "math", "no_such_package.anywhere"):
        assert source_files(name) == {}


def test_a_version_has_12_digits(write: Write) -> None:
    write({"own_a.py": ""})
    assert len(source_version("own_a")) == 12
    assert int(source_version("own_a"), 16) >= 0


@pytest.mark.parametrize(
    "text",
    [
        "import own_b",
        "import os, own_b",
        "import own_b as b, sys",
        "from own_b import x",
        "if True:\n\timport own_b",
        "  from own_b import (\n  x as y,\n  z)",
        "from  own_b  import *",
        "from own_b \\\n    import x",
        "from \\\n    own_b import x, \\\n    y",
        "import os, \\\n    own_b",
        "import os; import own_b",
        "import os; from own_b import x",
        "if True: from own_b import x",
        "try: import own_b  # (for speed)\nexcept ImportError: pass",
        "from own_b import (  # noqa (x)\n    x,\n)",
        "def f():\n    from own_b import (\n        x,  # the first (of all), no other\n        y,\n    )",
        "from own_b import(x)",
        "import own_b\r\nimport os\r\n",
        "X = 'own_b.thing:name'",
        'X = "own_b.thing"',
    ],
)
def test_imports_are_followed_wherever_they_stand(write: Write, text: str) -> None:
    write({"own_a.py": f"VALUE = 1\n{text}\n", "own_b/__init__.py": "", "own_b/thing.py": ""})
    found = led_to("own_a")
    assert found in ({"own_a", "own_b"}, {"own_a", "own_b.thing"})
    assert ("own_b.thing" in found) == ("thing" in text)


@pytest.mark.parametrize(
    "text",
    [
        "import_own_b = 1",
        "x = 'own_b'",
        "# no import own_b",
        "import own_bb",
        "x.own_b.y",
        "from os import own_b",
        "import os as own_b",
        "x = 1 if x else from_own_b",
        "'''\nfrom own_b (the second) import (\n    x\n'''",
        "from os import (\n    path,  # import own_b, see there\n)",
    ],
)
def test_what_only_looks_like_an_import_is_none(write: Write, text: str) -> None:
    write({"own_a.py": f"{text}\n", "own_b.py": ""})
    assert led_to("own_a") == {"own_a"}


PACKAGE = {
    "own_p/__init__.py": "from own_p.unseen import x\n",
    "own_p/unseen.py": "",
    "own_p/top.py": "",
    "own_p/sub/__init__.py": "from .near import x\n",
    "own_p/sub/near.py": "",
    "own_p/sub/other.py": "",
    "own_p/sub/deep/__init__.py": "",
    "own_p/sub/deep/far.py": "",
    "own_p/sub/deep/_own.py": "",
}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", set()),
        ("from . import other", {"sub.other"}),
        ("from . import other as another, nothing", {"sub.other"}),
        ("from . import (\n    # near) and\n    other,\n)", {"sub.other"}),
        ("from . \\\n    import other", {"sub.other"}),
        ("from .import other", {"sub.other"}),
        ("from. import other", {"sub.other"}),
        ("from .. import sub, top", {"top"}),
        ("from ... import top", set()),
        ("from .deep import (  # not top, but\n    far,\n)", {"sub.deep", "sub.deep.far"}),
        ("from .other import x", {"sub.other"}),
        ("from .. import top", {"top"}),
        ("from ..top import x", {"top"}),
        ("from .deep import far", {"sub.deep", "sub.deep.far"}),
        ("from .deep.far import x", {"sub.deep", "sub.deep.far"}),
        ("from own_p import top", {"top"}),
        ("from own_p.sub import other", {"sub.other"}),
        ("import own_p.top", {"top"}),
        ("import own_p", set()),
        ("X = {'own_p.sub.deep'}", {"sub.deep", "sub.deep.far"}),
    ],
)
def test_names_in_a_package_are_followed(write: Write, text: str, found: set[str]) -> None:
    """With the packages they are in, but for the top-level one, whose own names are loaded on demand."""
    write(PACKAGE | {"own_p/sub/begin.py": text})
    always = {"own_p.sub.begin", "own_p.sub", "own_p.sub.near"}
    assert led_to("own_p.sub.begin") - {"own_p"} == always | {f"own_p.{name}" for name in found}


def test_a_package_is_followed_from_its_own_place(write: Write) -> None:
    """The dots of a relative import count from the package, in its __init__ as well."""
    write(PACKAGE | {"own_p/sub/__init__.py": "from .deep import far\nfrom .. import top\n"})
    assert led_to("own_p.sub") == {"own_p.sub", "own_p.sub.deep", "own_p.sub.deep.far", "own_p.top"}


def test_the_source_of_a_cell_is_found() -> None:
    """What a drive depends on is in its key, and a report or a detector is not."""
    found = set(source_files(Driving.__module__, excluded_modules=Driving.presentation()))
    for name in (
        "core.safeio",
        "core.registry",
        "core.traces",
        "core.geometry",
        "metrics.driving",
        "metrics.criticality",
        "world.kernels.traffic",
        "drivers.careful.grade",
        "drivers.builtin",
        "world.roads.router",
        "scenarios.dynamic.knowledge.lane_changing",
        "scenarios.dynamic.knowledge._placing",
    ):
        assert f"ssad.{name}" in found, name
    assert not any(name.startswith(("ssad.report", "ssad.training")) for name in found)
    assert "ssad.experiments.driving.page" not in found
    seen = set(source_files(Detection.__module__, excluded_modules=Detection.presentation()))
    for name in (
        "detectors.mono3d.nms",
        "detectors.yolo.decode",
        "scenarios.static.shifts.kernels.falling",
        "metrics.detection_match",
        "experiments.perception.scene_boxes",
        "recorders.drives",
        "rendering.camera.kernels.shade",
        "rendering.street.palette",
        "datasets.nuscenes.truth",
    ):
        assert f"ssad.{name}" in seen, name


def test_any_changed_file_that_is_led_to_changes_the_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    files = {
        "one.py": "import two\nfrom pack import inner\nNAMES = {'x': 'pack.named:X'}\nimport numpy\n",
        "two.py": "def f():\n    from three import (\n        g,\n    )\n",
        "three.py": "g = 1\n",
        "four.py": "h = 1\n",
        "pack/__init__.py": "",
        "pack/inner.py": "from . import beside\n",
        "pack/beside.py": "",
        "pack/named.py": "",
    }
    (tmp_path / "pack").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert set(source_files("one")) == {"one", "two", "three", "pack", "pack.inner", "pack.beside", "pack.named"}
    before = source_version("one")
    for name, text in files.items():
        (tmp_path / name).write_text(text + "# changed\n")
        assert (source_version("one") != before) == (name != "four.py"), name
        (tmp_path / name).write_text(text)
        assert source_version("one") == before


def test_of_an_installed_package_its_own_source_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = tmp_path / "site-packages"
    (site / "own_p").mkdir(parents=True)
    (site / "own_p" / "__init__.py").write_text("")
    (site / "own_p" / "thing.py").write_text("import own_torch\nfrom own_p import near\n")
    (site / "own_p" / "near.py").write_text("")
    (site / "own_torch.py").write_text("")
    monkeypatch.syspath_prepend(str(site))
    assert led_to("own_p.thing") == {"own_p.thing", "own_p.near"}


def test_the_version_of_a_plugin_is_that_of_the_module_which_offers_it(write: Write) -> None:
    table = {"blind": "ssad.drivers.builtin:Blind"}
    assert plugin_version("system", table, "blind?x=1@mine") == ""
    write({"own_q.py": "from ssad.drivers.builtin import Blind\nOBJECT = Blind()\n"})
    first = plugin_version("system", table, "own_q:OBJECT?x=1@mine")
    assert first == source_version("own_q"), "the class of the object is SSAD's, the object is not"
    write({"own_q.py": "from ssad.drivers.builtin import Blind\nOBJECT = Blind()  # edited\n"})
    assert plugin_version("system", table, "own_q:OBJECT") != first
