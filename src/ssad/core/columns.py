"""Tables as dataclasses of columns, whose first axis is the rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from itertools import chain
from typing import Any, TypeVar

import numpy as np

Table = TypeVar("Table")


def concatenate(tables: Sequence[Table]) -> Table:
    """Return tables of one class as one table, row below row.

    Args:
        tables: At least one. Their fields are arrays, tensors or tuples.
    """
    kind: Any = type(tables[0])
    names = [column.name for column in fields(kind)]
    table: Table = kind(**{name: _column([getattr(part, name) for part in tables]) for name in names})
    return table


def _column(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], tuple):
        return tuple(chain.from_iterable(parts))
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    # Imported late: tables of arrays must not load torch.
    import torch

    return torch.cat(list(parts))
