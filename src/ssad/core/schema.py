"""What the schemas of suites share."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Names = Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1)]
"""One name or more."""


class Schema(BaseModel):
    """Keys of a suite: no others are known, types are as they stand there, and nothing changes."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
