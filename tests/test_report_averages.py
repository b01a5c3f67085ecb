from __future__ import annotations

import re
from pathlib import Path

from report_runs import make, report, rows, text_of


def test_ablations_are_compared_with_the_papers(tmp_path: Path) -> None:
    names = ("none", "distance_15cm", "distance_25cm", "mean_hand", "open_hand")
    for i, name in enumerate(names):
        own = f"ablation={name}"
        make(tmp_path / "runs" / name, 0.2 + i / 10, "task=cup-pour1", own)
        make(tmp_path / "runs" / f"{name}-door", 1.0, "task=door-open", own)  # not in tcdm30
    text = text_of(report(tmp_path / "runs"))
    assert "Ablations" in text
    found = [r for r in rows("averages") if r["table"] == "ablation"]
    columns = ("row", "tasks", "success", "paper_success", "paper_success_same_tasks")
    # The paper's values by task are for no ablation.
    assert [tuple(r[column] for column in columns) for r in found] == [
        ("none", "1", "0.2", "0.755", "0.831"),
        ("distance_15cm", "1", "0.3", "0.286", ""),
        ("distance_25cm", "1", "0.4", "0.197", ""),
        ("mean_hand", "1", "0.5", "0.595", ""),
        ("open_hand", "1", "0.6", "0.231", ""),
    ]


def test_rows_that_are_not_the_papers_have_none_of_its_values(tmp_path: Path) -> None:
    own = {
        "plain": (),
        "near": ("ablation=distance_15cm", "ablation.distance_m=0.05"),
        "far": ("ablation=distance_15cm",),
        "graff": ("method=graff",),
        "graff-far": ("method=graff", "ablation=distance_15cm"),
        "hand": ("hand=dhand",),
        "hand-far": ("hand=dhand", "ablation=distance_15cm"),
    }
    for name, overrides in own.items():
        make(tmp_path / "runs" / name, 0.3, "task=cup-pour1", *overrides)
    report(tmp_path / "runs")
    stated = {
        (row["table"], row["setting"], row["row"]): (
            *(row["paper_success"], row["paper_com_error"]),
            row["paper_success_same_tasks"],
        )
        for row in rows("averages")
    }
    note = {key: values for key, values in stated.items() if any(values)}
    far = "pgdm, ablation=distance_15cm"
    assert {key for key in stated if key[0] == "ablation"} == {
        *(("ablation", "pgdm", "none"), ("ablation", far, "distance_15cm")),
        ("ablation", f"{far}, ablation.distance_m=0.05", "distance_15cm, distance_m=0.05"),
        *(("ablation", "graff", "none"), ("ablation", "pgdm, hand=dhand", "none")),
        ("ablation", "graff, ablation=distance_15cm", "distance_15cm"),
        ("ablation", f"{far}, hand=dhand", "distance_15cm"),
    }
    assert note == {
        ("source", "pgdm", "all"): ("0.745", "0.00523", "0.831"),
        ("source", "pgdm", "mocap"): ("0.75", "0.00445", "0.831"),
        ("ablation", "pgdm", "none"): ("0.755", "0.00482", "0.831"),
        ("ablation", far, "distance_15cm"): ("0.286", "0.0117", ""),
        ("baseline", "pgdm", "pgdm with pre-grasp"): ("0.755", "0.00482", "0.831"),
    }


def test_rows_of_one_name_stand_in_groups_of_their_own(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    for number, action in enumerate(("absolute", "residual")):
        own = "task=cup-pour1", f"action={action}"
        make(root / f"{action}-plain", 0.3 + number / 2, *own)
        make(root / f"{action}-open", 0.1 + number / 2, *own, "ablation=open_hand")
        make(root / f"{action}-none", 0.2 + number / 2, *own, "pregrasp=none")
    ramp = "method.curriculum.ramp_frames=40"
    make(root / "ramp", 0.4, "task=cup-pour1", "action=residual", "method=curriculum", ramp)
    page = report(root)
    tables = page[page.index('id="ablation"') : page.index('id="tasks"')]
    groups = [
        (heading, re.findall(r"<tr><th class=\"head\">(.+?) †</th>", rest))
        for heading, rest in re.findall(r"<h3>(.+?)</h3>(.*?)</table>", tables, re.DOTALL)
    ]
    pair = ["pgdm with pre-grasp", "pgdm without pre-grasp"]
    assert groups == [
        ("no further change", ["none", "open_hand"]),
        ("action=residual", ["none", "open_hand"]),
        ("no further change", pair),
        ("action=residual", [*pair, "curriculum with pre-grasp, ramp_frames=40"]),
    ]


def test_means_over_different_tasks_are_not_comparable(tmp_path: Path) -> None:
    note = "These rows cover different tasks: their means are not comparable."
    make(tmp_path / "runs" / "cup", 0.7, "task=cup-pour1")
    make(tmp_path / "runs" / "none", 0.1, "task=cup-pour1", "pregrasp=none")
    assert note not in text_of(report(tmp_path / "runs"))
    make(tmp_path / "runs" / "hammer", 0.7, "task=hammer-use1")
    text = text_of(report(tmp_path / "runs"))
    assert text.count(note) == 1
    assert "share no task" not in text
    apart = tmp_path / "apart"
    make(apart / "cup", 0.7, "task=cup-pour1")
    make(apart / "none", 0.1, "task=hammer-use1", "pregrasp=none")
    text = text_of(report(apart, out=apart / "out"))
    assert f"{note} They share no task, so there is no curve." in text
    assert not (apart / "out" / "baselines_curves.png").exists()


def test_single_runs_are_counted_instead_of_a_probability(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    scores = {"cup-pour1": (0.7, 0.1), "door-open": (0.3, 0.3), "duck-lift": (0.4, 0.2)}
    for task, pair in scores.items():
        for source, success in zip(("planned", "none"), pair, strict=True):
            own = f"task={task}", f"pregrasp={source}", "algo=ppo_fast"
            make(root / task / source, success, *own)
    text = text_of(report(root))
    assert "pgdm pgdm, pregrasp=none 2.5 of 3 tasks 3" in text  # the tie is a half
    assert "Common to all: algo=ppo_fast." in text
    row = rows("statistics")[-1]
    assert (row["value"], row["low"]) == ("0.833333", "")
    assert (row["tasks"], row["runs"], row["than_runs"]) == ("3", "3", "3")
