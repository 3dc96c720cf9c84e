"""Reports of imports: their lines, their text of 80 columns, and the refusal of doubts."""

from __future__ import annotations

from pathlib import Path

import pytest

from ssad.core.errors import FormatError
from ssad.core.import_report import ImportReport, report_path


def report() -> ImportReport:
    result = ImportReport("a.xml", contents=["3 lanes"])
    for number in range(6):
        result.omit("trees", f"road {number}")
    result.note("a step is joined", count=3)
    result.doubt("a road ends nowhere", "road 7")
    return result


def test_lines_name_the_first_places_and_count_the_rest() -> None:
    assert report().lines() == [
        "3 lanes",
        "a step is joined (3 times)",
        "not carried over: trees (6 times): road 0, road 1, road 2, road 3 and 2 more",
        "doubtful: a road ends nowhere: road 7",
    ]
    assert report().lines(examples=None)[2].endswith("road 4, road 5")


def test_text_has_80_columns_and_loses_no_word() -> None:
    text = report().text("scenario a: written to " + "folder/" * 15, examples=None)
    assert max(len(line) for line in text.splitlines() if "folder/" not in line) <= 80
    assert text.split() == " ".join(["scenario a: written to", "folder/" * 15, *report().lines(None)]).split()
    assert "\n  road 5" in text or "\n  5" in text


def test_the_report_of_a_map_joins_that_of_its_scenario() -> None:
    both = report()
    both.extend(report())
    assert both.contents == ["3 lanes", "3 lanes"]
    assert "not carried over: trees (12 times)" in both.lines()[3]
    assert len(both.doubts["a road ends nowhere"]) == 2


def test_doubts_alone_are_refused() -> None:
    with pytest.raises(FormatError, match=r"^a\.xml: a road ends nowhere: road 7; correct the file"):
        report().refuse_doubts(FormatError)
    ImportReport("a.xml", omissions={"trees": [""]}).refuse_doubts(FormatError)


def test_the_report_lies_beside_the_result() -> None:
    assert report_path(Path("b/out.yaml")) == Path("b/out.import.txt")
