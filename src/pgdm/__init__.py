"""Pre-Grasp informed Dexterous Manipulation.

``pgdm.make_batch``, ``pgdm.make_torchrl`` and ``pgdm.make_sb3`` make environments; in Gymnasium
they are called ``pgdm/<task>-v0``. ``pgdm.load_policy`` reads the policy of a run. Commands:
``pgdm-run`` trains, ``pgdm`` does the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pgdm.make import register
from pgdm.moved import keep_old_names

if TYPE_CHECKING:
    from pgdm.make import make_batch, make_sb3, make_torchrl
    from pgdm.runs.checkpoints import load_policy

__all__ = ["load_policy", "make_batch", "make_sb3", "make_torchrl"]


def __getattr__(name: str) -> object:
    # Import torch and the simulator on first use, not with every `import pgdm`.
    if name == "load_policy":
        from pgdm.runs.checkpoints import load_policy

        return load_policy
    if name in __all__:
        from pgdm import make

        return getattr(make, name)
    raise AttributeError(f"module 'pgdm' has no attribute '{name}'")


# Gymnasium discovers no packages by itself: importing pgdm must register its environments.
register()
keep_old_names()
