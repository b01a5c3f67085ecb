"""Settings file of a user's hand, in the config group ``hand``."""

from __future__ import annotations

from pathlib import Path

from pgdm import paths
from pgdm.sim.scene import HandCfg


def settings_path(name: str) -> Path:
    """Return the settings file of a user's hand."""
    return paths.inside(paths.user_conf() / "hand", name, kind="hand", suffix=".yaml")


def settings_text(cfg: HandCfg, origin: str, side: str) -> str:
    """Return the text of the settings file, with a comment on each key as in ``conf/hand``."""
    points = "".join(f"\n  - {point}" for point in cfg.points)
    mean = ", ".join(f"{angle:.4f}" for angle in cfg.mean_fingers_rad)
    return f"""# A {side} hand made by 'pgdm author hand' from {origin}.

# Name of the hand in the library.
name: {cfg.name}
# Geoms whose poses are observed: wrist, then knuckle, middle and distal of each finger.
points:{points}
# Which of the points are fingertips [index].
fingertips: {cfg.fingertips}
# Human finger that each fingertip follows in inverse kinematics.
human_fingers: [{", ".join(cfg.human_fingers)}]
# Joints whose gravity and Coriolis forces are compensated: all, or base.
gravity_compensation: {cfg.gravity_compensation}
# Number of joints that place the wrist; they come first in qpos.
num_base_joints: {cfg.num_base_joints}
# Number of joints after them that turn the palm; the rest are the finger joints.
num_wrist_joints: {cfg.num_wrist_joints}
# Mean pre-grasp: the finger joints, coupled ones too, in the order of qpos; those that close are
# 0.37 of the way from straight to closed, as in the benchmark's hands [rad].
mean_fingers_rad: [{mean}]
# Body that the base joints move.
mount_body: {cfg.mount_body}
"""
