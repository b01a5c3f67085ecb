from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import short_runs
from PIL import Image

from pgdm.cli.main import main
from pgdm.errors import RunError
from pgdm.report import statistics
from pgdm.report.page import write_report
from report_runs import FRAMES, make, report, rows, text_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
CSVS = ["averages", "curves", "profiles", "runs", "statistics", "tasks"]
STATISTICS, CURVES = ["iqm", "profiles"], ["curves", "curves_error"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two settings on three tasks, with a failed run, a running one and a missing seed."""
    root = tmp_path_factory.mktemp("report") / "runs"
    for seed, success in enumerate((0.5, 0.7)):
        make(root / f"cup{seed}", success, "task=cup-pour1", f"seed={seed}")
        make(root / f"tooth{seed}", 0.3, "task=toothbrush-lift", f"seed={seed}")
    make(root / "door", 0.8, "task=door-open")
    make(root / "cup-none", 0.1, "task=cup-pour1", "pregrasp=none")
    make(root / "door-none", 0.6, "task=door-open", "pregrasp=none", state="failed")
    make(root / "tooth-none", 0.6, "task=toothbrush-lift", "pregrasp=none", state="running")
    return root


@pytest.fixture(scope="module")
def page(runs: Path) -> Path:
    """Return the report on these runs."""
    return write_report([str(runs)], runs.parent / "out", lambda *_: None)[0]


def test_the_text_of_the_page(page: Path) -> None:
    text = text_of(page.read_text())
    assert "6 finished 1 running 1 failed" in text
    assert "smoke budget" in text
    assert "All runs train for 40,960 frames; the paper's values are after 50,000,000." in text
    assert "1 run failed and counts in no average" in text
    assert "the disk is full" in text
    # Success, paper, difference in points, doing nothing, mean action.
    assert "cup-pour1 60.0% 83.1% † -23.1 † 0.0% 70.0%" in text
    assert "toothbrush-lift 30.0% 100.0% † -70.0 † 44.9% 40.0%" in text
    assert "1 missing" in text  # door-open has one seed of two
    assert "0 failed" in text
    assert "pregrasp=none" in text
    assert (
        "pgdm-run -m task=cup-pour1,door-open,toothbrush-lift seed=0,1 total_frames=40960" in text
    )
    assert "mujoco 4.0.0" in text
    assert "git revision 0123abc" in text


def test_no_better_than_doing_nothing_is_red(page: Path) -> None:
    text = page.read_text()
    found = re.findall(r'<th>([a-z0-9-]+)</th>\s*<td class="bad"><b>', text)
    assert found == ["toothbrush-lift"]  # 30%; doing nothing gives 45%
    overview = text[text.index('id="overview"') : text.index('id="source"')]
    assert re.findall(r'<b class="bad">(.*?)</b>', overview) == ["30.0%"]
    assert re.findall(r'<b class="">(.*?)</b>', overview) == ["60.0%", "10.0%", "80.0%"]


def test_exactly_as_good_as_doing_nothing_is_no_better(tmp_path: Path) -> None:
    make(
        tmp_path / "runs" / "a", 1 / 19, "task=spheremedium-lift"
    )  # 1 of 19 steps by doing nothing
    make(tmp_path / "runs" / "b", 0.0527, "task=spheremedium-lift", "pregrasp=none")
    text = report(tmp_path / "runs")
    assert re.findall(r'class="bad">(?:<b>)?(5.3%)', text) == ["5.3%"] * 2  # in both tables
    assert text.count("5.3%") > 4


def test_all_files_are_there_and_pictures_are_whole(page: Path) -> None:
    assert sorted(p.stem for p in page.parent.glob("*.csv")) == CSVS
    pictures = sorted(page.parent.glob("*.png"))
    averages = ["baselines", "baselines_curves", "mean_curves"]
    assert [p.stem for p in pictures] == sorted([*averages, *STATISTICS, *CURVES])
    inside = re.findall(r'src="data:image/(?:png|jpeg);base64,([^"]+)"', page.read_text())
    # A panel for each task and metric, videos.
    assert len(inside) == len([*averages, *STATISTICS]) + 3 * len(CURVES) + 8
    for data in inside:
        with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
            picture.load()


def test_nothing_is_loaded_from_elsewhere(page: Path) -> None:
    text = page.read_text()
    assert re.findall(r"https?://|<script|<link|@import|url\(", text) == []
    assert "default-src 'none'; img-src data:" in text
    films = re.findall(r'href="([^"]+\.mp4)"', text)
    assert len(films) == 8
    assert all((page.parent / film).read_bytes() == b"film" for film in films)


def test_numbers_follow_from_the_runs(page: Path) -> None:
    out = page.parent
    scores: dict[tuple[str, str], list[float]] = {}
    for run in rows("runs", out):
        if run["counted"] == "yes":
            key = run["setting"], run["task"]
            scores.setdefault(key, []).append(float(run["eval_sampled/success"]))
    for row in rows("tasks", out):
        own = scores.get((row["setting"], row["task"]), [])
        assert row["seeds_finished"] == str(len(own))
        assert row["success"] == (f"{np.mean(own):.6g}" if own else "")
        assert row["comparable_with_paper"] == "no"
    for row in rows("statistics", out):
        if row["statistic"] == "interquartile_mean":
            own = [np.array(v) for (s, _), v in scores.items() if s == row["setting"]]
            assert float(row["value"]) == pytest.approx(statistics.iqm(own).value, rel=1e-5)
    better = next(r for r in rows("statistics", out) if r["statistic"] == "improvement")
    counts = better["tasks"], better["runs"], better["than_runs"]
    assert (better["value"], *counts) == ("1", "1", "2", "1")  # only cup-pour1 is shared
    assert "pgdm pgdm, pregrasp=none 100.0% [100.0%, 100.0%] 1" in text_of(page.read_text())


def test_table_one_and_baselines(page: Path) -> None:
    out = page.parent
    found = {(r["table"], r["row"], r["tasks"]): r for r in rows("averages", out)}
    every = found["source", "all", "3"]
    assert float(every["success"]) == pytest.approx((0.6 + 0.3 + 0.8) / 3, rel=1e-5)
    assert every["paper_success"] == "0.745"
    assert float(every["paper_success_same_tasks"]) == pytest.approx(
        (0.831 + 1.0 + 0.922) / 3, 1e-5
    )
    assert every["not_comparable_because"] == "40,960 of 50,000,000 frames"
    assert float(found["source", "teleop", "1"]["success"]) == 0.8
    assert float(found["source", "mocap", "2"]["success"]) == pytest.approx(0.45)
    plain = found["baseline", "pgdm with pre-grasp", "1"]  # cup-pour1
    assert (plain["success"], plain["paper_success_same_tasks"]) == ("0.6", "0.831")
    bare = found["baseline", "pgdm without pre-grasp", "1"]
    assert (bare["success"], bare["paper_success_same_tasks"]) == ("0.1", "")
    assert [r for r in rows("averages", out) if r["table"] == "ablation"] == []


def test_the_overview_has_settings_as_rows_if_they_are_more_than_tasks(tmp_path: Path) -> None:
    make(tmp_path / "runs" / "a", 0.7, "task=cup-pour1")
    make(tmp_path / "runs" / "b", 0.2, "task=door-open")
    assert "configuration cup-pour1 door-open" not in text_of(report(tmp_path / "runs"))
    for source in ("mined", "none"):
        make(tmp_path / "runs" / source, 0.1, "task=cup-pour1", f"pregrasp={source}")
    text = text_of(report(tmp_path / "runs"))
    assert (
        "configuration cup-pour1 door-open pgdm&nbsp;† 70.0% 20.0% "
        "pgdm, pregrasp=mined&nbsp;† 10.0%" in text
    )
    assert "paper 83.1% 92.2% doing nothing 0.0% 0.0%" in text


def test_the_papers_own_runs_are_comparable(tmp_path: Path) -> None:
    make(tmp_path / "runs" / "a", 0.7, "task=cup-pour1", "total_frames=50_000_000")
    text = text_of(report(tmp_path / "runs"))
    assert "cup-pour1 70.0% 83.1% -13.1 0.0%" in text
    assert "Not the paper's budget" not in text
    assert rows("tasks")[0]["comparable_with_paper"] == "yes"


def test_what_training_added_is_told_with_its_sum_also_of_stored_runs(tmp_path: Path) -> None:
    grasp, soft = ({"shaping": words} for words in ("exp(-d/0.1 m) is added", "rewards are scaled"))
    for seed, added in enumerate((40.0, 50.0)):
        settings = ("task=cup-pour1", "shaping=grasp", f"seed={seed}")
        run = make(tmp_path / "made" / f"{seed}", 0.7, *settings, result=grasp)
        for share, more in ((0.5, 900.0), (0.95, added - 2), (1.0, added + 2)):
            metrics = {"train/return": 100.0, "train/shaping": more}
            place = {"frames": round(share * FRAMES), "iteration": 9, "time_s": 9.0}
            run.log.append(metrics, kind="train", **place)
        short_runs.store(run, tmp_path / "kept" / "runs" / f"{seed}", tmp_path / "kept")
    settings = ("task=cup-pour1", "shaping=soft_end")
    make(tmp_path / "made" / "soft", 0.7, *settings, result=soft)
    make(tmp_path / "made" / "plain", 0.7, "task=cup-pour1")
    never = "In training only, never in evaluations:"
    sums = "the added rewards sum to 45.0 per episode in the last tenth of the training, the task's"
    told = f"{never} {grasp['shaping']}. This is so in pgdm, shaping=grasp ({sums} own to 100.0)."
    also = f"{never} {soft['shaping']}. This is so in pgdm, shaping=soft_end."
    for folder, sentences in (("made", [told, also]), ("kept", [told])):
        text = text_of(report(tmp_path / folder))
        assert [sentence in text for sentence in sentences] == [True] * text.count(never)
        trained = {row["train/shaping"] for row in rows("curves") if row["kind"] == "train"}
        assert {"38", "42", "48", "52", "900"} <= trained


def test_nothing_has_finished_yet(tmp_path: Path) -> None:
    make(tmp_path / "runs" / "a", 0.7, "task=cup-pour1", state="running")
    for file in ("metrics.jsonl", "videos"):
        path = tmp_path / "runs" / "a" / file
        path.unlink() if path.is_file() else shutil.rmtree(path)
    text = text_of(report(tmp_path / "runs"))
    assert "cup-pour1 - 83.1% † - 0.0% - -" in text
    assert "0 running" in text


def test_a_task_that_is_not_in_the_paper(tmp_path: Path) -> None:
    make(tmp_path / "runs" / "a", 0.7, "task=dmanus-sim2real")
    text = text_of(report(tmp_path / "runs"))
    assert "dmanus-sim2real 70.0% - -" in text
    assert rows("averages") == []


def test_command(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(runs)]) == 0
    printed = capsys.readouterr().out
    assert printed == (
        f"8 runs (6 finished, 1 running, 1 failed): {runs / 'report' / 'report.html'}\n"
    )
    assert main(["report", str(runs), "--out", "there"]) == 0  # its own output is no run
    assert len(rows("runs", "there")) == 8


def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["report", "empty"]) != 0
    error = capsys.readouterr().err
    assert error.startswith("error: no runs in empty; name a folder that holds some")
    assert error.count("\n") == 1
    make(tmp_path / "runs" / "a", 0.7, "task=cup-pour1")
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="cannot write the report to 'file/x'"):
        report("runs", out=Path("file/x"))
    (tmp_path / "runs" / "a" / "config.yaml").write_text("][")
    with pytest.raises(RunError, match="of 1 run none can be read"):
        report("runs")


PROBE = """<script>addEventListener("load", () => {
  const wide = [...document.body.querySelectorAll("*")].filter(e => !e.closest(".scroll, pre")
    && e.getBoundingClientRect().right > innerWidth + 0.5).map(e => e.outerHTML.slice(0, 80));
  const loaded = performance.getEntriesByType("resource").map(e => e.name);
  const broken = [...document.images].filter(i => !i.naturalWidth).length;
  const page = document.documentElement.scrollWidth;
  parent.postMessage(JSON.stringify({width: innerWidth, page, wide, loaded, broken}), "*");
})</script>"""
# A frame, as the browser's own windows are at least 500 pixels wide.
FRAME = """<script>addEventListener("message", e => document.title = e.data)</script>
<iframe src="probe.html" style="width: {}px; height: 900px; border: 0"></iframe>"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
@pytest.mark.parametrize("width", [390, 1280])
def test_fits_phone_and_desktop(page: Path, tmp_path: Path, width: int) -> None:
    assert CHROMIUM is not None
    text = page.read_text().replace("<details >", "<details open>")  # so that nothing is hidden
    text = re.sub(r"<meta http-equiv[^>]+>", "", text).replace("</body>", f"{PROBE}</body>")
    (tmp_path / "probe.html").write_text(text, encoding="utf-8")
    (tmp_path / "frame.html").write_text(FRAME.format(width), encoding="utf-8")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    command += ["--disable-background-networking", "--disable-component-update", "--no-first-run"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", "--hide-scrollbars"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=10000"]
    done = subprocess.run(
        [*command, "--dump-dom", (tmp_path / "frame.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    found = re.search(r"<title>(.*?)</title>", done.stdout)
    assert found, done.stdout[:2000]
    measured = json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">"))
    assert measured == {"width": width, "page": width, "wide": [], "loaded": [], "broken": 0}
