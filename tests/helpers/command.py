"""The command `ssad`, in this process or in one of its own."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess
from unittest import mock

import pytest

from ssad import cli


def ssad(*words: str | Path) -> CompletedProcess[str]:
    """Run in this process, which starts at once, with one worker unless the words ask for more."""
    out, errors = io.StringIO(), io.StringIO()
    argv = ["ssad", *map(str, words)]
    # a driving system of the user's is looked for in the working folder: not by the tests after this one
    with (
        mock.patch.object(sys, "argv", argv),
        mock.patch.object(sys, "path", [*sys.path]),
        mock.patch("ssad.engine.pool.default_workers", return_value=1),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(errors),
        pytest.raises(SystemExit) as end,
    ):
        cli.main()
    code = end.value.code or 0
    assert isinstance(code, int)
    return CompletedProcess(argv, code, out.getvalue(), errors.getvalue())


def ssad_process(*words: str, cwd: Path | None = None, **environment: str) -> CompletedProcess[str]:
    """Run as a user does: in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "ssad", *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
        env=os.environ | environment,
        timeout=550,
    )
