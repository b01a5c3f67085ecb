from __future__ import annotations

import os
import threading
from pathlib import Path

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from hypothesis import given, settings
from hypothesis import strategies as st

from pgdm.config.compose import Composer, compose
from pgdm.config.groups import available, conf_dir, groups
from pgdm.config.identity import identity_hash
from pgdm.errors import ConfigError, UnknownNameError

TASKS = available("task")


def test_the_default_experiment_is_the_papers() -> None:
    cfg = compose()
    assert (cfg.task.id, cfg.hand.name, cfg.pregrasp.source) == ("hammer-use1", "adroit", "planned")
    assert cfg.num_envs * cfg.algo.steps_per_env == 4096
    assert (cfg.total_frames, cfg.seed, cfg.budget) == (50_000_000, 0, "paper")
    assert (cfg.algo.learning_rate, cfg.algo.gamma, cfg.algo.clip) == (1e-5, 0.95, 0.2)
    assert (cfg.method.reward.tracking_weight, cfg.method.reward.lift_weight) == (10.0, 2.5)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_composes(task: str) -> None:
    cfg = compose([f"task={task}"])
    assert cfg.task.id == cfg.task.motion == task
    first = task.partition("-")[0]
    assert cfg.hand.name == (first if first in ("dhand", "dmanus") else "adroit")
    model = cfg.task.objects[0].replace("_", "")
    assert cfg.task.tracked_body.split("/")[0] == model
    assert cfg.run_dir.startswith(f"runs/{task}/pgdm/planned-absolute-ppo-s0-")


OPTIONS = [(g, o) for g in groups() if g not in ("task", "experiment") for o in available(g)]


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes(group: str, option: str) -> None:
    compose([f"{group}={option}"])


@pytest.mark.parametrize("name", available("experiment"))
def test_every_named_experiment_composes_and_can_be_changed(name: str) -> None:
    cfg = compose([f"+experiment={name}", "task=cup-pour1", "seed=5"])
    assert (cfg.task.id, cfg.seed) == ("cup-pour1", 5)


@pytest.mark.parametrize(
    ("overrides", "frames", "label"),
    [
        ([], 50_000_000, "paper"),
        (["budget=paper", "total_frames=200_000"], 200_000, "reduced"),
        (["budget=reduced"], 1_000_000, "reduced"),
        (["budget=smoke"], 8192, "smoke"),
        (["budget=smoke", "total_frames=100_000_000"], 100_000_000, "smoke"),
        (["+experiment=quickstart"], 300_000, "reduced"),
        (["+experiment=quickstart", "budget=smoke"], 8192, "smoke"),
        (["+experiment=quickstart", "budget=paper"], 50_000_000, "paper"),
    ],
)
def test_a_budget_is_a_length_and_a_true_label(
    overrides: list[str], frames: int, label: str
) -> None:
    cfg = compose(overrides)
    assert (cfg.total_frames, cfg.budget) == (frames, label)


def test_a_budget_changes_nothing_of_what_is_computed() -> None:
    hashes = {identity_hash(compose([f"budget={name}"])) for name in available("budget")}
    assert len(hashes) == 1


def test_quickstart_has_the_recommended_settings() -> None:
    cfg = compose(["+experiment=quickstart"])
    assert (cfg.action.kind, cfg.algo.name, cfg.num_envs) == ("residual", "sac", 64)
    assert (cfg.budget, cfg.time_limit_min) == ("reduced", 10)
    assert identity_hash(cfg) == identity_hash(compose(["+experiment=fast", "task=hammer-use1"]))


def test_a_composition_changes_no_later_one() -> None:
    """Hydra merges into the nodes of the files that it has read."""
    composer = Composer()
    composer.plain(["algo=sac_wide"])
    assert composer.plain(["+experiment=fast"]) == Composer().plain(["+experiment=fast"])


def test_ppo_fast_changes_only_what_it_says() -> None:
    paper, fast = compose().algo, compose(["algo=ppo_fast"]).algo
    changed = {name for name in vars(paper) if getattr(paper, name) != getattr(fast, name)}
    assert changed == {"name", "learning_rate", "steps_per_env", "normalize_observations"}


def test_the_benchmark_is_the_papers() -> None:
    """The averages that the paper states in its text and Table I."""
    tasks = [compose([f"task={name}"]).task for name in TASKS]
    rated = [task for task in tasks if task.paper_success is not None]
    assert (len(tasks), len(rated), sum(task.tcdm30 for task in tasks)) == (58, 50, 30)
    success = {task.id: task.paper_success or 0.0 for task in rated}
    errors = [task.paper_com_error or 0.0 for task in rated]
    assert sum(success.values()) / 50 == pytest.approx(0.745, abs=5e-4)
    assert sum(errors) / 50 == pytest.approx(5.23e-3, abs=3e-5)  # of rounded values
    # For labeled the paper's text says 0.692, but its table of tasks gives 0.607; only the latter
    # agrees with the mean over all.
    kinds = {
        "mocap": (37, 0.750),
        "teleop": (3, 0.845),
        "labeled": (7, 0.607),
        "learned": (3, 0.904),
    }
    for kind, (count, mean) in kinds.items():
        of_kind = [success[task.id] for task in rated if task.pregrasp_source == kind]
        assert len(of_kind) == count
        assert sum(of_kind) / count == pytest.approx(mean, abs=6e-4)


def test_another_hand_than_the_tasks_own() -> None:
    assert compose(["task=dhand-cup", "hand=adroit"]).hand.name == "adroit"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task=hammer-use9", "unknown task 'hammer-use9'; did you mean hammer-use1"),
        ("task=300000", "unknown task '300000'; valid: "),
        ("algo=null", "unknown algo 'null'; valid: ppo, "),
        ("hand=adriot", "unknown hand 'adriot'; did you mean adroit"),
        ("pregrasp=learnd", "unknown pregrasp 'learnd'; did you mean learned"),
        ("+experiment=quickstrat", "unknown experiment 'quickstrat'; did you mean quickstart"),
        ("experiment=quickstart", r"added with a plus: \+experiment=NAME"),
        ("seeed=1", "unknown key 'seeed'; did you mean seed"),
        ("learning_rate=1", "unknown key 'learning_rate'; did you mean algo.learning_rate"),
        ("algo.clipp=1", "unknown key 'algo.clipp'; did you mean algo.clip"),
        ("+algo.clipp=1", "unknown key of 'algo' 'clipp'; did you mean clip"),
        ("~sed", "unknown key 'sed'; did you mean seed"),
        ("+seed=3", r"'seed' exists already; leave out the \+"),
        ("seed=1,2", r"'seed=1,2' has several values; add -m .* seed=\[a,b\]"),
        ("task=[duck-lift,cup-pour1]", "task takes one option, .* -m task=duck-lift,cup-pour1"),
        ("task=null", "unknown task 'null'; valid: "),
        ("seed", "cannot read 'seed'; write key=value"),
        ("=3", "cannot read '=3'; write key=value"),
        ("+=3", r"cannot read '\+=3'; write key=value"),
        ("seed=$(ls)", "cannot read"),
        ("seed=???", "seed has no value yet; give one"),
        ("~seed", "missing seed"),
        ("seed=null", "seed: null is not allowed"),
        ("device=${foo}", "Interpolation key 'foo' not found"),
        ("total_frames=abc", "total_frames: 'abc' is not an integer"),
        ("num_envs=1.5", "num_envs: 1.5 is not an integer"),
        ("algo.hidden.x=3", "cannot apply algo.hidden.x=3"),
        ("hydra.foo=3", "unknown key 'hydra.foo'"),
        ("task@x=duck-lift", "unknown key 'task@x'; did you mean task"),
    ],
)  # fmt: skip
def test_wrong_settings_are_answered_on_one_line(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        compose([override])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["algo.clip=0.1"], "'algo.clip' is a setting of algo=ppo or ppo_fast or ppo_wide only"),
        (["algo.updates_per_stp=2"], "did you mean algo.updates_per_step or"),
    ],
)
def test_messages_know_the_learner_that_an_experiment_chose(
    overrides: list[str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(["+experiment=fast", *overrides])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["~algo.learner"], "missing algo.learner; one of ppo, sac"),
        (["~method.name"], "missing method.name; one of pgdm, deepmimic, graff"),
        (["algo.learner=null"], "algo.learner: null is not allowed here; it must be text"),
        (
            ["algo.learner=sac"],
            "algo.gae_lambda belongs to algo.learner=ppo, not to sac; .*: algo=sac$",
        ),
        (
            ["method=graff", "method.name=pgdm"],
            "method.contact belongs to method.name=graff or full, not to pgdm; .*: method=pgdm$",
        ),
    ],
)
def test_settings_of_several_learners_or_methods(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(overrides)


@settings(deadline=None, max_examples=30)
@given(st.text(st.characters(codec="ascii"), max_size=12), st.text(max_size=8))
def test_any_text_is_a_setting_or_refused(key: str, value: str) -> None:
    try:
        compose([f"{key}={value}"])
    except ConfigError as error:
        assert str(error)


def test_your_own_settings_folder(tmp_path: Path) -> None:
    own = tmp_path / "my 'own' settings"
    (own / "task").mkdir(parents=True)
    (own / "task" / "mine.yaml").write_text(
        "defaults: [_tcdm, _self_, {override /hand@_global_.hand: dhand}]\n"
        "id: mine\nobjects: [cup]\npregrasp_source: labeled\ntrajectory_source: animator\n"
        "tcdm30: false\npaper_success: null\npaper_com_error: null\n"
    )
    cfg = compose(["task=mine"], config_dir=own)
    assert (cfg.task.tracked_body, cfg.hand.name) == ("cup/object", "dhand")
    assert "mine" in available("task", own)
    with pytest.raises(UnknownNameError, match="unknown task 'mine'"):
        compose(["task=mine"])


@pytest.mark.parametrize("name", ["experiment/fast", "suite/quick6", "task/_tcdm"])
def test_a_file_of_your_own_with_the_name_of_one_of_pgdms(tmp_path: Path, name: str) -> None:
    file = tmp_path / f"{name}.yaml"
    file.parent.mkdir()
    file.write_text("seed: 7\n")
    with pytest.raises(ConfigError, match="give yours another name") as caught:
        compose(config_dir=tmp_path)
    assert str(file) in str(caught.value)
    assert str(conf_dir() / f"{name}.yaml") in str(caught.value)
    file.rename(file.with_name("mine.yaml"))
    compose(config_dir=tmp_path)


def test_pgdms_own_folder_may_be_named(tmp_path: Path) -> None:
    assert compose(config_dir=conf_dir()) == compose()


def test_an_edited_file_is_read_anew(tmp_path: Path) -> None:
    (tmp_path / "sim").mkdir()
    file = tmp_path / "sim" / "mine.yaml"
    for iterations, when in ((7, 1_000), (9, 2_000)):
        file.write_text(f"defaults: [default]\nsolver_iterations: {iterations}\n")
        os.utime(file, (when, when))
        cfg = compose(["sim=mine"], config_dir=tmp_path)
        assert cfg.sim.solver_iterations == iterations


def test_a_broken_file_of_your_own(tmp_path: Path) -> None:
    (tmp_path / "sim").mkdir()
    (tmp_path / "sim" / "mine.yaml").write_text("solver_iterations: [1\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml: not valid YAML"):
        compose(["sim=mine"], config_dir=tmp_path)


def test_a_task_without_a_hand_is_refused(tmp_path: Path) -> None:
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "mine.yaml").write_text("id: mine\n")
    with pytest.raises(ConfigError, match="You must specify 'hand'"):
        compose(["task=mine"], config_dir=tmp_path)


def test_a_missing_settings_folder_is_named() -> None:
    with pytest.raises(ConfigError, match=r"config_dir .*nowhere' is not a folder"):
        compose(config_dir="nowhere")


def test_inside_a_hydra_app_nothing_of_it_is_disturbed() -> None:
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        before = GlobalHydra.instance().hydra
        assert compose(["task=duck-lift", "seed=17"]).task.id == "duck-lift"
        assert GlobalHydra.instance().hydra is before
        with pytest.raises(ConfigError):
            compose(["task=none-such"])
        assert hydra.compose("config").task.id == "hammer-use1"
    assert not GlobalHydra.instance().is_initialized()


def test_threads_may_compose_at_once() -> None:
    seeds: list[int] = []
    jobs = [
        threading.Thread(target=lambda s=s: seeds.append(compose([f"seed={s}"]).seed))
        for s in range(100, 106)
    ]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join()
    assert sorted(seeds) == list(range(100, 106))


def test_unknown_group_lists_the_groups() -> None:
    with pytest.raises(UnknownNameError, match="unknown config group 'taks'; did you mean task"):
        available("taks")
