from __future__ import annotations

from pathlib import Path

from pgdm.report.runs import CONTACTS, FINGERTIPS
from report_runs import evaluation, make, report, rows, text_of

CHECKOUT, REGISTRY = {"asset_source": "checkout"}, {"asset_source": "registry"}


def test_starts_and_assets_that_differ_within_a_setting_are_listed(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    mined = REGISTRY | {"pregrasp_used": "mined"}
    make(root / "a", 0.7, "task=cup-pour1", result=CHECKOUT)
    make(root / "b", 0.7, "task=hammer-use1", result=CHECKOUT)
    make(root / "c", 0.7, "task=door-open", result=mined)
    make(root / "failed", 0.7, "task=duck-lift", result={"pregrasp_used": "none"}, state="failed")
    # Another setting, all of whose runs are alike; one did not record its assets.
    make(root / "d", 0.7, "task=cup-pour1", "action=residual", result=REGISTRY)
    make(root / "e", 0.7, "task=door-open", "action=residual")
    page = text_of(report(root))
    box = page[page.index("Not the paper's budget") : page.index("Configurations")]
    assert box.count("Not alike:") == 2
    note = "Not alike: the finished runs of pgdm have different"
    assert f"{note} starts: planned (2 runs), mined (1 run). Their averages mix these." in box
    assert f"{note} asset sources: checkout (2 runs), registry (1 run)." in box
    found = {Path(row["folder"]).name: (row["start"], row["asset_source"]) for row in rows("runs")}
    assert found == {
        "a": ("planned", "checkout"),
        "b": ("planned", "checkout"),
        "c": ("mined", "registry"),
        "failed": ("none", ""),
        "d": ("planned", "registry"),
        "e": ("planned", ""),
    }


def test_runs_with_another_scene_of_the_task_are_listed(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    old, new = ({"scene_sha256": digit * 64} for digit in "ab")
    make(root / "a", 0.7, "task=door-open", result=CHECKOUT | old)
    make(root / "b", 0.7, "task=door-open", "seed=1", result=CHECKOUT | new)
    make(root / "c", 0.7, "task=cup-pour1", result=CHECKOUT | new)
    page = text_of(report(root))
    assert page.count("Not alike:") == 1
    assert (
        "the finished runs of pgdm have different checkout door-open scenes: aaaaaaaa (1 run), "
        "bbbbbbbb (1 run). Their averages mix these."
    ) in page
    make(root / "d", 0.1, "task=cup-pour1", result=CHECKOUT | old, state="interrupted")
    assert "../runs/d (checkout cup-pour1 scene aaaaaaaa, not bbbbbbbb)" in text_of(report(root))


def test_runs_that_are_left_out_are_named(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    make(root / "best", 0.7, "task=cup-pour1", result=CHECKOUT)
    note = "left out: another one has the same configuration, task and seed."
    assert note not in text_of(report(root))
    mined = CHECKOUT | {"pregrasp_used": "mined"}
    make(root / "less", 0.1, "task=cup-pour1", result=mined, state="interrupted")
    page = text_of(report(root))
    assert f"1 run is {note} ../runs/less (start mined, not planned)." in page
    assert "Not alike:" not in page  # only one of them counts
    for number in range(5):
        make(root / f"x{number}", 0.1, "task=cup-pour1", result=CHECKOUT, state="interrupted")
    make(root / "y", 0.1, "task=cup-pour1", result=REGISTRY, state="failed")
    page = text_of(report(root))
    less = "../runs/less (start mined, not planned)"
    other = "../runs/y (asset source registry, not checkout)"
    named = page.split(f"7 runs are {note}")[1].split(" more.")[0]
    assert less in named and other in named
    assert named.count("../runs/x") == 3
    assert named.endswith("and 2")


def test_distance_of_the_hand_from_the_experts(tmp_path: Path) -> None:
    root, far = tmp_path / "runs", {FINGERTIPS: 0.0652, CONTACTS: 0.0657}
    near = {FINGERTIPS: 0.0348}  # a task whose expert touches nothing has no contact points
    own = ("task=cup-pour1", "method=deepmimic")
    make(root / "a", 0.5, *own, result={"metrics": evaluation(0.5) | far})
    make(root / "b", 0.5, *own, "seed=1", result={"metrics": evaluation(0.5) | near})
    make(root / "c", 0.5, "task=cup-pour1")
    page = text_of(report(root))
    head = "lifted fingertips off the expert's [cm] off its contact points [cm] frames"
    assert page.count(head) == 1  # not of pgdm
    assert page.count("lifted frames") == 1
    # Fingertips: (6.52 + 3.48) / 2 cm.
    assert "50% 5.0 6.6 40,960" in page
    assert "mean distance of fingertips from the expert's" in page
    columns = ("hand_error_m", "contact_distance_m")
    assert {row["setting"]: tuple(row[c] for c in columns) for row in rows("tasks")} == {
        "pgdm": ("", ""),
        "deepmimic": ("0.05", "0.0657"),
    }
    runs = {Path(row["folder"]).name: (row[FINGERTIPS], row[CONTACTS]) for row in rows("runs")}
    assert runs == {"a": ("0.0652", "0.0657"), "b": ("0.0348", ""), "c": ("", "")}
    (root / "a").rename(tmp_path / "a")
    (root / "b").rename(tmp_path / "b")
    assert "expert's" not in text_of(report(root))


def test_the_engine_of_the_training_is_part_of_the_provenance(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    make(root / "a", 0.5)
    make(root / "b", 0.5, "sim=warp", result={"engine": "MuJoCo Warp 4.0, float32, cuda"})
    page = text_of(report(root))
    assert "engine of the training" in page
    assert "MuJoCo Warp 4.0, float32, cuda (1 run)" in page
    assert "C MuJoCo, float64 (1 run)" in page


def test_the_experts_hand_is_part_of_the_provenance(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    make(root / "old", 0.5, "task=cup-pour1", "method=deepmimic")
    assert "expert hand" not in text_of(report(root))
    for number, hand in enumerate(("published", "published", "rebuilt, approximate")):
        made = "task=cup-pour1", "method=deepmimic", f"seed={1 + number}"
        make(root / f"{number}", 0.5, *made, result={"expert_hand": hand})
    page = text_of(report(root))
    assert "expert hand published (2 runs) , rebuilt, approximate (1 run)" in page
