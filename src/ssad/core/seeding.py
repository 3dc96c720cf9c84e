"""The only source of randomness: a key gives a generator, so nothing depends on order, workers or batch size.

A key is a sequence of plain values, from the general to the particular, such as (root seed, cell key, "traffic"). Its
parts count with their types: 1, 1.0, True and "1" are four keys.
"""

from __future__ import annotations

import hashlib
import re

import numpy as np


def digest(*key: object) -> str:
    """Hash a key to a name that is the same in every process, on every machine and in every version.

    Args:
        *key: Parts that their `repr` describes completely: texts, numbers, tuples of these.

    Returns:
        64 hex digits (SHA-256).
    """
    # The unit separator cannot occur in a repr, so no two keys join to one text.
    text = "\x1f".join(f"{type(part).__name__}:{part!r}" for part in key)
    return hashlib.sha256(text.encode()).hexdigest()


def seed32(*key: object) -> int:
    """Hash a key to a seed for libraries that take a whole number.

    Args:
        *key: As for `digest`.

    Returns:
        A number in [0, 2^31).
    """
    return int(digest(*key)[:8], 16) & 0x7FFFFFFF


def generator(*key: object) -> np.random.Generator:
    """Return the generator of a key: a new one at each call, always in the same initial state.

    Args:
        *key: As for `digest`.

    Returns:
        A generator whose draws are independent of those of any other key (Philox, the key as its key).
    """
    return np.random.Generator(np.random.Philox(key=int(digest(*key)[:32], 16)))


def file_name(name: str) -> str:
    """Return a name as the name of a file.

    Characters other than letters, digits, ., @ and - become -, followed by a hash that keeps names apart which differ
    only in them.
    """
    safe_name = re.sub(r"[^\w.@-]", "-", name)
    return safe_name if safe_name == name else f"{safe_name}-{digest(name)[:6]}"
