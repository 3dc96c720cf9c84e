"""Messages are one line, and a wrong name is answered with those closest to it."""

from __future__ import annotations

from ssad.core.errors import ConfigError, SSADError, UnknownNameError, unknown_name


def test_a_message_is_one_line() -> None:
    assert str(SSADError("first\n   second\tthird ")) == "first second third"


def test_the_three_closest_names_are_shown_best_first() -> None:
    error = unknown_name("town", "Twinfrod", ["Larkhill", "Twin", "Twinford", "Winford", "Crossgate"])
    assert str(error) == "unknown town 'Twinfrod'; closest: Twinford, Winford, Twin (see: ssad list towns)"
    assert isinstance(error, UnknownNameError)
    assert isinstance(error, ConfigError)
    assert str(unknown_name("town", "x", [])) == "unknown town 'x' (see: ssad list towns)"
    assert str(unknown_name("town", "x", ["far away"])) == "unknown town 'x'; closest: far away (see: ssad list towns)"
