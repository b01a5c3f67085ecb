from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from pgdm.report import figures
from pgdm.report.curves import _scale, curves, mean_curve
from pgdm.report.results import Results
from pgdm.report.runs import ERROR, SUCCESS, read_run
from report_runs import FRAMES, make


def results(tmp_path: Path, *tasks: str) -> Results:
    made = [
        make(tmp_path / f"{t}{s}", 0.4 + 0.4 * s, f"task={t}", f"seed={s}")
        for t in tasks
        for s in (0, 1)
    ]
    return Results([read_run(folder) for folder in made])


def test_mean_and_spread_by_hand(tmp_path: Path) -> None:
    runs = results(tmp_path, "cup-pour1").runs
    frames, mean, spread = mean_curve(runs, SUCCESS)
    assert frames.tolist() == [FRAMES * i // 4 for i in range(5)]
    assert mean == pytest.approx([0, 0.15, 0.3, 0.45, 0.6])
    # Of 0.4 and 0.8: both 0.2 from their mean, and one degree of freedom.
    assert spread[-1] == pytest.approx(0.2 * np.sqrt(2))


def test_mean_ends_with_the_shortest_run(tmp_path: Path) -> None:
    long, short = results(tmp_path, "cup-pour1").runs
    cut = {name: values[:3] for name, values in short.evaluations.items()}
    short.evaluations.update(cut)
    frames, mean, _ = mean_curve([long, short], SUCCESS)
    assert frames[-1] == FRAMES // 2
    assert mean[-1] == pytest.approx((0.2 + 0.4) / 2)


@pytest.mark.parametrize("metric", [SUCCESS, ERROR])
def test_every_task_has_its_panel(tmp_path: Path, metric: str) -> None:
    tasks = ["cup-pour1", "door-open", "duck-lift", "dhand-cup", "mug-drink3", "mouse-lift"]
    panels = curves(results(tmp_path, *tasks), metric, tmp_path / "all.png", lambda *_: None)
    assert sorted(panels) == sorted(tasks)
    sizes = set()
    for panel in panels.values():
        with Image.open(io.BytesIO(panel)) as picture:
            sizes.add(picture.size)
            colours = picture.convert("RGB").getcolors(1 << 16)
        assert any(r < 90 and b > 120 for _, (r, _, b) in colours or [])  # the first one's blue
    assert len(sizes) == 1
    with Image.open(tmp_path / "all.png") as whole:
        assert whole.width == 5 * sizes.pop()[0]


def test_a_short_curve_keeps_its_colour(tmp_path: Path) -> None:
    results_ = results(tmp_path, "cup-pour1", "duck-lift")
    other = make(tmp_path / "short", 0.9, "task=cup-pour1", "action=residual")
    run = read_run(other)
    run.evaluations.update({name: values[:2] / 8 for name, values in run.evaluations.items()})
    made = Results([*results_.runs, run])
    curves(made, SUCCESS, tmp_path / "all.png", lambda *_: None)
    wanted = {ImageColor.getrgb(figures.colour(made, setting)) for setting in made.settings}
    assert len(wanted) == 2
    with Image.open(tmp_path / "all.png") as whole:
        drawn = {colour for _, colour in whole.convert("RGB").getcolors(1 << 16) or []}
    assert wanted <= drawn


def test_panels_end_above_the_best_success(tmp_path: Path) -> None:
    for best, end in ((0.07, 0.1), (0.15, 0.2), (0.4, 0.5), (0.6, 1.0)):
        made = Results([read_run(make(tmp_path / f"{best}", best, "task=cup-pour1"))])
        assert _scale(made, SUCCESS).high == end
