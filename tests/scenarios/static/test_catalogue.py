"""The YAML forms of perturbations: what they mean, how they are written back, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from ssad.core.errors import ConfigError, FormatError
from ssad.scenarios.static.catalogue import (
    FAMILIES,
    RADII,
    PerturbationTable,
    parse_perturbation,
    registered_names,
)
from ssad.scenarios.static.physical.textures.card import SHIPPED

OWN = "helpers.own_perturbations"


@pytest.mark.parametrize(
    ("form", "family", "title", "severities"),
    [
        ("fog", "shift", "fog", [(3, "fog")]),
        ({"fog": 2}, "shift", "fog", [(2, "fog")]),
        ({"fog": [1, 5]}, "shift", "fog", [(1, "fog"), (5, "fog")]),
        ({"shift": "fog", "severity": 4}, "shift", "fog", [(4, "fog")]),
        ({"shift": {"name": "fog", "label": "mist"}}, "shift", "mist", [(3, "mist")]),
        ("fog@mist", "shift", "mist", [(3, "mist")]),
        ("frozen", "fault", "frozen", [(3, "frozen")]),
        ("pgd?steps=2", "digital", "pgd?steps=2", [(3, "pgd?steps=2")]),
        ({"pgd": {"steps": 2}}, "digital", "pgd?steps=2", [(3, "pgd?steps=2")]),
        ({"attack": "pgd", "radius": 4}, "digital", "pgd?radius=4", [(1, "pgd?radius=4")]),
        ("grey", "texture", "grey", [(1, "grey")]),
        ({"texture": "grey"}, "texture", "grey", [(1, "grey")]),
        ("night", "light", "night", [(1, "night")]),
        ("laser", "light", "laser", [(3, "laser")]),
        ({"laser": {"watts": 2.0}}, "light", "laser?watts=2", [(1, "laser?watts=2")]),
        (f"{OWN}:Haze", "shift", f"{OWN}:Haze", [(3, f"{OWN}:Haze")]),
        ({f"{OWN}:Haze": {"share": 0.2, "label": "haze"}}, "shift", "haze", [(3, "haze")]),
        ({"fault": f"{OWN}:Smear", "width": 8}, "fault", f"{OWN}:Smear?width=8", [(1, f"{OWN}:Smear?width=8")]),
        (f"{OWN}:Mirror", "own", f"{OWN}:Mirror", [(1, "mirror")]),
    ],
)
def test_a_form_means_a_perturbation(form: Any, family: str, title: str, severities: list[tuple[int, str]]) -> None:
    entry = parse_perturbation(form)
    assert (entry.family, entry.title) == (family, title)
    made = entry.at([3])
    assert [(one.severity, one.name) for one in made] == severities
    written = entry.model_dump(mode="json")
    again = parse_perturbation(written)
    assert again == entry, written
    assert again.model_dump(mode="json") == written


@pytest.mark.parametrize(
    ("options", "settings"),
    [
        ({"flip": True, "at": [1, 2]}, "at=[1,2]&flip=true"),
        ({"flip": False, "share": 0.5}, "flip=false&share=0.5"),
        ({"of": {"a": 1}, "kind": "near"}, 'kind=near&of={"a":1}'),
    ],
)
def test_a_title_names_the_settings_and_is_read_again(options: dict[str, Any], settings: str) -> None:
    entry = parse_perturbation({f"{OWN}:Mirror": options})
    assert entry.title == f"{OWN}:Mirror?{settings}"
    again = parse_perturbation(entry.title)
    assert (again.name, again.options) == (entry.name, options)


def test_an_object_that_is_made_already_has_no_severities() -> None:
    assert [one.severity for one in parse_perturbation(f"{OWN}:MIRROR").at([1, 5])] == [1]


def test_every_registered_name_is_made_and_written_as_itself() -> None:
    names = registered_names()
    assert set(names.values()) >= set(FAMILIES)
    for name, family in names.items():
        entry = parse_perturbation(name)
        assert entry.family == family
        assert entry.model_dump(mode="json") == name
        made = {one.family for one in entry.at([1, 5])}
        assert made <= {family} or (family == "own" and made <= {"texture", "light", "sign"})


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("attack-pgd", "pgd"),
        ("attack-pgd-2", "pgd?steps=2"),
        ("wear-grey", "grey"),
        ("wear-das-yolov5n-twinford", "das-yolov5n-twinford"),
        ("shine-laser", "laser"),
    ],
)
def test_old_spellings_work_with_a_warning_of_one_line(old: str, new: str) -> None:
    with pytest.warns(FutureWarning, match=r"old spelling.*write") as caught:
        assert parse_perturbation(old) == parse_perturbation(new)
    assert [str(one.message).count("\n") for one in caught] == [0]


@pytest.mark.parametrize(
    ("form", "words"),
    [
        ("fogg", "closest: fog"),
        ("attack-pgd-0", "unknown perturbation 'attack-pgd-0'"),
        ({"fog": 9}, "less than or equal to 5"),
        ({"fog": True}, "severities or settings"),
        ({"fog": {"depth": 2}}, "has no settings; remove depth"),
        ({"grey": 3}, "has no severities"),
        ({"pgd": {"stepz": 2}}, "there is no option 'stepz'"),
        ({"pgd": {"radius": -1}}, "greater than 0"),
        ({"pgd": {"loss": "marginn"}}, "margin"),
        ({"texture": "gray"}, "closest: grey"),
        ({"texture": "missing.json"}, "missing.json: no such file"),
        ({"texture": "grey", "light": "laser"}, "texture and light in one perturbation"),
        ({"fog": 3, "rain": 2}, "settings stand below the name"),
        ({"texture": 3}, "a name, a path or module:object"),
        (3, "no perturbation"),
        ({}, "no perturbation"),
        (f"{OWN}:Wrong", "none of the methods"),
        (f"{OWN}:Missing", "has no 'Missing'"),
        ({"fault": f"{OWN}:Haze"}, "none of the methods apply, observe, command"),
        ({f"{OWN}:Smear": {"height": 2}}, "height"),
        ({"perturbation": f"{OWN}:Smear"}, "lacks name, family"),
        ("./nothing-here", "neither the card of a texture"),
    ],
)
def test_a_wrong_form_is_refused_in_words(form: Any, words: str) -> None:
    with pytest.raises((ConfigError, FormatError), match=words) as caught:
        parse_perturbation(form).at([3])
    assert "\n" not in str(caught.value)


def test_severities_of_an_attack_are_radii_unless_one_is_given() -> None:
    radii = [one.spec.radius for one in parse_perturbation("pgd").at([1, 2, 3, 4, 5])]  # type: ignore[attr-defined]
    assert radii == list(RADII)
    (given,) = parse_perturbation({"pgd": {"radius": 3}}).at([1, 5])
    assert given.spec.radius == 3.0  # type: ignore[attr-defined]


def test_a_file_is_found_beside_the_suite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for suffix in (".json", ".png"):
        shutil.copy(SHIPPED / f"das-yolov5n-twinford{suffix}", tmp_path / f"mine{suffix}")
    table = PerturbationTable.model_validate({"perturbations": [{"texture": "mine.json"}, "none", "fog"]})
    assert [entry.title for entry in table.perturbations] == ["mine", "fog"]
    (worn, _) = table.with_files_beside(tmp_path).conditions()
    assert (worn.name, worn.family) == ("mine", "texture")
    assert worn.version() == parse_perturbation("das-yolov5n-twinford").make(1).version() != ""
    monkeypatch.chdir(tmp_path)
    assert parse_perturbation("mine.json").make(1).version() == worn.version()


def test_two_of_a_name_need_labels() -> None:
    pair = [{"fog": 3}, {"fog": 3}]
    with pytest.raises(ConfigError, match="fog appears twice at severity 3"):
        PerturbationTable.model_validate({"perturbations": pair}).conditions()
    labelled = [{"fog": 3}, {"fog": {"severity": 3, "label": "other"}}]
    assert len(PerturbationTable.model_validate({"perturbations": labelled}).conditions()) == 2
    with pytest.raises(ValidationError):
        PerturbationTable.model_validate({"perturbations": ["fog"], "severities": [0]})
