"""Old names of moved modules, importable with a DeprecationWarning until the next version."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "envs.finished": "envs.episodes",
    "config.store": "config.compose",
    "library.animate": "library.files.keyframes",
    "library.author_drop": "library.authored.drop",
    "library.author_mesh": "library.authored.mesh",
    "library.author_object": "library.authored.object",
    "library.author_parts": "library.authored.parts",
    "library.check": "library.checks.compiled",
    "library.compare": "library.checks.compare",
    "library.expert_contacts": "library.experts.contacts",
    "library.expert_file": "library.files.expert",
    "library.expert_hand": "library.experts.kinematics",
    "library.expert_index": "library.files.expert_index",
    "library.explain": "library.checks.explain",
    "library.hand_figures": "library.robohive.hand_values",
    "library.human_hand": "library.experts.human_hand",
    "library.limp_hand": "library.experts.limp_hand",
    "library.lowest": "library.checks.lowest",
    "library.mjcf": "library.files.mjcf",
    "library.model_file": "library.files.model",
    "library.motion_checks": "library.checks.motion",
    "library.motion_file": "library.files.motion",
    "library.myohand": "library.robohive.myohand",
    "library.names": "library.tasks",
    "library.own": "library.authored.own",
    "library.package_index": "library.robohive.package_index",
    "library.pose_file": "library.files.poses",
    "library.pregrasp_file": "library.files.pregrasp",
    "library.rebuild": "library.experts.rebuild",
    "library.report": "library.progress",
    "library.registry": "library.fetch",
    "library.safe_npz": "library.files.npz",
    "library.safe_pickle": "library.files.pickles",
    "library.verify": "library.checks.verify",
    "library.wheel": "library.robohive.wheel",
    "library.wheel_experts": "library.robohive.experts",
    "library.wheel_hands": "library.robohive.hands",
    "library.wheel_models": "library.robohive.models",
    "library.wheel_motions": "library.robohive.motions",
    "pregrasp.ablate": "pregrasp.ablation.ablate",
    "pregrasp.ablated": "pregrasp.ablation.ablate",
    "pregrasp.demonstrations": "pregrasp.teleop.demonstrations",
    "pregrasp.hand_ik": "pregrasp.retarget.hand_ik",
    "pregrasp.ik": "pregrasp.retarget.ik",
    "pregrasp.keypoints": "pregrasp.retarget.keypoints",
    "pregrasp.labeler.figures": "pregrasp.labeler.measures",
    "pregrasp.labeler.names": "pregrasp.labeler.joint_names",
    "pregrasp.labeler.store": "pregrasp.labeler.poses",
    "pregrasp.mocap": "pregrasp.retarget.mocap",
    "pregrasp.plans": "pregrasp.reach.stored",
    "pregrasp.predict.refine": "pregrasp.predict.candidates",
    "pregrasp.provide": "pregrasp.on_demand",
    "pregrasp.push_out": "pregrasp.retarget.ik",
    "pregrasp.reach_plan": "pregrasp.reach.plan",
    "pregrasp.recording": "pregrasp.retarget.recording",
    "pregrasp.rollout": "pregrasp.reach.rollout",
    "pregrasp.targets": "pregrasp.retarget.targets",
    "pregrasp.waypoints": "pregrasp.reach.waypoints",
    "sim.replay": "sim.motion_states",
    "sweep.state": "sweep.status",
    "sweep.view": "cli.console.sweep_table",
    "tracking.provenance": "runs.provenance",
    "tracking.run_folder": "runs.folder",
    "tracking.run_log": "runs.log",
    "tracking.tracker": "tracking",
}
"""Old name to new name, both without ``pgdm.``."""


class _Moved(MetaPathFinder, Loader):
    """Imports the module of the new name in place of the old one."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec for old names only."""
        if fullname.removeprefix("pgdm.") not in MOVED:
            return None
        return importlib.util.spec_from_loader(fullname, self)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module of the new name, and warn."""
        new = "pgdm." + MOVED[spec.name.removeprefix("pgdm.")]
        warnings.warn(f"{spec.name} is now {new}", DeprecationWarning, stacklevel=2)
        module = importlib.import_module(new)
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the module's real spec; the import by its new name has executed it already."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


def keep_old_names() -> None:
    """Make the old names importable; ``import pgdm`` calls it."""
    sys.meta_path.append(_Moved())
