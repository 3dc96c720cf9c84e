"""The door for files: what is hostile or broken is refused in one line; what is written is whole."""

from __future__ import annotations

import io
import os
import pickle
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError, StoreError

plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "S", "Zs"]), max_size=12),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text("abcxyz01-_~. :", min_size=1, max_size=6), inner, max_size=4)
    ),
    max_leaves=20,
)


@given(plain)
def test_yaml_round_trip(data: object) -> None:
    assert safeio.parse_yaml(safeio.dump_yaml(data)) == data


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("no", "no"),
        ("on", "on"),
        ("1:30", "1:30"),
        ("0x1f", 31),
        ("012", 12),
        ("-.inf", -np.inf),
        ("true", True),
        ("2001-01-01", "2001-01-01"),
        ("~", None),
        ("", None),
        ('"1e-3"', "1e-3"),
        ("[blind, my.module:Driver]", ["blind", "my.module:Driver"]),
    ],
)
def test_yaml_scalars(text: str, value: object) -> None:
    assert safeio.parse_yaml(text) == value


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "\n".join(
    f"{name}: &{name} [{','.join(['*' + before] * 9)}]" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "YAML bomb"),
        ("[" * 100_000, "nested deeper"),
        ("a: &x [*x]", "contains it"),
        ("a: 1\nb: 2\na: 3", "f.yaml:3: key 'a' appears twice"),
        ("a: !!python/object/apply:os.system [id]", "tag"),
        ("a: .nan", "NaN"),
        ("a: 1\nb: [", "f.yaml:3"),
        ("a: 1\n---\nb: 2", "another document"),
        ("a: &x {b: 1}\nc:\n  <<: *x", "merge"),
        ("? [a]\n: 1", "key must be"),
        ("a: \x00", "not valid YAML"),
        ("a: " + "9" * 5000, "not a valid int"),
    ],
)
def test_yaml_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(FormatError) as caught:
        safeio.parse_yaml(text, "f.yaml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_yaml_alias_of_moderate_size_is_fine() -> None:
    assert safeio.parse_yaml("a: &x [1, 2]\nb: *x") == {"a": [1, 2], "b": [1, 2]}


def test_document_errors_name_line_and_key() -> None:
    document = safeio.parse_yaml_document("a: 1\nlist:\n  - x: 1\n  - y: 2\n", "f.yaml")
    assert str(document.error(("list", 1, "y"), "bad")) == "f.yaml:4: list[1].y: bad"
    assert document.line(("list", 1, "missing")) == 4
    assert isinstance(document.error((), "bad"), ConfigError)


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', "[NaN]", "[Infinity]", "[1,", "[" * 100_000, ""])
def test_json_refused(text: str) -> None:
    with pytest.raises(FormatError, match=r"f\.json"):
        safeio.parse_json(text, "f.json")


def test_json_is_canonical() -> None:
    assert safeio.dump_json({"b": 1, "a": [1.5, None]}) == '{"a":[1.5,null],"b":1}'
    with pytest.raises(ValueError, match="JSON"):
        safeio.dump_json({"a": float("nan")})


LAUGHS = '<!DOCTYPE z [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><z>&b;</z>'
OUTSIDE = '<!DOCTYPE z [<!ENTITY a SYSTEM "file:///etc/passwd">]><z>&a;</z>'


@pytest.mark.parametrize("text", [LAUGHS, OUTSIDE, '<!DOCTYPE z SYSTEM "http://example.org/z.dtd"><z/>'])
def test_xml_with_entities_is_refused(text: str) -> None:
    with pytest.raises(FormatError, match=r"f\.xml: refused"):
        safeio.parse_xml(text, "f.xml")


def test_xml_broken_names_the_line() -> None:
    with pytest.raises(FormatError, match=r"f\.xml:2: not valid XML"):
        safeio.parse_xml("<a>\n<b></a>", "f.xml")
    assert safeio.parse_xml("<a><b/></a>").tag == "a"


def test_npz_round_trip_has_fixed_bytes(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.zeros((0, 4), np.int32), "c": np.array(True)}
    safeio.save_npz(tmp_path / "x.npz", arrays)
    loaded = safeio.load_npz(tmp_path / "x.npz")
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == array.dtype
    assert safeio.npz_bytes(arrays) == (tmp_path / "x.npz").read_bytes()
    with np.load(tmp_path / "x.npz", allow_pickle=False) as readable:
        assert sorted(readable) == ["a", "b", "c"]


def test_npz_refuses_pickles(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", a=np.array([{"x": 1}], dtype=object))
    with pytest.raises(FormatError, match="pickle"):
        safeio.load_npz(tmp_path / "x.npz")
    (tmp_path / "y.npz").write_bytes(pickle.dumps({"x": 1}))
    with pytest.raises(FormatError, match="not a readable npz"):
        safeio.load_npz(tmp_path / "y.npz")


def test_npz_refuses_a_header_that_lies(tmp_path: Path) -> None:
    member = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)}
    np.lib.format.write_array_header_1_0(member, header)
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("a.npy", member.getvalue())
    with pytest.raises(FormatError, match="cut short"):
        safeio.load_npz(tmp_path / "x.npz")


def test_npz_refuses_what_unpacks_too_large(tmp_path: Path) -> None:
    safeio.save_npz(tmp_path / "x.npz", {"a": np.zeros(1 << 20)})
    with pytest.raises(FormatError, match="unpacks to more"):
        safeio.load_npz(tmp_path / "x.npz", limit=1 << 20)


@given(st.integers(0, 400))
def test_npz_truncated_is_one_line(cut: int) -> None:
    data = safeio.npz_bytes({"a": np.arange(50)})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.npz"
        path.write_bytes(data[: min(cut, len(data) - 1)])
        with pytest.raises(FormatError):
            safeio.load_npz(path)


def test_missing_large_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        safeio.read_yaml(tmp_path / "none.yaml")
    (tmp_path / "big.yaml").write_text("a" * 100)
    with pytest.raises(FormatError, match="larger than the limit"):
        safeio.read_yaml(tmp_path / "big.yaml", limit=10)
    (tmp_path / "bin.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="not UTF-8"):
        safeio.read_yaml(tmp_path / "bin.yaml")
    with pytest.raises(FormatError, match="cannot be read"):
        safeio.read_yaml(tmp_path)


def test_atomic_write_leaves_the_old_file_when_it_fails(tmp_path: Path) -> None:
    path = tmp_path / "a" / "x.txt"
    safeio.write_atomic(path, "old")

    class StopError(Exception):
        pass

    def broken() -> None:
        with safeio.atomic_path(path) as temporary:
            temporary.write_text("half")
            raise StopError

    with pytest.raises(StopError):
        broken()
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["x.txt"]


def test_unwritable_places_are_store_errors(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        safeio.write_atomic(tmp_path / "file" / "x", "data")
    with pytest.raises(StoreError, match="choose another folder"):
        safeio.make_folder(tmp_path / "file" / "sub")


def test_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSAD_HOME", "/somewhere")
    assert safeio.home() == Path("/somewhere")
    monkeypatch.delenv("SSAD_HOME")
    assert safeio.home() == Path.home() / ".local/share/ssad"
