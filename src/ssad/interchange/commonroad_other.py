"""CommonRoad files that commonroad-io has to read: protobuf, and XML of version 2018b; both become XML 2020a."""

from __future__ import annotations

import contextlib
import io
import logging
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssad.core.errors import FormatError, MissingExtraError
from ssad.core.safeio import read_bytes, read_xml

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


def is_protobuf(path: Path, *, limit: int) -> bool:
    """Return whether a file is CommonRoad protobuf: it is no XML, and has the name or the first byte of one.

    Args:
        path: The file.
        limit: Largest size, bytes.

    Raises:
        FormatError: The file cannot be read, or is too large.
    """
    content = read_bytes(path, limit=limit)
    # A protobuf scenario begins with the field of its information, of tag 1 and wire type 2.
    return content.lstrip()[:1] != b"<" and (Path(path).suffix == ".pb" or content[:1] == b"\x0a")


def convert(path: Path, *, protobuf: bool, limit: int) -> Element:
    """Return the root of the XML 2020a that commonroad-io makes of a file.

    Args:
        path: The file.
        protobuf: Whether it is protobuf, and not XML.
        limit: Largest size of the XML, bytes.

    Raises:
        MissingExtraError: commonroad-io is not installed.
        FormatError: It cannot read the file.
    """
    try:
        from commonroad.common.file_reader import CommonRoadFileReader
        from commonroad.common.file_writer import CommonRoadFileWriter
        from commonroad.common.util import FileFormat
        from commonroad.common.writer.file_writer_interface import OverwriteExistingFile
    except ImportError:
        form = "CommonRoad protobuf" if protobuf else "CommonRoad XML 2018b"
        raise MissingExtraError(f"{path}: {form}", "commonroad") from None
    file_format = FileFormat.PROTOBUF if protobuf else FileFormat.XML
    with tempfile.TemporaryDirectory() as folder, _silence():
        try:
            scenario, problems = CommonRoadFileReader(str(path), file_format).open()
            writer = CommonRoadFileWriter(
                scenario,
                problems,
                author=scenario.author or "",
                affiliation=scenario.affiliation or "",
                source=scenario.source or "",
                tags=scenario.tags or set(),
                location=scenario.location,
                decimal_precision=9,
            )
            converted = Path(folder) / "scenario.xml"
            writer.write_to_file(str(converted), OverwriteExistingFile.ALWAYS)
        except Exception as error:
            message = " ".join(f"{type(error).__name__}: {error}".split())
            raise FormatError(f"{path}: commonroad-io cannot read it: {message[:200]}") from None
        return read_xml(converted, limit=limit)


@contextlib.contextmanager
def _silence() -> Any:
    """Keep what commonroad-io prints, logs and warns of from the terminal: errors are told by `convert`."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
