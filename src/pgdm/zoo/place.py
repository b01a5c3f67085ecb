"""A zoo's location and index: a folder or a web address, with an index and one file per entry."""

from __future__ import annotations

import hashlib
import os
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from http.client import HTTPException
from pathlib import Path
from typing import Any

from pgdm import files, paths
from pgdm.errors import ConfigError, ZooError, check_name

INDEX, FORMAT = "index.json", "pgdm-zoo-1"
ENDING = ".safetensors.xz"
PREFIX = "zoo:"
"""Marks the name of an entry where a path is also possible, as in ``zoo:hammer-use1``."""
VARIABLE = "PGDM_ZOO"
"""Environment variable: folder or address of the zoo."""
MOST_BYTES = 1 << 26
_TIMEOUT_S = 60
_KINDS: Mapping[str, tuple[type, ...]] = {
    "task": (str,),
    "hand": (str,),
    "method": (str,),
    "algo": (str,),
    "action": (str,),
    "precision": (str,),
    "sha256": (str,),
    "seed": (int,),
    "frames": (int,),
    "bytes": (int,),
    "success": (int, float),
    "deterministic": (int, float),
    "com_error_released": (int, float),
}


@dataclass(frozen=True)
class Entry:
    """The index's record of one policy."""

    task: str
    hand: str
    method: str
    algo: str
    action: str
    seed: int
    frames: int
    """Length of the training, environment steps."""
    success: float
    """Success of the sampled policy (0..1)."""
    deterministic: float
    """Success of the mean action (0..1)."""
    com_error_released: float
    """Error of the sampled policy, as the released code computes it, m."""
    precision: str
    """Precision of the stored weights, ``float16`` or ``float32``."""
    bytes: int
    """Size of the file."""
    sha256: str
    """SHA-256 of the file."""


class Zoo:
    """A zoo; reading it executes no code from it.

    Args:
        place: folder, or address that starts with ``http://`` or ``https://``; None: that of
            ``PGDM_ZOO``, else the folder ``zoo`` of the checkout.

    Raises:
        ConfigError: if there is no such folder.
    """

    def __init__(self, place: str | None = None) -> None:
        self.place = place or os.environ.get(VARIABLE) or str(_of_checkout())
        self._is_remote = self.place.startswith(("http://", "https://"))
        if not self._is_remote and not Path(self.place).is_dir():
            chosen = place or os.environ.get(VARIABLE)
            raise ConfigError(
                f"there is no zoo {f'in {chosen!r}' if chosen else 'here'}; name a folder or an "
                f"address with --from or {VARIABLE}"
            )

    @cached_property
    def entries(self) -> dict[str, Entry]:
        """The entries by name, sorted.

        Raises:
            ZooError: if the index is missing, damaged or of another format.
        """
        where = f"{self.place.rstrip('/')}/{INDEX}"
        try:
            index = files.parse_json(self._read(INDEX, files.MOST_JSON_BYTES))
            if index["format"] != FORMAT:
                raise ZooError(
                    f"{where} has format {index['format']!r:.40}; this pgdm reads '{FORMAT}'"
                )
            return {name: _entry(name, index["entries"][name]) for name in sorted(index["entries"])}
        except (ValueError, LookupError, TypeError, AttributeError, ConfigError) as error:
            raise ZooError(f"{where} is damaged ({files.reason(error)})") from error

    def entry(self, name: str) -> Entry:
        """Return an entry.

        Raises:
            UnknownNameError: if there is none of this name.
            ZooError: if the index is missing or damaged.
        """
        check_name("policy of the zoo", name, self.entries)
        return self.entries[name]

    def content(self, name: str) -> bytes:
        """Return the content of an entry's file, after checking its SHA-256.

        Raises:
            UnknownNameError: if there is no entry of this name.
            ZooError: if index or file cannot be read, or the file's SHA-256 is not that of the
                index.
        """
        entry, file = self.entry(name), name + ENDING
        content = self._read(file, MOST_BYTES)
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise ZooError(
                f"{self.place}: {file} is damaged: its SHA-256 is not that of the index; get it "
                "again from its source"
            )
        return content

    def _read(self, file: str, most: int) -> bytes:
        where = f"{self.place.rstrip('/')}/{file}"
        try:
            if not self._is_remote:
                return files.read_bytes(Path(self.place) / file, most)
            with urllib.request.urlopen(where, timeout=_TIMEOUT_S) as answer:
                content = answer.read(most + 1)
        except urllib.error.HTTPError as error:
            raise ZooError(f"cannot read {where}: {error.code} {error.reason}") from error
        except (OSError, HTTPException, ValueError) as error:
            text = str(getattr(error, "reason", "")) or files.reason(error)
            raise ZooError(f"cannot read {where}: {text}") from error
        if len(content) > most:
            raise ZooError(f"{where} has more than the {most:,} bytes allowed")
        return content


def _of_checkout() -> Path:
    return Path(__file__).resolve().parents[3] / "zoo"


def _entry(name: str, values: Mapping[str, Any]) -> Entry:
    paths.check_path_part("name of an entry", name)
    for key, kinds in _KINDS.items():
        if not isinstance(values[key], kinds) or isinstance(values[key], bool):
            raise ValueError(f"{name}: '{key}' is {values[key]!r:.40}")
    return Entry(**{key: values[key] for key in _KINDS})
