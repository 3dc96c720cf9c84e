"""Command that runs a suite again."""

from __future__ import annotations

import shlex
from typing import Any

from ssad.engine.kind import SuiteBase


def command_of(suite: SuiteBase, device: str | None = None) -> str:
    """The command that runs a suite again; only what differs from the suite of that name or file is spelt out.

    Args:
        suite: What was run.
        device: Where it ran; None: left out, and what is there is taken.
    """
    values, set_values = suite.model_dump(mode="json"), suite.model_dump(mode="json", exclude_defaults=True)
    origin = suite._origin or suite.name
    defaults = values if suite._stock is None else suite._stock  # made without a file: nothing to compare with
    arguments = ["ssad", "run", origin] + (["--device", device] if device else [])
    for key, value in values.items():
        if value != defaults.get(key):
            arguments += ["--set", f"{key}={_inline_yaml(set_values.get(key, value))}"]
    return shlex.join(arguments)


def _inline_yaml(value: Any) -> str:
    """Return a value as YAML in one line; keys without a value are left out of mappings in lists."""
    if isinstance(value, list):
        return f"[{','.join(_inline_yaml(_without_empty(entry)) for entry in value)}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_inline_yaml(entry)}" for key, entry in value.items()) + "}"
    return "null" if value is None else str(value)


def _without_empty(value: Any) -> Any:
    return (
        {key: entry for key, entry in value.items() if entry not in (None, {}, [])}
        if isinstance(value, dict)
        else value
    )
