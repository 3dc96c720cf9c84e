"""The door for files: what is hostile or broken is refused in one line; what is written is whole."""

from __future__ import annotations

import inspect
import io
import math
import os
import pickle
import tempfile
import threading
import zipfile
from collections.abc import Callable
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
        ("a: " + "9" * 5000, "a number of 5000 digits"),
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


@pytest.mark.parametrize(("depth", "is_refused"), [(200, False), (201, True), (100_000, True)])
def test_xml_nested_too_deeply_is_refused(depth: int, is_refused: bool) -> None:
    text = "<a>" * depth + "</a>" * depth
    if is_refused:
        with pytest.raises(FormatError, match=r"f\.xml: <a> is nested deeper than 200 levels"):
            safeio.parse_xml(text, "f.xml")
    else:
        assert safeio.parse_xml(text, "f.xml").tag == "a"


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
        safeio.read_yaml_document(tmp_path / "none.yaml")
    (tmp_path / "big.yaml").write_text("a" * 100)
    with pytest.raises(FormatError, match="larger than the limit"):
        safeio.read_yaml_document(tmp_path / "big.yaml", limit=10)
    (tmp_path / "bin.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="not UTF-8"):
        safeio.read_yaml_document(tmp_path / "bin.yaml")
    with pytest.raises(FormatError, match="cannot be read"):
        safeio.read_yaml_document(tmp_path)


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
    assert safeio.home_folder() == Path("/somewhere")
    monkeypatch.delenv("SSAD_HOME")
    assert safeio.home_folder() == Path.home() / ".local/share/ssad"


def test_limits(tmp_path: Path) -> None:
    """A file of the limit is read, a byte more is not; and the limits that hold unless others are given."""
    (tmp_path / "a").write_bytes(b"x" * 100)
    assert safeio.read_bytes(tmp_path / "a", limit=100) == b"x" * 100
    with pytest.raises(FormatError, match=r"a: larger than the limit of 9\.44138e-05 MiB"):
        safeio.read_bytes(tmp_path / "a", limit=99)
    (tmp_path / "empty").touch()
    assert safeio.read_bytes(tmp_path / "empty", limit=1 << 60) == b"", "no room is made for what is not there"
    for limit in (4 << 20, (2 << 20) + 7):
        os.mkfifo(tmp_path / f"pipe{limit}")
        writer = threading.Thread(target=(tmp_path / f"pipe{limit}").write_bytes, args=(b"x" * ((2 << 20) + 7),))
        writer.start()
        assert len(safeio.read_bytes(tmp_path / f"pipe{limit}", limit=limit)) == (2 << 20) + 7, "a pipe, in parts"
        writer.join()
    mebibytes = {
        function: inspect.signature(function).parameters["limit"].default / 2**20
        for function in (
            safeio.read_bytes,
            safeio.read_text,
            safeio.read_yaml_document,
            safeio.read_json,
            safeio.read_xml,
            safeio.load_npz,
        )
    }
    assert list(mebibytes.values()) == [64, 64, 16, 256, 256, 2048]
    with (tmp_path / "large").open("wb") as file:
        file.truncate(16 * 2**20 + 1)
    with pytest.raises(FormatError, match="larger than the limit of 16 MiB"):
        safeio.read_yaml_document(tmp_path / "large")


def test_files_are_read_as_their_texts_are(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": [1, 2.5]}')
    assert safeio.read_json(tmp_path / "a.json") == {"a": [1, 2.5]}, "with a byte order mark"
    (tmp_path / "a.xml").write_text("<a b='1'/>")
    assert safeio.read_xml(tmp_path / "a.xml").get("b") == "1"
    (tmp_path / "a.yaml").write_text("a: 1\nb:\n  - 2")
    document = safeio.read_yaml_document(tmp_path / "a.yaml")
    assert document.data == {"a": 1, "b": [2]}
    assert str(document.error(("b", 0), "bad")) == f"{tmp_path / 'a.yaml'}:3: b[0]: bad"
    (tmp_path / "bad.json").write_text('{"a": 1,\n"b" 2}')
    with pytest.raises(FormatError, match=r"bad\.json:2: not valid JSON"):
        safeio.read_json(tmp_path / "bad.json")
    with pytest.raises(FormatError, match="key 'b' appears twice"):
        safeio.parse_json('{"a": 1, "b": 2, "c": 3, "b": 4}')


@pytest.mark.parametrize(
    "text", [b'<?xml version="1.0" encoding="nope"?><a/>', b"<?xml version='1.0' encoding='utf-16'?><a/>"]
)
def test_xml_of_an_encoding_that_is_not_there(text: bytes) -> None:
    with pytest.raises(FormatError, match=r"f\.xml.* not valid XML"):
        safeio.parse_xml(text, "f.xml")


def test_an_archive_says_nothing_of_the_machine_it_was_made_on() -> None:
    with zipfile.ZipFile(io.BytesIO(safeio.npz_bytes({"a": np.zeros(5000), "b": np.ones(3)}))) as archive:
        for member in archive.infolist():
            assert member.date_time == (1980, 1, 1, 0, 0, 0)
            assert (member.create_system, member.external_attr) == (3, 0o644 << 16)
            assert member.compress_type == zipfile.ZIP_DEFLATED
        assert [member.filename for member in archive.infolist()] == ["a.npy", "b.npy"]
        assert archive.infolist()[0].compress_size < 500
    with pytest.raises(TypeError, match="array 'b' holds Python objects"):
        safeio.npz_bytes({"a": np.zeros(1), "b": np.array([{}], dtype=object)})


def test_arrays_keep_their_order_in_memory_only_as_values(tmp_path: Path) -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.savez(tmp_path / "f.npz", a=array, b=np.arange(24).reshape(2, 3, 4).T)
    found = safeio.load_npz(tmp_path / "f.npz")
    assert np.array_equal(found["a"], array)
    assert np.array_equal(found["b"], np.arange(24).reshape(2, 3, 4).T)


def test_a_folder_is_made_with_its_parents_and_left_clean(tmp_path: Path) -> None:
    for _ in range(2):
        assert safeio.make_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
        assert os.listdir(tmp_path / "a" / "b") == []


def test_a_whole_file_or_none_and_no_other_beside_it(tmp_path: Path) -> None:
    safeio.write_atomic(tmp_path / "x" / "a.txt", "é")
    assert (tmp_path / "x" / "a.txt").read_bytes() == "é".encode()
    with safeio.atomic_path(tmp_path / "x" / "b.mp4") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path / "x", ".mp4")
        temporary.write_bytes(b"film")
    assert sorted(os.listdir(tmp_path / "x")) == ["a.txt", "b.mp4"]
    with pytest.raises(StoreError, match="cannot be written"), safeio.atomic_path(tmp_path / "x" / "c"):
        pass  # nothing was written
    assert sorted(os.listdir(tmp_path / "x")) == ["a.txt", "b.mp4"]


def test_aliases_up_to_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safeio, "MAX_ALIASED_NODES", 6)
    assert safeio.parse_yaml("a: &x [1, 2]\nb: *x\nc: *x") == {"a": [1, 2], "b": [1, 2], "c": [1, 2]}
    with pytest.raises(FormatError, match=r":4: aliases expand|:1: aliases expand"):
        safeio.parse_yaml("a: &x [1, 2]\nb: *x\nc: *x\nd: *x")


def test_depth_up_to_the_limit() -> None:
    deepest = "[" * safeio.MAX_DEPTH + "]" * safeio.MAX_DEPTH
    assert safeio.parse_yaml(deepest) is not None
    assert len(safeio.parse_yaml(f"[{deepest[1:-1]}, {deepest[1:-1]}]")) == 2
    with pytest.raises(FormatError, match="nested deeper than 64 levels"):
        safeio.parse_yaml(f"[{deepest}]")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("!!set {a, b}", "tag tag:yaml.org,2002:set is not allowed"),
        ("!!omap [a: 1]", "tag tag:yaml.org,2002:omap is not allowed"),
        ("!!binary aGVsbG8=", "is not allowed"),
        ("!!int twelve", "'twelve' is not a valid int"),
        ("!!bool maybe", "is not allowed"),
        ("a: &x {b: *x}", "contains it"),
    ],
)
def test_yaml_tags(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=r"^f\.yaml:1: ") as caught:
        safeio.parse_yaml(text, "f.yaml")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0o17", 15),
        ("+7", 7),
        ("-0x1F", "-0x1F"),
        (".inf", np.inf),
        (".5", 0.5),
        ("1.", 1.0),
        ("1e3", 1000.0),
        ("True", True),
        ("FALSE", False),
        ("Null", None),
        ("!!str 5", "5"),
        ("<<", "<<"),
        ("yes", "yes"),
        ("1_000", "1_000"),
        ("0o8", "0o8"),
    ],
)
def test_more_yaml_scalars(text: str, value: object) -> None:
    found = safeio.parse_yaml(text)
    assert found == value
    assert type(found) is type(value)


def test_plain_data() -> None:
    given = {
        "a": (1, [np.float32(0.5), math.nan]),
        3: {"b": -math.inf},
        "c": "text",
        "d": np.int64(4),
        "e": None,
        "f": True,
    }
    assert safeio.to_plain_json(given) == {
        "a": [1, [0.5, None]],
        "3": {"b": None},
        "c": "text",
        "d": 4,
        "e": None,
        "f": True,
    }
    assert type(safeio.to_plain_json(np.int64(4))) is int


@pytest.mark.parametrize("write", [safeio.make_folder, lambda folder: safeio.write_atomic(folder / "a.png", b"x")])
def test_what_a_kill_leaves_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], object]
) -> None:
    """As after a kill, nothing that was begun is taken away by the one who began it."""
    (tmp_path / ".gitignore").write_text("mine")
    with monkeypatch.context() as killed:
        killed.setattr(Path, "unlink", lambda *_, **__: None)
        killed.setattr(os, "replace", lambda *_: None)
        write(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    safeio.remove_unfinished(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".gitignore"]
