"""Find the palm, fingers and thumb among a hand's links, and place its tracked points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from pgdm.errors import ConfigError, check_name
from pgdm.library.couplings import Couplings
from pgdm.pregrasp.hand_geometry import unit

HUMAN = ("index", "middle", "ring", "little", "thumb")
"""Human fingers, in the order in which ``pgdm author hand`` lists them."""
PREFIXES = {"index": "ff", "middle": "mf", "ring": "rf", "little": "lf", "thumb": "th"}
"""Prefixes of the tracked points' names, as in the benchmark's hands."""

_WORDS = {
    "index": ("index", "fore", "ff", "if"),
    "middle": ("middle", "mf"),
    "ring": ("ring", "rf"),
    "little": ("little", "pinky", "lf", "pf"),
    "thumb": ("thumb", "th"),
}
"""Words in the names of links and joints; words of two letters count only at a name's start."""
_MOST_WRIST = 3  # limit of joints that move the palm; with more, the hand is on an arm
_SAME_M = 0.005  # joints closer together than this form one knuckle
_PAD_M = 0.012  # from the end of a finger to the middle of its pad
_ALONG = 0.8  # from this cosine on, a joint's axis counts as running along the link
_PALM_M = 0.09  # length of a palm without any geometry


@dataclass(frozen=True)
class Finger:
    """One finger."""

    human: str
    """Human finger that it corresponds to, of :data:`HUMAN`."""
    joints: list[int]
    """Ids of its joints, from the palm outwards."""
    link: int
    """Body id of its last link."""


@dataclass(frozen=True)
class Anatomy:
    """The parts of a hand; ids are those of the model without base joints."""

    palm: int
    """Body that carries the fingers; 0 if they are fixed to the world."""
    wrist_joints: list[int]
    """Joints that move the palm."""
    fingers: list[Finger]
    """In the order of :data:`HUMAN`."""
    points: dict[str, tuple[str, np.ndarray]] = field(repr=False)
    """Tracked points by name, the wrist first: name of a body and position (3,) m in its frame."""
    wrist: np.ndarray
    """Position of the wrist (3,) m, in the model's world frame."""
    along: np.ndarray
    """Direction (3,) of the straight fingers, in the model's world frame."""
    across: np.ndarray
    """Direction (3,) from the index finger's side to the little finger's, in the same frame."""
    found_by: str
    """``names``, ``geometry`` or ``--fingers``."""


def straight(model: mujoco.MjModel) -> mujoco.MjData:
    """Return the kinematics of a hand with each joint at zero or its limit nearest to zero."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.zeros(model.nq).clip(*model.jnt_range.T)
    Couplings(model, model.njnt).apply(data.qpos)
    mujoco.mj_kinematics(model, data)
    return data


def find(model: mujoco.MjModel, chosen: Mapping[str, str], label: str) -> Anatomy:
    """Find palm, fingers and points of a hand.

    A finger is a chain of joints that ends in a link without further joints; the palm is the link
    from which the fingers branch.

    Args:
        model: the hand alone.
        chosen: a link or joint of each human finger, if the user names them; else empty.
        label: the hand's file, for messages.

    Raises:
        ConfigError: the hand does not have three to five fingers, the hand is on an arm, two
            fingers share a joint, a fingertip has no collision geometry, or ``chosen`` does not
            fit.
    """
    moved = model.body_jntnum > 0
    parents = model.body_parentid
    inner = {int(b) for body in np.flatnonzero(moved) for b in _ancestors(parents, int(body))[1:]}
    tips = [int(body) for body in np.flatnonzero(moved) if body not in inner]
    if not 3 <= len(tips) <= len(HUMAN):
        raise ConfigError(
            f"{label}: chains of joints that end in a fingertip: {len(tips)} "
            f"({_listed(_name(model, t) for t in tips)}); pgdm's hands have 3 to 5 fingers"
        )
    paths = [_ancestors(parents, tip) for tip in tips]
    palm = next(body for body in paths[0] if all(body in path for path in paths))
    above = _ancestors(parents, palm)
    wrist_joints = sorted(j for j in range(model.njnt) if model.jnt_bodyid[j] in above)
    if len(wrist_joints) > _MOST_WRIST:
        raise ConfigError(
            f"{label}: {len(wrist_joints)} joints move the palm '{_name(model, palm)}': it is on "
            "an arm. Reduce the file to the hand; pgdm adds six base joints in place of the arm"
        )
    chains = [_joints(model, path[: path.index(palm)]) for path in paths]
    for one, tip in zip(chains, tips, strict=True):
        shared = {j for other in chains if other is not one for j in other} & set(one)
        if shared:
            raise ConfigError(
                f"{label}: '{_name(model, tip)}' shares joint "
                f"'{model.joint(min(shared)).name}' with another finger; each needs its own"
            )
    data = straight(model)
    ends = {tip: _end(model, data, tip, label) for tip in tips}
    human, found_by = _humans(model, data, chains, tips, ends, chosen, label)
    order = sorted(range(len(tips)), key=lambda i: HUMAN.index(human[i]))
    fingers = [Finger(human[i], chains[i], tips[i]) for i in order]
    others = [f for f in fingers if f.human != "thumb"]
    knuckles = np.array([_middle(model, data, f.joints, 0) for f in others])
    along = unit(np.array([ends[f.link] for f in others]).mean(0) - knuckles.mean(0))
    across = knuckles[-1] - knuckles[0]
    across = unit(across - along * (along @ across))
    wrist = _wrist(model, data, palm, wrist_joints, knuckles.mean(0), along)
    points = {"wrist_point": (model.body(palm).name, _local(data, palm, wrist))}
    for finger in fingers:
        for part, (body, place) in _points(data, model, finger, ends[finger.link]).items():
            name = f"{PREFIXES[finger.human]}{part}_point"
            points[name] = model.body(body).name, _local(data, body, place)
    return Anatomy(palm, wrist_joints, fingers, points, wrist, along, across, found_by)


def _humans(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    chains: list[list[int]],
    tips: list[int],
    ends: Mapping[int, np.ndarray],
    chosen: Mapping[str, str],
    label: str,
) -> tuple[list[str], str]:
    """Return the human finger of each chain of joints, and how they were found."""
    names = [_names(model, chain, tip) for chain, tip in zip(chains, tips, strict=True)]
    if chosen:
        return _chosen(names, tips, model, chosen, label), "--fingers"
    by_name = [_by_words(words) for words in names]
    if None not in by_name and len(set(by_name)) == len(by_name) and "thumb" in by_name:
        return [str(one) for one in by_name], "names"
    thumbs = [i for i, one in enumerate(by_name) if one == "thumb"]
    places = np.array([ends[tip] for tip in tips])
    far = [np.linalg.norm(p - (places.sum(0) - p) / (len(tips) - 1)) for p in places]
    thumb = thumbs[0] if len(thumbs) == 1 else int(np.argmax(far))
    knuckles = np.array([data.xanchor[chain[0]] for chain in chains])
    others = [i for i in range(len(tips)) if i != thumb]
    spread = knuckles[others] - knuckles[others].mean(0)
    axis = np.linalg.svd(spread)[2][0]
    axis *= -1.0 if (knuckles[thumb] - knuckles[others].mean(0)) @ axis > 0 else 1.0
    others.sort(key=lambda i: float(knuckles[i] @ axis))
    human = dict(zip(others, HUMAN, strict=False)) | {thumb: "thumb"}
    return [human[i] for i in range(len(tips))], "geometry"


def _chosen(
    names: list[set[str]],
    tips: list[int],
    model: mujoco.MjModel,
    chosen: Mapping[str, str],
    label: str,
) -> list[str]:
    found: dict[int, str] = {}
    for human, name in chosen.items():
        check_name("human finger of --fingers", human, HUMAN)
        with_it = [i for i, known in enumerate(names) if name in known]
        if len(with_it) != 1 or with_it[0] in found:
            raise ConfigError(
                f"{label}: --fingers {human}={name} must name a link or joint of exactly one "
                "finger, and each finger only once; the fingers' last links are "
                f"{_listed(_name(model, tip) for tip in tips)}"
            )
        found[with_it[0]] = human
    if len(found) < len(tips) or "thumb" not in found.values():
        missing = [_name(model, tip) for i, tip in enumerate(tips) if i not in found]
        raise ConfigError(
            f"{label}: --fingers must name every finger, including a thumb; it lacks "
            f"{_listed(missing) or 'the thumb'}"
        )
    return [found[i] for i in range(len(tips))]


def _by_words(names: set[str]) -> str | None:
    """Return the human finger to which most names of a finger point; None if none or a tie."""
    counts = {
        human: sum(any(_says(name.lower(), word) for word in words) for name in names)
        for human, words in _WORDS.items()
    }
    best = max(counts, key=lambda human: counts[human])
    rivals = [human for human in counts if counts[human] == counts[best]]
    return best if counts[best] and len(rivals) == 1 else None


def _says(name: str, word: str) -> bool:
    return name.startswith(word) if len(word) == 2 else word in name


def _names(model: mujoco.MjModel, chain: list[int], tip: int) -> set[str]:
    bodies = {int(model.jnt_bodyid[j]) for j in chain} | set(_welded(model, tip))
    return {_name(model, body) for body in bodies} | {model.joint(j).name for j in chain}


def _points(
    data: mujoco.MjData, model: mujoco.MjModel, finger: Finger, end: np.ndarray
) -> dict[str, tuple[int, np.ndarray]]:
    """Return body and position (3,) m, world frame, of a finger's knuckle, middle, distal point."""
    anchors = np.array([_middle(model, data, finger.joints, k) for k in range(len(finger.joints))])
    knuckle = anchors[0]
    half = 0.5 * float(np.linalg.norm(end - knuckle))
    away = np.linalg.norm(anchors - knuckle, axis=1)
    inner = [i for i in range(len(anchors)) if away[i] > _SAME_M]
    middle = finger.link, 0.5 * (knuckle + end)
    if inner:
        best = min(inner, key=lambda i: abs(away[i] - half))
        middle = int(model.jnt_bodyid[finger.joints[best]]), anchors[best]
    first = int(model.jnt_bodyid[finger.joints[0]])
    return {"knuckle": (first, knuckle), "middle": middle, "distal": (finger.link, end)}


def _end(model: mujoco.MjModel, data: mujoco.MjData, tip: int, label: str) -> np.ndarray:
    """Return the middle of a fingertip's pad (3,) m, world frame."""
    corners = _corners(model, data, _welded(model, tip))
    if not len(corners):
        raise ConfigError(
            f"{label}: fingertip '{_name(model, tip)}' has no collision geometry, so it could not "
            "touch anything; add some to its link"
        )
    last = int(model.body_jntadr[tip] + model.body_jntnum[tip] - 1)
    start = _middle(model, data, [last], 0)
    along = unit(0.5 * (corners.min(0) + corners.max(0)) - start)
    length = float(((corners - start) @ along).max())
    return start + max(0.5 * length, length - _PAD_M) * along


def _middle(
    model: mujoco.MjModel, data: mujoco.MjData, joints: list[int], number: int
) -> np.ndarray:
    """Return a joint's anchor (3,) m, shifted along its axis to the middle of its link.

    A file may put the anchor anywhere along a hinge's axis, such as at the side of the link. If the
    axis runs along the link, the anchor stays. If the link has no collision geometry, the next link
    of the finger that has some takes its place.
    """
    joint = joints[number]
    anchor, axis = data.xanchor[joint], data.xaxis[joint]
    for outer in joints[number:]:
        corners = _corners(model, data, _welded(model, int(model.jnt_bodyid[outer])))
        if not len(corners):
            continue
        middle = 0.5 * (corners.min(0) + corners.max(0))
        if abs(unit(middle - anchor) @ axis) < _ALONG:
            anchor = anchor + axis * (axis @ (middle - anchor))
        break
    return anchor.copy()


def _wrist(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    palm: int,
    wrist_joints: list[int],
    knuckles: np.ndarray,
    along: np.ndarray,
) -> np.ndarray:
    """Return the wrist (3,) m: the last wrist joint, else the palm's end opposite the fingers."""
    if wrist_joints:
        return data.xanchor[wrist_joints[-1]].copy()
    corners = _corners(model, data, _welded(model, palm))
    back = float(((corners - knuckles) @ along).min()) if len(corners) else -_PALM_M
    return knuckles + min(back, 0.0) * along


def _corners(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> np.ndarray:
    """Return the corners (N, 3) m, world frame, of the boxes around the solid geoms of bodies."""
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = np.flatnonzero(solid & np.isin(model.geom_bodyid, bodies))
    signs = np.stack(np.meshgrid(*([[-1.0, 1.0]] * 3)), axis=-1).reshape(-1, 3)
    corners = [
        data.geom_xpos[g]
        + (model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:])
        @ data.geom_xmat[g].reshape(3, 3).T
        for g in geoms
    ]
    return np.concatenate(corners) if corners else np.empty((0, 3))


def _welded(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and those rigidly attached to it."""
    return np.flatnonzero(model.body_weldid == model.body_weldid[body]).tolist()


def _ancestors(parents: np.ndarray, body: int) -> list[int]:
    """Return a body and its ancestors, the world last."""
    path = [int(body)]
    while path[-1]:
        path.append(int(parents[path[-1]]))
    return path


def _joints(model: mujoco.MjModel, bodies: list[int]) -> list[int]:
    """Return the joints of bodies, outermost last, given the bodies, outermost first."""
    starts = [(int(model.body_jntadr[b]), int(model.body_jntnum[b])) for b in reversed(bodies)]
    return [j for start, count in starts for j in range(start, start + count)]


def _local(data: mujoco.MjData, body: int, place: np.ndarray) -> np.ndarray:
    return (place - data.xpos[body]) @ data.xmat[body].reshape(3, 3)


def _name(model: mujoco.MjModel, body: int) -> str:
    return model.body(int(body)).name or f"body {body}"


def _listed(names: object) -> str:
    listed = [f"'{name}'" for name in names]  # type: ignore[attr-defined]
    return ", ".join(listed[:8]) + (f" and {len(listed) - 8} more" if len(listed) > 8 else "")
