"""Folders that may come from strangers: no file that is read or written below one lies outside of it.

A results folder, a recording or an export is a root. Names below it come from its own records, so they may be absolute,
lead to parents, or pass a symbolic link; a file may also be a pipe or a device. Each function here takes the root and
refuses what leads out of it. The links above the root, and the root itself, are the user's own.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path

from ssad.core.errors import ConfigError, StoreError

LINKS_VARIABLE = "SSAD_DATA_LINKS"
"""Environment variable: folders that symbolic links of data sets may lead to, separated as in PATH."""
RUN_FILE, RECORDING_FILE = "run.json", ".parts/recording.json"
ROOT_FILES = (RUN_FILE, RECORDING_FILE)
"""Files that make a folder a root, by name below it."""
UNOBTRUSIVE = frozenset({".lock", ".gitkeep", ".gitignore", ".DS_Store"})
"""Files that may lie in a folder that counts as empty."""


def path_inside(root: str | Path, relative: str | Path) -> Path:
    """Return the path of a file or folder below a root, which need not exist.

    Symbolic links that stay inside the root are followed.

    Raises:
        StoreError: The name is absolute or has a parent part, the path leads out of the root, or it is neither a file
            nor a folder.
    """
    path = Path(root).joinpath(*_parts(root, relative))
    if not _destination(path).is_relative_to(Path(root).resolve()):
        raise StoreError(f"{path}: leads out of {root}; remove that symbolic link")
    return path


def data_path(root: str | Path, relative: str | Path, *, source: str | Path | None = None) -> Path:
    """Return the path of a file or folder of a data set, which need not exist.

    Symbolic links may stay inside the data set, or lead to a folder that the user allows with `SSAD_DATA_LINKS`.

    Args:
        root: Folder of the data set.
        relative: Name below it.
        source: The data set of which this one is a changed copy: links may lead to its file of the same name.

    Raises:
        StoreError: The name is absolute or has a parent part, the path leads elsewhere, or it is neither a file nor a
            folder.
        ConfigError: `SSAD_DATA_LINKS` holds something else than absolute paths.
    """
    path = Path(root).joinpath(*_parts(root, relative))
    destination = _destination(path)
    if destination.is_relative_to(Path(root).resolve()) or is_linkable(destination):
        return path
    if source is not None and destination == data_path(source, relative).resolve():
        return path
    raise StoreError(f"{path}: leads out of {root} to {destination}; {link_remedy(destination)}")


def is_linkable(destination: Path) -> bool:
    """Return whether links of data sets may lead to a resolved path: it lies in a folder of `SSAD_DATA_LINKS`.

    Raises:
        ConfigError: `SSAD_DATA_LINKS` holds something else than absolute paths.
    """
    folders = [Path(text) for text in os.environ.get(LINKS_VARIABLE, "").split(os.pathsep) if text]
    for folder in folders:
        if not folder.is_absolute():
            raise ConfigError(f"{LINKS_VARIABLE}: {folder} is no absolute path; give folders separated by {os.pathsep}")
    return any(destination.is_relative_to(folder.resolve()) for folder in folders)


def link_remedy(destination: Path) -> str:
    """Return what to do about a link that leads out of a data set to a resolved path."""
    folder = destination if destination.is_dir() else destination.parent
    return f"copy that here, or allow such links with {LINKS_VARIABLE}={folder}"


def _destination(path: Path) -> Path:
    """Return where a path leads after all links. StoreError for a circle, and for what is no file and no folder."""
    try:
        destination, mode = path.resolve(), path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return path.resolve()
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror or error}") from None
    except RuntimeError:  # before Python 3.13 for links in a circle
        raise StoreError(f"{path}: is a symbolic link to itself; remove it") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise StoreError(f"{path}: is neither a file nor a folder; remove it")
    return destination


def open_inside(root: str | Path, relative: str | Path, flags: int) -> int:
    """Open a regular file below a root to write into it in place, and return its descriptor.

    Args:
        root: The root, which exists.
        relative: Name below it; the folders on the way exist.
        flags: Flags of `os.open`.

    Raises:
        StoreError: The file cannot be opened, the name is absolute or has a parent part, a part of it is a symbolic
            link, or the file is not regular or has a second name (a hard link), which would change too.
    """
    *folder_names, name = _parts(root, relative)
    path = Path(root).joinpath(*folder_names, name)
    descriptors = []
    try:
        descriptors.append(os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC))
        for folder_name in folder_names:
            folder_flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
            descriptors.append(os.open(folder_name, folder_flags, dir_fd=descriptors[-1]))
        # Without O_NONBLOCK a pipe would wait for its other end.
        file_flags = flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(name, file_flags, 0o644, dir_fd=descriptors[-1])
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENOTDIR) and _linked_part(Path(root), (*folder_names, name)):
            raise StoreError(f"{path}: is a symbolic link, which may lead out of {root}; remove it") from None
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        for folder_descriptor in descriptors:
            os.close(folder_descriptor)
    status = os.fstat(descriptor)
    problem = ""
    if not stat.S_ISREG(status.st_mode):
        problem = "is no regular file; remove it"
    elif status.st_nlink > 1:
        problem = "has a second name (a hard link), which would change too; copy the folder"
    if problem:
        os.close(descriptor)
        raise StoreError(f"{path}: {problem}")
    return descriptor


def is_file_name(text: str) -> bool:
    """Return whether a name from a file, such as that of a scene, can be part of a file's name in any folder."""
    return 0 < len(text) <= 200 and text not in (".", "..") and not set(text) & set("/\\\0")


def check_links_above(path: str | Path, *, root: str | Path | None = None, itself: bool = False) -> None:
    """Check that no folder between a root and a file is a symbolic link, so that a write stays inside.

    Args:
        path: The file that will be written.
        root: The root; None: every folder above that has one of `ROOT_FILES`.
        itself: Whether the path itself must be no link either, as for a folder that is made.

    Raises:
        StoreError: A folder is a link.
    """
    absolute_path = Path(os.path.abspath(path))
    if root is not None:
        roots = [Path(os.path.abspath(root))]
    else:
        roots = [
            folder for folder in absolute_path.parents if any(os.path.lexists(folder / name) for name in ROOT_FILES)
        ]
    if not roots:
        return
    parts = absolute_path.relative_to(roots[-1]).parts  # the last root is the outermost
    linked = _linked_part(roots[-1], parts if itself else parts[:-1])
    if linked is not None:
        raise StoreError(f"{linked}: is a symbolic link, which may lead out of {roots[-1]}; remove it")


def check_tree(root: str | Path) -> None:
    """Check that nothing in a folder leads out of it or is a pipe, a device or a socket.

    Raises:
        StoreError: With the first such entry.
    """
    resolved_root = os.path.realpath(root)
    for entry in _entries(os.fspath(root)):
        if entry.is_symlink():
            if not Path(os.path.realpath(entry.path)).is_relative_to(resolved_root):
                raise StoreError(f"{entry.path}: leads out of {root}; remove that symbolic link")
        elif not (entry.is_dir(follow_symlinks=False) or entry.is_file(follow_symlinks=False)):
            raise StoreError(f"{entry.path}: is neither a file nor a folder; remove it")


def check_output_folder(folder: str | Path, patterns: Sequence[str], *, option: str = "--out") -> None:
    """Check that a command may write to a folder: it is absent, empty, or holds what the command wrote earlier.

    Args:
        folder: The folder.
        patterns: Names below the folder, or patterns of them, of which one exists where the command wrote earlier.
        option: Option or argument that names the folder, for the message.

    Raises:
        StoreError: The folder holds something else, or is a file.
    """
    path = Path(folder)
    try:
        if not path.exists():
            return
        if not path.is_dir():
            raise StoreError(f"{path}: cannot write there: it is a file; choose a folder with {option}")
        is_empty = all(name in UNOBTRUSIVE or (name[0] == "." and ".tmp" in name) for name in os.listdir(path))
        if not is_empty and not any(next(path.glob(pattern), None) for pattern in patterns):
            raise StoreError(f"{path}: holds something else; choose a new or empty folder with {option}")
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror or error}; choose another folder") from None


def _parts(root: str | Path, relative: str | Path) -> tuple[str, ...]:
    """Return the parts of a name below a root, of which none leads to a parent."""
    text = os.fspath(relative)
    parts = Path(text).parts
    if not parts or "\0" in text or Path(text).is_absolute() or ".." in parts:
        raise StoreError(f"{root}: {text[:80]!r} is no path below this folder")
    return parts


def _linked_part(root: Path, parts: Sequence[str]) -> Path | None:
    """Return the first of the nested parts below a root that is a symbolic link."""
    path = root
    for part in parts:
        path /= part
        if path.is_symlink():
            return path
    return None


def _entries(folder: str) -> Iterator[os.DirEntry[str]]:
    """Yield all entries below a folder; links to folders are not followed."""
    folders = [folder]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    yield entry
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
        except OSError as error:
            raise StoreError(f"{folder}: cannot be read: {error.strerror or error}") from None
