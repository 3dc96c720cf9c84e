"""OpenSCENARIO documents: expressions, parameters, constraints and catalogues; errors name file and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from ssad.core.errors import FormatError
from ssad.interchange.openscenario_document import ConstraintError, read_document, resolve

HEAD = '<?xml version="1.0"?>\n<OpenSCENARIO>\n'


def declared(name: str, value: str, constraints: str = "") -> str:
    attributes = f'name="{name}" parameterType="double" value="{value}"'
    return f"<ParameterDeclaration {attributes}>{constraints}</ParameterDeclaration>\n"


def attributes(folder: Path, declarations: str, text: str, **assigned: str) -> dict[str, str]:
    """The attributes of the element <Part> of a document with declarations."""
    path = folder / "a.xosc"
    path.write_text(f"{HEAD}<ParameterDeclarations>\n{declarations}</ParameterDeclarations>\n{text}\n</OpenSCENARIO>")
    root, _ = resolve(read_document(path), path, assigned)
    part = root.find(".//Part")
    assert part is not None
    return dict(part.items())


def test_parameters_and_expressions_are_put_in(tmp_path: Path) -> None:
    """Whole and in expressions, in any order of declaration, with a value from outside, escaped, and as names."""
    declarations = declared("speed", "${$kph / 3.6}") + declared("kph", "50") + declared("who", "Target")
    part = '<Part a="$speed" b="${-$kph + pow(2, 3)}" c="\\$kph" d="plain" name="${$who + drives on}" h="$pi"/>'
    values = attributes(tmp_path, declarations, part)
    assert float(values["a"]) == pytest.approx(50 / 3.6)
    assert (values["b"], values["c"], values["d"]) == ("-42", "$kph", "plain")
    assert values["name"] == "Targetdrives on"
    assert float(values["h"]) == pytest.approx(3.14159265)
    assert float(attributes(tmp_path, declarations, part, kph="72")["a"]) == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("declarations", "part", "message"),
    [
        (declared("a", "1"), '<Part x="$b"/>', "a.xosc:6: Part: x: parameter $b is not declared; closest: $a"),
        (declared("a", "0"), '<Part x="${1 / $a}"/>', "a.xosc:6: Part: x: expression '1 / $a': division by zero"),
        (
            declared("gap", "1"),
            '<Part x="${$gap + $gop}"/>',
            "a.xosc:6: Part: x: expression '$gap + $gop': parameter $gop is not declared; closest: $gap",
        ),
        (declared("a", "${$b}") + declared("b", "$a"), "<Part/>", "a.xosc:4: ParameterDeclaration: the parameter"),
        (declared("a", "1"), '<Part x="$a$a"/>', "a.xosc:6: Part: x: '$a$a' is neither $parameter nor"),
    ],
)
def test_what_has_no_value_is_refused_with_its_line(declarations: str, part: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError) as refused:
        attributes(tmp_path, declarations, part)
    assert message in str(refused.value)
    with pytest.raises(FormatError, match="declares no parameter 'z'"):
        attributes(tmp_path, declared("a", "1"), "<Part/>", z="1")


def test_long_chains_of_parameters_are_refused(tmp_path: Path) -> None:
    chain = "".join(declared(f"a{number}", f"$a{number + 1}") for number in range(49)) + declared("a49", "7")
    assert attributes(tmp_path, chain, '<Part x="$a0"/>')["x"] == "7"
    chain = "".join(declared(f"a{number}", f"$a{number + 1}") for number in range(1000)) + declared("a1000", "7")
    with pytest.raises(FormatError, match=r"a\.xosc:\d+: ParameterDeclaration: parameter 'a50' ends a chain"):
        attributes(tmp_path, chain, '<Part x="$a0"/>')


def test_deep_nesting_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"a\.xosc:6: <b> is nested deeper than 200 levels"):
        attributes(tmp_path, declared("a", "1"), "<b>" * 400 + "</b>" * 400)


def test_one_group_of_constraints_must_hold(tmp_path: Path) -> None:
    """Groups are alternatives; the constraints of a group hold together, and may be expressions."""
    groups = (
        '<ConstraintGroup><ValueConstraint rule="greaterThan" value="0"/>'
        '<ValueConstraint rule="lessOrEqual" value="${2 * 30}"/></ConstraintGroup>'
        '<ConstraintGroup><ValueConstraint rule="equalTo" value="-1"/></ConstraintGroup>'
    )
    for value in ("60", "0.5", "-1.0"):
        attributes(tmp_path, declared("v", value, groups), "<Part/>")
    for value in ("0", "61", "-2"):
        with pytest.raises(ConstraintError, match=r"a\.xosc:4: .*parameter 'v' is .*, but must be greaterThan 0 and"):
            attributes(tmp_path, declared("v", value, groups), "<Part/>")


CATALOGUE = f"""{HEAD}<Catalog name="Cars">
<Vehicle name="car"><ParameterDeclarations><ParameterDeclaration name="length" parameterType="double" value="4"/>
</ParameterDeclarations><Part length="$length" width="${{$length / 2}}"/></Vehicle>
</Catalog></OpenSCENARIO>"""


def test_catalogue_entries_take_assigned_parameters(tmp_path: Path) -> None:
    """A catalogue is found by its name in the folders beside the file; without an assignment, the default counts."""
    (tmp_path / "cars").mkdir()
    (tmp_path / "cars" / "anything.xosc").write_text(CATALOGUE)
    locations = '<CatalogLocations><VehicleCatalog><Directory path="./cars"/></VehicleCatalog></CatalogLocations>'
    reference = '<CatalogReference catalogName="Cars" entryName="{}">{}</CatalogReference>'
    assignment = (
        '<ParameterAssignments><ParameterAssignment parameterRef="{}" value="${{$l + 1}}"/></ParameterAssignments>'
    )
    given = declared("l", "5")
    assert attributes(tmp_path, given, locations + reference.format("car", "")) == {"length": "4", "width": "2"}
    text = locations + reference.format("car", assignment.format("length"))
    assert attributes(tmp_path, given, text) == {"length": "6", "width": "3"}
    with pytest.raises(FormatError, match="catalogue 'Cars' has no entry 'van'; it has: car"):
        attributes(tmp_path, given, locations + reference.format("van", ""))
    with pytest.raises(FormatError, match="entry 'car' has no parameter 'height'"):
        attributes(tmp_path, given, locations + reference.format("car", assignment.format("height")))
