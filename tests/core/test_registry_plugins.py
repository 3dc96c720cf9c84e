"""Systems and detectors of another package: found by its entry points, as pip installs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.command import ssad
from helpers.plugin import install

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.registry import names, resolve


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package can be imported in this process."""
    monkeypatch.syspath_prepend(install(tmp_path))


@pytest.mark.usefixtures("installed")
def test_names_of_a_package_are_found() -> None:
    table = {"blind": "json:loads"}
    found = names("system", table)
    assert found["acme-coast"] == "acme_drivers.systems:Coast"
    assert next(iter(found)) == "blind"
    assert found["blind"] == "json:loads", "what is built in keeps its name"
    assert "acme-seer" not in found
    assert "acme-other" not in found
    assert names("detector", {}) == {"acme-seer": "acme_drivers.systems:Seer"}
    assert resolve("system", table, "blind") is json.loads
    for name in ("acme-coast", "acme-extra"):
        assert resolve("system", table, name).__name__ == "Coast"
    assert resolve("system", table, "acme-inner").__qualname__ == "Outer.Inner"


@pytest.mark.usefixtures("installed")
def test_a_package_that_is_wrong_is_named_in_one_line() -> None:
    with pytest.raises(ConfigError, match=r"acme-gone': acme_drivers\.systems has no 'Cost'; closest: Coast"):
        resolve("system", {}, "acme-gone")
    with pytest.raises(ConfigError, match=r"'acme-broken': .* failed: RuntimeError: no licence \(.*broken\.py:1\)"):
        resolve("system", {}, "acme-broken")
    with pytest.raises(UnknownNameError, match="closest: acme-coast"):
        resolve("system", {}, "acme-cost")


def test_without_the_package_its_names_are_unknown() -> None:
    assert names("detector", {}) == {}
    with pytest.raises(UnknownNameError):
        resolve("system", {}, "acme-coast")


@pytest.mark.usefixtures("installed")
def test_a_system_and_a_detector_of_a_package_are_made_and_listed() -> None:
    """`ssad run` with a system of a package: tests/test_cli.py."""
    from ssad.detectors import make_detector
    from ssad.drivers import make_system

    assert make_system("acme-coast").name == "acme-coast"
    assert make_detector("acme-seer", threshold=0.25).threshold == 0.25
    for kind, name in (("systems", "acme-coast"), ("detectors", "acme-seer")):
        done = ssad("list", kind)
        assert done.returncode == 0
        assert name in [line.split()[0] for line in done.stdout.splitlines()]
