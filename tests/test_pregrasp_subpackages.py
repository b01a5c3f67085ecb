"""The subpackages and modules of ``pgdm.pregrasp`` import each other in one direction."""

from __future__ import annotations

from test_layers import imported, read_sources

ROWS: list[set[str]] = [
    {"hand_geometry", "primitives", "sources"},
    {"ablation", "flexion", "near", "reach", "retarget", "teleop"},
    {"quality"},
    {"labeler", "predict"},
    {"on_demand"},
]
"""A subpackage, or a module next to them, imports from itself and from earlier rows."""


def test_imports_between_subpackages_go_one_way() -> None:
    sources = read_sources()
    row = {name: i for i, names in enumerate(ROWS) for name in names}
    modules = [module for module in sources if module.startswith("pregrasp.")]
    assert {module.split(".")[1] for module in modules} == set(row)
    wrong = [
        f"{module} imports {target}"
        for module in modules
        for target in sorted(imported(module, sources) & set(modules))
        if (here := module.split(".")[1]) != (there := target.split(".")[1])
        and row[there] >= row[here]
    ]
    assert wrong == []
