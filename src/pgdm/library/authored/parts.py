"""Convex parts of a mesh, which become the object's collision geoms."""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from importlib.metadata import version

import numpy as np
import trimesh

from pgdm import paths
from pgdm.errors import ConfigError, CorruptAssetError, LibraryError
from pgdm.library.authored.mesh import SoundMesh
from pgdm.library.files import npz
from pgdm.library.progress import StepProgress, silent

_POLL_S = 0.2
_LEAST_SHARE = 1e-5  # of the total volume: smaller parts are slivers that MuJoCo refuses
_MOST_PARTS = 64
_COACD_ERRORS = (ImportError, OSError, RuntimeError, ValueError)


@dataclass(frozen=True)
class PartsCfg:
    """How a mesh is decomposed into convex parts."""

    threshold: float = 0.05
    """Largest concavity that may remain, relative to the mesh's size; valid: 0.01 to 1. Lower
    values give more parts."""
    max_parts: int | None = None
    """Largest number of parts, 1 to 64; None: as many as the threshold requires."""

    def check(self) -> None:
        """Check the values.

        Raises:
            ConfigError: a value is out of range.
        """
        if not 0.01 <= self.threshold <= 1.0:
            raise ConfigError(f"--threshold is {self.threshold}; valid: 0.01 to 1")
        if self.max_parts is not None and not 1 <= self.max_parts <= _MOST_PARTS:
            raise ConfigError(f"--parts is {self.max_parts}; valid: 1 to {_MOST_PARTS}")


@dataclass(frozen=True)
class Part:
    """One convex part."""

    vertices: np.ndarray = field(repr=False)
    """(V, 3) m, in the frame of the mesh."""
    faces: np.ndarray = field(repr=False)
    """(F, 3) vertex numbers."""

    def trimesh(self) -> trimesh.Trimesh:
        """Return the part as a ``trimesh.Trimesh``."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def convex_parts(mesh: SoundMesh, cfg: PartsCfg, progress: StepProgress = silent) -> list[Part]:
    """Decompose a mesh into convex parts (CoACD), or return the cached result.

    Equal input always gives equal parts. A closed convex mesh in one piece is returned as a single
    part.

    Args:
        mesh: the mesh.
        cfg: how finely to decompose.
        progress: receives the seconds elapsed; the algorithm does not report its progress.

    Raises:
        ConfigError: a setting is out of range.
        LibraryError: the decomposition failed, or gave no parts or more than 64.
    """
    cfg.check()
    cache = paths.home() / "parts" / f"{_key(mesh, cfg)}.npz"
    with contextlib.suppress(CorruptAssetError, KeyError):  # missing or damaged
        return _read(npz.read_npz(cache))
    if mesh.volume_m3 / mesh.hull_m3 > 1.0 - 1e-6 and mesh.closed and mesh.num_bodies == 1:
        hull = mesh.trimesh().convex_hull  # already convex
        return [Part(np.array(hull.vertices), np.array(hull.faces))]
    raw = _in_background(lambda: _decomposed(mesh, cfg), progress)
    parts = _sound(raw)
    if not parts:
        raise LibraryError("the mesh has no convex parts; repair it in your mesh editor")
    if len(parts) > _MOST_PARTS:
        raise LibraryError(
            f"the mesh has {len(parts)} convex parts, more than {_MOST_PARTS}; give a --threshold "
            f"above {cfg.threshold:g}, or --parts N"
        )
    arrays = {f"v{i:03d}": p.vertices for i, p in enumerate(parts)}
    arrays |= {f"f{i:03d}": p.faces for i, p in enumerate(parts)}
    cache.parent.mkdir(parents=True, exist_ok=True)
    with paths.replacing(cache) as temp:
        npz.write_npz(temp, arrays)
    return parts


def _key(mesh: SoundMesh, cfg: PartsCfg) -> str:
    digest = hashlib.sha256(f"{cfg} coacd {version('coacd')}".encode())
    digest.update(np.ascontiguousarray(mesh.vertices).tobytes())
    digest.update(np.ascontiguousarray(mesh.faces).tobytes())
    return digest.hexdigest()[:32]


def _read(arrays: dict[str, np.ndarray]) -> list[Part]:
    count = sum(name.startswith("v") for name in arrays)
    return [Part(arrays[f"v{i:03d}"], arrays[f"f{i:03d}"]) for i in range(count)]


def _decomposed(mesh: SoundMesh, cfg: PartsCfg) -> list[tuple[np.ndarray, np.ndarray]]:
    import coacd

    coacd.set_log_level("error")
    most = -1 if cfg.max_parts is None else cfg.max_parts
    return coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=cfg.threshold,
        max_convex_hull=most,
        max_ch_vertex=64,
        decimate=True,
        seed=0,
    )


def _in_background(
    work: Callable[[], list[tuple[np.ndarray, np.ndarray]]], progress: StepProgress
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Do the work in a separate thread, so that Ctrl-C can interrupt the program at once.

    Raises:
        LibraryError: the work failed.
    """
    done: Future[list[tuple[np.ndarray, np.ndarray]]] = Future()

    def run() -> None:
        try:
            done.set_result(work())
        except Exception as error:  # noqa: BLE001 - raised again in the caller's thread
            done.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    waited = 0.0
    while not done.done():
        wait([done], _POLL_S)
        waited += _POLL_S
        progress("convex parts (10 s to some minutes)", int(waited), 0)
    try:
        return done.result()
    except _COACD_ERRORS as error:
        raise LibraryError(
            f"the mesh could not be decomposed ({type(error).__name__}: {error}); repair it in "
            "your mesh editor, or try another --threshold"
        ) from error


def _sound(raw: list[tuple[np.ndarray, np.ndarray]]) -> list[Part]:
    """Return the hulls of the parts that are not slivers, the largest first."""
    hulls = []
    for vertices, _ in raw:
        try:
            # Take the hull: after decimation and rounding a part may be slightly concave.
            hulls.append(trimesh.convex.convex_hull(np.asarray(vertices, np.float64)))
        except (ValueError, RuntimeError, IndexError):  # Qhull: a sliver without a volume
            continue
    whole = sum(hull.volume for hull in hulls)
    kept = [h for h in hulls if h.volume > _LEAST_SHARE * whole]
    kept.sort(key=lambda h: -h.volume)
    return [Part(np.array(h.vertices), np.array(h.faces)) for h in kept]
