"""Roots that the tests of the toolbox share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.shifted_roots import options
from helpers.tiny import make_tiny

from ssad.recorders.shifted import write_shifted_roots


@pytest.fixture(scope="session")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of two samples with a sweep between them; not to be changed."""
    return make_tiny(tmp_path_factory.mktemp("tiny") / "clean", size=(320, 180), scenes=2, samples=2, sweeps=1)


@pytest.fixture
def source(clean: Path, tmp_path: Path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(clean, tmp_path / "source"))


@pytest.fixture(scope="session")
def fog(clean: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished root; not to be changed."""
    return write_shifted_roots(options(clean, tmp_path_factory.mktemp("fog")), workers=0)[0].root


@pytest.fixture
def root(fog: Path, tmp_path: Path) -> Path:
    """A copy of the finished root that may be changed."""
    return Path(shutil.copytree(fog, tmp_path / "fog-3", symlinks=True))
