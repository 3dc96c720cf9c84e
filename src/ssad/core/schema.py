"""Shared schema of suites, and validated construction of dataclasses from their values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from ssad.core.errors import ConfigError

T = TypeVar("T")

Names = Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1)]
"""One name or more."""


class Schema(BaseModel):
    """Base of suite sections: unknown keys are refused, types are strict, instances are frozen."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


def _check_order(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError("the first is greater than the second")
    return span


VALUES = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")
"""Of a dataclass of pydantic: types are as they stand in a suite, and numbers are finite."""

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Least = Annotated[Number, Field(ge=0.0)]
Above = Annotated[Number, Field(gt=0.0)]
Part = Annotated[Number, Field(ge=0.0, le=1.0)]
Whole = Annotated[int, Field(strict=True, ge=1)]
Two = Annotated[tuple[T, T], Field(strict=False)]
"""A pair, which is a list in YAML."""
Span = Annotated[tuple[T, T], Field(strict=False), AfterValidator(_check_order)]
"""The least and the greatest."""


def build_validated(
    factory: Callable[..., T],
    values: Mapping[str, Any],
    *,
    subject: str,
    kind: type | None = None,
    name_field: str = "name",
) -> T:
    """A dataclass of pydantic with values that a user wrote.

    Args:
        factory: The dataclass, or what makes one.
        values: By field.
        subject: What messages call it, such as "attack das".
        kind: The dataclass, if `factory` is not.
        name_field: The field that is no value: what it is called.

    Raises:
        ConfigError: One line: what, which key, and what is wrong with its value.
    """
    settings = [setting.name for setting in fields(kind or factory) if setting.init and setting.name != name_field]  # type: ignore[arg-type]
    for key in values:
        if key not in settings:
            raise ConfigError(f"{subject}: there is no setting '{key}'; it has {', '.join(settings)}")
    try:
        return factory(**values)
    except ValidationError as error:
        first_error = error.errors(include_url=False)[0]
        key, input_text = ".".join(map(str, first_error["loc"])), repr(first_error["input"])
        reason = first_error["msg"].removeprefix("Value error, ").replace("tuple", "list")  # as it stands in a suite
        shortened = input_text if len(input_text) < 60 else input_text[:57] + "..."
        raise ConfigError(f"{subject}: " + (f"{key}={shortened}: {reason}" if key else reason)) from None
