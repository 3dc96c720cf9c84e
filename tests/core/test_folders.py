"""Files below a folder that may come from a stranger: nothing that is read or written lies outside of it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from helpers.descriptors import open_files

from ssad.core.errors import ConfigError, StoreError
from ssad.core.folders import (
    check_links_above,
    check_output_folder,
    check_tree,
    data_path,
    is_file_name,
    open_inside,
    path_inside,
)
from ssad.core.safeio import make_folder, write_atomic

APPEND = os.O_WRONLY | os.O_APPEND | os.O_CREAT


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A results folder beside a folder of somebody else."""
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "file").write_text("mine")
    (tmp_path / "run" / "traces").mkdir(parents=True)
    (tmp_path / "run" / "run.json").write_text("{}")
    return tmp_path / "run"


@pytest.mark.parametrize("name", ["../victim/file", "/etc/hostname", "traces/../../victim/file", "", ".", "a\0b"])
def test_names_that_lead_out_are_refused(run: Path, name: str) -> None:
    for refuse in (lambda: path_inside(run, name), lambda: open_inside(run, name, APPEND)):
        with pytest.raises(StoreError, match="is no path below this folder"):
            refuse()


def test_links_that_lead_out_are_refused_and_others_followed(run: Path) -> None:
    (run / "traces" / "a").write_text("a")
    (run / "inner").symlink_to("traces")
    (run / "outer").symlink_to("../victim")
    (run / "circle").symlink_to("circle")
    assert path_inside(run, "inner/a").read_text() == "a"
    assert path_inside(run, "traces/absent") == run / "traces" / "absent"
    assert path_inside(run, "traces/a/b") == run / "traces" / "a" / "b", "a file in the place of a folder is not there"
    for name in ("outer/file", "outer/absent", "outer"):
        with pytest.raises(StoreError, match=r"leads out of .*run; remove that symbolic link"):
            path_inside(run, name)
    with pytest.raises(StoreError, match="circle"):
        path_inside(run, "circle")


def test_links_of_data_lead_to_folders_that_the_user_allows(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run / "outer").symlink_to("../victim")
    victim = run.parent / "victim"
    for folders in ("", str(victim / "other"), "/nowhere", f"{victim}x"):
        monkeypatch.setenv("SSAD_DATA_LINKS", folders)
        with pytest.raises(StoreError, match=f"outer/file: leads out of .*SSAD_DATA_LINKS={victim}$"):
            data_path(run, "outer/file")
    for folders in (str(victim), f"/nowhere:{victim.parent}"):
        monkeypatch.setenv("SSAD_DATA_LINKS", folders)
        assert data_path(run, "outer/file") == run / "outer" / "file"
        with pytest.raises(StoreError, match="is no path below"):
            data_path(run, "../victim/file")
        with pytest.raises(StoreError, match="leads out of"):
            path_inside(run, "outer/file")
    monkeypatch.setenv("SSAD_DATA_LINKS", "disk")
    with pytest.raises(ConfigError, match="disk is no absolute path"):
        data_path(run, "outer/file")


def test_links_of_a_changed_copy_lead_to_the_same_name_of_its_source(run: Path) -> None:
    source = run.parent / "victim"
    (run / "file").symlink_to("../victim/file")
    (run / "other").symlink_to("../victim/file")
    assert data_path(run, "file", source=source) == run / "file"
    with pytest.raises(StoreError, match="other: leads out of"):
        data_path(run, "other", source=source)


def test_a_root_that_is_a_link_is_the_users_own(run: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(run)
    (run / "traces" / "a").write_text("a")
    assert path_inside(tmp_path / "link", "traces/a").read_text() == "a"
    check_tree(tmp_path / "link")
    os.close(open_inside(tmp_path / "link", "traces/a", APPEND))
    write_atomic(tmp_path / "link" / "traces" / "b", "b")
    assert (run / "traces" / "b").read_text() == "b"


def test_a_file_that_is_written_in_place_is_a_regular_file_of_the_folder(run: Path) -> None:
    before = open_files()
    (run / "linked").symlink_to("../victim/file")
    (run / "inner").symlink_to("traces/a")
    (run / "traces" / "out").symlink_to("../../victim")
    os.mkfifo(run / "pipe")
    os.link(run.parent / "victim" / "file", run / "second")
    for name, words in (
        ("linked", "is a symbolic link"),
        ("inner", "is a symbolic link"),
        ("traces/out/file", "is a symbolic link"),
        ("pipe", "cannot be written|is no regular file"),
        ("second", "has a second name"),
        ("traces", "Is a directory"),
        ("absent/file", "No such file"),
    ):
        with pytest.raises(StoreError, match=words):
            open_inside(run, name, APPEND)
    with pytest.raises(StoreError, match="is no regular file"):
        open_inside(run, "pipe", os.O_RDWR)
    assert (run.parent / "victim" / "file").read_text() == "mine"
    assert open_files() == before
    os.close(open_inside(run, "traces/new", APPEND))
    assert (run / "traces" / "new").read_bytes() == b""


def test_no_file_is_written_through_a_link_below_a_results_folder(run: Path) -> None:
    (run / "tables").symlink_to("../victim")
    for write in (
        lambda: write_atomic(run / "tables" / "file", "theirs"),
        lambda: write_atomic(run / "tables" / "deep" / "file", "theirs"),
        lambda: make_folder(run / "tables"),
        lambda: make_folder(run / "tables" / "deep"),
    ):
        with pytest.raises(StoreError, match=r"tables: is a symbolic link, which may lead out"):
            write()
    assert os.listdir(run.parent / "victim") == ["file"]
    (run / "report.html").symlink_to("../victim/file")
    write_atomic(run / "report.html", "page")
    assert (run.parent / "victim" / "file").read_text() == "mine", "the link itself is replaced"
    assert not (run / "report.html").is_symlink()


def test_folders_that_are_no_root_may_be_links(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs").symlink_to("disk")
    write_atomic(make_folder(tmp_path / "runs" / "a") / "file", "a")
    assert (tmp_path / "disk" / "a" / "file").read_text() == "a"
    with pytest.raises(StoreError, match="runs: is a symbolic link"):
        check_links_above(tmp_path / "runs" / "a", root=tmp_path)


def test_a_tree_with_a_way_out_is_refused(run: Path) -> None:
    (run / "traces" / "inner").symlink_to("../run.json")
    check_tree(run)
    (run / "traces" / "outer").symlink_to("/etc/hostname")
    with pytest.raises(StoreError, match=r"traces/outer: leads out"):
        check_tree(run)
    (run / "traces" / "outer").unlink()
    os.mkfifo(run / "traces" / "pipe")
    with pytest.raises(StoreError, match=r"traces/pipe: is neither a file nor a folder"):
        check_tree(run)


def test_an_output_folder_is_new_empty_or_the_commands_own(tmp_path: Path) -> None:
    check_output_folder(tmp_path / "absent", ())
    (tmp_path / ".gitkeep").write_text("")
    check_output_folder(tmp_path, ())
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="holds something else; choose a new or empty folder with --out"):
        check_output_folder(tmp_path, ("run.json", "*.npz"))
    with pytest.raises(StoreError, match="cannot write there: it is a file; choose a folder with OUT"):
        check_output_folder(tmp_path / "notes.txt", (), option="OUT")
    (tmp_path / "a.npz").write_text("")
    check_output_folder(tmp_path, ("run.json", "*.npz"))


def test_names_of_files_have_no_folders() -> None:
    assert all(map(is_file_name, ("scene-0001", "CAM_FRONT", "a.b", "..a")))
    assert not any(map(is_file_name, ("", ".", "..", "a/b", "/a", "a\\b", "a\0b", "a" * 201)))
