from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from pgdm.config.compose import compose_plain
from pgdm.report import figures, mean_curves, tables
from pgdm.report.results import Results
from pgdm.report.runs import ERROR, SUCCESS
from pgdm.report.settings import Setting, setting_of
from pgdm.report.statistics import Estimate
from report_runs import curve_run

STEEP = {0: 0.0, 10: 0.2, 20: 0.4, 40: 0.8}
FLAT = {0: 0.0, 40: 0.0}


@cache
def setting(*overrides: str) -> Setting:
    return setting_of(compose_plain(overrides))


def lines(axes: Axes) -> list[list[tuple[float, float]]]:
    """Return frames and values of each line that is drawn."""
    points = [np.asarray(line.get_xydata()).tolist() for line in axes.lines]
    return [[(round(1e6 * x), round(y, 9)) for x, y in line] for line in points]


def bars(axes: Axes) -> tuple[list[float], list[tuple[float, ...]]]:
    """Return the widths and colours of the bars that are drawn."""
    drawn = [bar for bar in axes.patches if isinstance(bar, Rectangle)]
    return [bar.get_width() for bar in drawn], [to_rgba(bar.get_facecolor()) for bar in drawn]


def titles(figure: Figure) -> list[str]:
    return [axes.get_title("left") for axes in figure.axes if axes.get_title("left")]


def test_each_task_weighs_the_same_by_hand() -> None:
    plain = setting()
    one = [curve_run(plain, "a", STEEP)]
    two = [curve_run(plain, "b", {0: 0.0, 20: 0.4, 30: 0.6}), curve_run(plain, "b", FLAT, seed=1)]
    # The second task is 0, 0.2, 0.3 at 0, 20, 30; the first is 0.6 at 30, where the shortest ends.
    frames, mean = mean_curves.over_tasks([one, two], SUCCESS)
    assert frames.tolist() == [0, 10, 20, 30]
    assert mean.tolist() == pytest.approx([0, 0.15, 0.3, 0.45])
    _, error = mean_curves.over_tasks([one, two], ERROR)
    assert error.tolist() == pytest.approx([0.01, 0.0085, 0.007, 0.0055])


def test_baselines_are_means_over_shared_tasks() -> None:
    plain, mimic, bare = setting(), setting("method=deepmimic"), setting("pregrasp=none")
    results = Results(
        [
            curve_run(plain, "a", STEEP),
            curve_run(plain, "b", {0: 0.2, 20: 0.4}),
            curve_run(plain, "c", {0: 1.0, 40: 1.0}),  # nowhere else
            curve_run(mimic, "a", FLAT),
            curve_run(mimic, "b", {0: 0.0, 40: 0.4}),
            curve_run(mimic, "d", {0: 1.0, 40: 1.0}, tcdm30=False),
            curve_run(bare, "a", FLAT),
            curve_run(bare, "b", {0: 0.0, 30: 0.0}, state="running"),
            curve_run(bare, "b", {0: 0.0, 10: 0.0}, seed=1, state="failed"),
        ]
    )
    rows = tables.baselines(results)
    figure = mean_curves.compared(results, rows)
    assert figure is not None
    assert titles(figure) == ["mean of 2 shared tasks"]
    success, error = figure.axes
    assert lines(success) == [
        [(0, 0.1), (10, 0.25), (20, 0.4)],
        [(0, 0.0), (40, 0.2)],
        [(0, 0.0), (30, 0.0)],
    ]
    assert lines(error)[1] == [(0, 0.01), (40, 0.008)]
    assert [text.get_text() for text in figure.legends[0].texts] == [
        "pgdm with pre-grasp",
        "deepmimic with pre-grasp",
        "pgdm without pre-grasp",
    ]
    styles = [line.get_linestyle() for line in success.lines]
    assert styles == ["-", "-", "--"]
    high = success.get_ylim()[1]
    assert high == 0.5  # of the best line in the picture, 0.4


def test_groups_have_panels_of_their_own_and_one_scale() -> None:
    runs = []
    for action, best in (("absolute", 0.05), ("residual", 0.7)):
        for ablation in ("none", "open_hand"):
            made = setting(f"action={action}", f"ablation={ablation}")
            runs.append(curve_run(made, "a", {0: 0.0, 40: best}))
    results = Results([*runs, curve_run(runs[0].setting, "b", STEEP)])
    figure = mean_curves.compared(results, tables.by_ablation(results))
    assert figure is not None
    assert titles(figure) == [
        "no further change, mean of 1 shared task",
        "action=residual, mean of 1 shared task",
    ]
    small, _, large, _ = figure.axes
    assert lines(small) == [[(0, 0.0), (40, 0.05)]] * 2
    assert lines(large) == [[(0, 0.0), (40, 0.7)]] * 2
    assert small.get_ylim() == large.get_ylim() == (-0.02, 1.0)


def test_a_name_of_the_legend_has_one_colour_in_all_panels() -> None:
    # The same ablations of two methods, and one that only one of them has.
    made = [
        *(("ablation=none",), ("ablation=mean_hand",)),
        *(("method=graff",), ("method=graff", "ablation=open_hand")),
        ("method=graff", "ablation=mean_hand"),
        ("method=graff", "ablation=distance_15cm", "ablation.distance_m=0.05"),
    ]
    results = Results([curve_run(setting(*own), "a", STEEP) for own in made])
    figure = mean_curves.compared(results, tables.by_ablation(results))
    assert figure is not None
    legend = figure.legends[0]
    names = [text.get_text() for text in legend.texts]
    assert names == ["none", "mean_hand", "open_hand", "distance_15cm, distance_m=0.05"]
    none, mean, opened, near = (to_rgba(line.get_color()) for line in legend.get_lines())
    assert len({none, mean, opened, near}) == 4
    plain, _, graff, _ = figure.axes
    assert [to_rgba(line.get_color()) for line in plain.lines] == [none, mean]
    drawn = [to_rgba(line.get_color()) for line in graff.lines]
    assert (drawn[0], sorted(drawn)) == (none, sorted([none, mean, opened, near]))


def test_a_method_and_its_values_have_one_hue_in_all_panels() -> None:
    short = ("method=curriculum", "method.curriculum.ramp_frames=40")
    made = [(), ("pregrasp=none",), short, (*short, "pregrasp=none"), ("method=curriculum",)]
    runs = [
        curve_run(setting(*own, f"action={action}"), "a", STEEP)
        for own in made
        for action in ("absolute", "residual")
    ]
    rows = tables.baselines(Results(runs))
    shades, found = figures.shades(rows), {}
    for row in rows:
        found.setdefault(row.name, set()).add(shades[row.setting])
    assert {len(colours) for colours in found.values()} == {1}
    colour = {name: colours.pop() for name, colours in found.items()}
    ramp = ", ramp_frames=40"
    assert set(colour) == {
        *("pgdm with pre-grasp", "pgdm without pre-grasp", "curriculum with pre-grasp"),
        *(f"curriculum with pre-grasp{ramp}", f"curriculum without pre-grasp{ramp}"),
    }
    own = colour[f"curriculum with pre-grasp{ramp}"]
    assert own[:3] == colour[f"curriculum without pre-grasp{ramp}"][:3]
    assert (
        len({own[:3], colour["curriculum with pre-grasp"][:3], colour["pgdm with pre-grasp"][:3]})
        == 3
    )


def test_rows_that_share_no_task_are_listed() -> None:
    graff = ("method=graff", "ablation=open_hand")
    results = Results(
        [
            curve_run(setting(), "a", STEEP),
            curve_run(setting("ablation=open_hand"), "b", FLAT),
            curve_run(setting("method=graff"), "a", STEEP),
            curve_run(setting(*graff), "b", FLAT),
            curve_run(setting(*graff), "a", FLAT, state="running"),  # which has a curve
        ]
    )
    rows = tables.by_ablation(results)
    assert [row.tasks for row in rows] == [("a",), ("b",), ("a",), ("b",)]
    figure = mean_curves.compared(results, rows)
    assert figure is not None
    assert titles(figure) == ["method=graff, mean of 1 shared task"]
    assert mean_curves.apart(results, rows) == {"no further change"}
    once = Results([curve_run(s, "a", {40: 0.5}) for s in (setting(), setting("pregrasp=none"))])
    assert mean_curves.compared(once, tables.baselines(once)) is None
    assert mean_curves.apart(once, tables.baselines(once)) == set()  # they share one


def test_nothing_is_drawn_without_shared_tasks_or_evaluations() -> None:
    plain, bare = setting(), setting("pregrasp=none")
    apart = Results([curve_run(plain, "a", STEEP), curve_run(bare, "b", FLAT)])
    assert len(tables.baselines(apart)) == 2
    assert mean_curves.compared(apart, tables.baselines(apart)) is None
    once = Results([curve_run(plain, "a", {40: 0.5})])
    assert len(tables.by_source(once)) == 1
    assert mean_curves.validated(once, tables.by_source(once)) is None


def test_table_one_has_a_thin_line_for_each_seed_with_all_tasks() -> None:
    plain = setting()
    ends = {("a", 0): 0.4, ("a", 1): 0.8, ("b", 0): 0.2, ("b", 1): 0.0, ("b", 2): 0.7}
    runs = [curve_run(plain, t, {0: 0.0, 40: end}, seed=s) for (t, s), end in ends.items()]
    beyond = curve_run(plain, "c", STEEP, paper_success=None)  # no task of the paper's
    results = Results([*runs, beyond])
    figure = mean_curves.validated(results, tables.by_source(results))
    assert figure is not None
    assert titles(figure) == ["mean of 2 tasks; thin: 2 of 3 seeds"]
    # Seeds: (0.4 + 0.2) / 2 and (0.8 + 0) / 2; all: ((0.4 + 0.8) / 2 + (0.2 + 0 + 0.7) / 3) / 2.
    assert [line[-1] for line in lines(figure.axes[0])] == [(40, 0.3), (40, 0.4), (40, 0.45)]
    thin, other, thick = (line.get_linewidth() for line in figure.axes[0].lines)
    assert thin == other < thick
    alone = Results(runs[::2][:1])
    figure = mean_curves.validated(alone, tables.by_source(alone))
    assert figure is not None
    assert titles(figure) == ["mean of 1 task"]
    assert lines(figure.axes[0]) == [[(0, 0.0), (40, 0.4)]]


def test_bars_are_success_and_error_of_each_row() -> None:
    plain, mimic, bare = setting(), setting("method=deepmimic"), setting("pregrasp=none")
    results = Results(
        [
            curve_run(plain, "a", {0: 0.0, 40: 0.8}),
            curve_run(plain, "b", {0: 0.0, 40: 0.4}),
            curve_run(mimic, "a", {0: 0.0, 40: 0.5}),
            curve_run(bare, "a", {0: 0.0, 40: 0.1}),
        ]
    )
    figure = figures.bars(tables.baselines(results))
    success, error = figure.axes
    assert bars(success)[0] == pytest.approx([0.6, 0.5, 0.1])
    assert bars(error)[0] == pytest.approx([0.004, 0.005, 0.009])
    names = [label.get_text() for label in success.get_yticklabels()]
    assert names == ["pgdm with pre-grasp", "deepmimic with pre-grasp", "pgdm without pre-grasp"]
    extent = "mean of 1 to 2 tasks,\nwhich differ\n50,000,000 frames"
    assert success.get_xlabel() == f"success\n{extent}"
    assert error.get_xlabel() == f"COM error [m]\n{extent}"
    for axes in (success, error):
        pgdm, deepmimic, pale = bars(axes)[1]
        assert pgdm[:3] == pale[:3] != deepmimic[:3]
        assert pgdm[3] == deepmimic[3] == 1.0 > pale[3]


def test_pregrasps_of_two_sources_have_names_and_hues_of_their_own() -> None:
    made = [setting(f"pregrasp={source}") for source in ("planned", "mined", "none")]
    rows = tables.baselines(Results([curve_run(s, "a", FLAT) for s in made]))
    assert [row.name for row in rows] == [
        "pgdm with pre-grasp",
        "pgdm with pre-grasp, pregrasp=mined",
        "pgdm without pre-grasp",
    ]
    planned, mined, none = figures.shades(rows).values()
    assert planned[:3] == none[:3] != mined[:3]


def test_the_axis_of_interquartile_means_is_the_range_of_success() -> None:
    made = setting()
    results = Results([curve_run(made, "a", STEEP)])
    for value, low, high in ((0.01, 0.0, 0.6), (0.0, np.nan, np.nan), (0.9, 0.4, 1.0)):
        figure = figures.intervals(results, {made: Estimate(value, low, high)}, "mean")
        left, right = figure.axes[0].get_xlim()
        assert 0.0 <= left <= value <= right <= 1.0
    low_end = figures.intervals(results, {made: Estimate(0.01, 0.0, 0.6)}, "mean").axes[0]
    assert low_end.get_xlim()[0] == 0.0
