"""Pre-Grasp informed Dexterous Manipulation.

``pgdm.make_batch`` and ``pgdm.make_torchrl`` make environments; in Gymnasium they are called
``pgdm/<task>-v0``. Commands: ``pgdm-run`` trains, ``pgdm`` does the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pgdm.make import register

if TYPE_CHECKING:
    from pgdm.make import make_batch, make_torchrl

__all__ = ["make_batch", "make_torchrl"]


def __getattr__(name: str) -> object:
    # torch and the simulator load when an environment is asked for, not with every `import pgdm`.
    if name in __all__:
        from pgdm import make

        return getattr(make, name)
    raise AttributeError(f"module 'pgdm' has no attribute '{name}'")


# Gymnasium finds environments of packages that were imported; it asks for nothing by itself.
register()
