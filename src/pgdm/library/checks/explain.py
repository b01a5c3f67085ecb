"""Provenance of a task of the library, and its differences between two library sources."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pgdm.errors import amount
from pgdm.library.catalog import EXPERT_CURE, Library
from pgdm.library.checks.compare import Difference, compare, compare_options
from pgdm.library.checks.compiled import compiled
from pgdm.library.files.expert import FINGERS
from pgdm.library.tasks import MOCAP_TASKS

_MOTION_TOLERANCE = 1e-9
"""Largest difference that counts as equal: positions and joints (m, rad), quaternion components."""


def explain(library: Library, task: str) -> Iterator[str]:
    """Yield lines about a task: provenance, licences, hashes, defects, differences.

    Raises:
        UnknownNameError: the task is not in the library.
        CorruptAssetError: a file of the task is damaged.
    """
    serving = library.source_of(task)
    entry = library.entry(task)
    yield f"{task}: {entry.hand} with {' and '.join(entry.objects)}, {entry.steps} steps"
    manifests = library.sources()
    having = [s for s in manifests if task in manifests[s].tasks]
    for source in having:
        manifest = manifests[source]
        mark = "serves the task" if source == serving else "also has it"
        yield f"\nsource {source} ({mark}): {manifest.origin}, {manifest.imported_at}"
        starts = library.entry(task, source).starts
        yield f"  starts: {', '.join(starts)}"
        for relative in needed(library, task, source):
            file = manifest.files[relative]
            yield f"  {relative}  sha256 {file.sha256[:16]}  {file.licence}  from {file.origin}"
        hand = f"/{entry.hand}/"
        yield from (f"  defect: {d}" for d in manifest.defects if hand in d or task in d)
        yield from (f"  note: {note}" for note in manifest.notes.get(task, []))
    yield from explain_expert(library, task)
    if len(having) < 2:
        return
    yield f"\ndifferences between {having[0]} and {having[1]}:"
    found = list(differences(library, task, having[0], having[1]))
    yield from (f"  {line}" for line in found or ["none"])


def explain_expert(library: Library, task: str) -> Iterator[str]:
    """Yield lines about a task's expert hand trajectory: provenance, licence, quality.

    Raises:
        CorruptAssetError: the index of the expert trajectories is damaged.
    """
    index = library.experts()
    if task not in index.experts:
        if task in index.left_out:
            yield f"\nexpert hand trajectory: none, {index.left_out[task]}"
        elif task in MOCAP_TASKS:
            yield f"\nexpert hand trajectory: not fetched yet. {EXPERT_CURE}"
        else:
            yield "\nexpert hand trajectory: none, the task is not from motion capture"
        return
    entry, file = index.experts[task], index.experts[task].file
    kind = "rebuilt, approximate" if entry.approximate else "published"
    yield f"\nexpert hand trajectory ({kind}): {entry.package}, {index.made_at}"
    yield f"  experts/{task}.npz  sha256 {file.sha256[:16]}  {file.licence}  from {file.origin}"
    yield f"  poses: {entry.steps}, after {amount(entry.skipped, 'skipped frame')} of the recording"
    moved = ", ".join(f"{1e3 * x:.1f}" for x in entry.shift_m)
    yield (
        "  the recording's object deviates from the motion's by "
        f"{1e3 * entry.object_mean_m:.3f} mm (mean), {1e3 * entry.object_max_m:.3f} mm (max)"
        + (f", after a shift by ({moved}) mm" if any(entry.shift_m) else "")
    )
    yield (
        f"  exceeds joint limits by up to {entry.beyond_limits_rad:.2f} rad and, at the base, "
        f"{entry.beyond_limits_m:.2f} m (methods clip the joints)"
    )
    if entry.approximate:
        yield f"  over all {entry.steps} poses (the recording has no contact flag), by finger:"
    else:
        touching = amount(entry.touching_frames, "pose")
        yield f"  the hand touches the object at {touching}; by finger:"
    rows = zip(FINGERS, entry.contact_frames, entry.within_5mm, strict=True)
    yield "  " + "; ".join(f"{name} in contact {n}, within 5 mm {p:.0%}" for name, n, p in rows)


def needed(library: Library, task: str, source: str) -> list[str]:
    """Return a source's files of a task, relative to its folder: models (no meshes) and motion."""
    entry = library.entry(task, source)
    every = [
        "scene/table.xml",
        f"hands/{entry.hand}/hand.xml",
        *(f"objects/{name}/object.xml" for name in entry.objects),
        f"motions/{task}.npz",
    ]
    # Models that the source lacks come from another library source.
    return [name for name in every if name in library.sources()[source].files]


def differences(library: Library, task: str, first: str, second: str) -> Iterator[str]:
    """Yield lines about a task's differences between two sources: models, motion, starts.

    Sites, cameras, lights and materials do not affect the physics and are ignored.

    Raises:
        CorruptAssetError: a file is damaged.
    """
    for relative in needed(library, task, first)[:-1]:
        one = compiled(library.folder(first) / relative, relative)
        two = compiled(library.folder(second) / relative, relative)
        found = compare(one, two)
        if relative.startswith("scene/"):
            found += compare_options(one, two)
        yield from (f"{relative.split('/')[-2]}: {line}" for line in _lines(found))
    yield from motion_differences(library, task, first, second)


def _lines(found: list[Difference]) -> Iterator[str]:
    yield from (str(difference) for difference in found if difference.physical)
    looks = sorted({difference.element for difference in found if not difference.physical})
    if looks:
        yield f"{', '.join(looks)} looks different (does not collide)"


def motion_differences(library: Library, task: str, first: str, second: str) -> Iterator[str]:
    """Yield lines about the differences of a task's motion and starts between two sources."""
    one, two = library.motion(task, first), library.motion(task, second)
    if len(one.translation) != len(two.translation):
        yield f"motion: {len(one.translation)} against {len(two.translation)} steps"
        return
    away = float(np.abs(one.translation - two.translation).max())
    turned = float(np.abs(one.orientation - two.orientation).max())
    if max(away, turned) > _MOTION_TOLERANCE:
        yield f"motion: up to {away:.3g} m and {turned:.3g} (quaternion) apart"
    for name in sorted(set(one.starts) | set(two.starts)):
        if name not in two.starts or name not in one.starts:
            yield f"start {name}: only in {first if name in one.starts else second}"
            continue
        apart = np.abs(one.starts[name].qpos - two.starts[name].qpos)
        if apart.max() > _MOTION_TOLERANCE:
            joints = amount(int((apart > _MOTION_TOLERANCE).sum()), "joint")
            yield f"start {name}: differs in {joints}, by up to {apart.max():.3g} (m, rad)"
