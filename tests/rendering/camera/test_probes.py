"""Memory of environment probes."""

from __future__ import annotations

from ssad.rendering.camera.probes import MAX_PROBES, PROBES_IN_MEMORY, ProbeStore


def missing_probes(store: ProbeStore, places: range) -> int:
    """Use the probes of places in turn, and return the number of those that were not in memory."""
    missing = 0
    for place in places:
        texels = store.texels.pop(place, None)
        missing += texels is None
        store.keep_texels(place, texels or object())
    return missing


def test_cameras_that_take_turns_keep_their_probes() -> None:
    store, places = ProbeStore(), range(PROBES_IN_MEMORY + 16)
    rounds = [missing_probes(store, places) for _ in range(4)]
    assert rounds[0] == len(places)
    assert rounds[-1] == 0


def test_a_long_drive_keeps_few_probes() -> None:
    store = ProbeStore()
    assert missing_probes(store, range(1000)) == 1000
    assert len(store.texels) == PROBES_IN_MEMORY


def test_no_number_of_cameras_fills_the_memory() -> None:
    store = ProbeStore()
    for _ in range(12):
        missing_probes(store, range(MAX_PROBES + 100))
    assert len(store.texels) <= MAX_PROBES
    assert len(store.dropped) <= MAX_PROBES
