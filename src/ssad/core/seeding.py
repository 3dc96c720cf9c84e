"""The only source of randomness: a key gives a generator, so nothing depends on order, workers or batch size."""

from __future__ import annotations

import hashlib

import numpy as np


def digest(*key: object) -> str:
    """64 hex digits that depend on the key's parts and their types alone (stable over processes and versions)."""
    text = "\x1f".join(f"{type(part).__name__}:{part!r}" for part in key)
    return hashlib.sha256(text.encode()).hexdigest()


def seed32(*key: object) -> int:
    """A seed in [0, 2^31) for the key."""
    return int(digest(*key)[:8], 16) & 0x7FFFFFFF


def generator(*key: object) -> np.random.Generator:
    """A generator of its own for the key, e.g. (root seed, cell key, "traffic")."""
    return np.random.Generator(np.random.Philox(key=int(digest(*key)[:32], 16)))
