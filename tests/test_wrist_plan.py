"""The wrist planner: its parts by hand, its plan of the shortest task, and how plans are kept."""

from __future__ import annotations

import copy
import re
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from command_line import TINY_SAC, Outcome, command
from pgdm.config.compose import compose
from pgdm.errors import ConfigError, CorruptAssetError, RenderError
from pgdm.experiment import env_builder, foreseen
from pgdm.library import Start, open_library
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.library.progress import StepProgress, silent
from pgdm.motion.reference import ObjectReference
from pgdm.runs.files import read_json
from pgdm.sim import gl
from pgdm.sim.batch import SimBatch
from pgdm.sim.scene import Scene, build_scene, hand_alone
from pgdm.wrist import problem as problems
from pgdm.wrist import stored
from pgdm.wrist.hand import HandAlone
from pgdm.wrist.plan import WristPlan, WristProblem, plan_wrist, shortcoming, simulate
from pgdm.wrist.quadratic import Limits, Model
from pgdm.wrist.search import SMOOTH_STAGE, Search, Stage
from pgdm.wrist.stored import FILE, WristPlans, path_of, read, write
from tiny_scene import double

TASK = "duck-lift"
"""The shortest: 20 steps."""


@pytest.fixture(scope="module")
def problem(library_home: Path) -> WristProblem:
    return env_builder(compose([f"task={TASK}"]), open_library()).wrist_problem


@pytest.fixture(scope="module")
def plan(problem: WristProblem) -> WristPlan:
    return plan_wrist(problem, num_threads=1)


@pytest.fixture
def search(problem: WristProblem) -> Search:
    return Search(problem, 1, silent)


def scene(task: str) -> Scene:
    cfg = compose([f"task={task}"])
    return build_scene(open_library(), cfg.task, cfg.hand, cfg.sim)


# The planner


def test_a_plan_is_what_the_simulator_does_with_its_commands(
    problem: WristProblem, plan: WristPlan
) -> None:
    again = simulate(problem, plan.commands)
    np.testing.assert_array_equal(again.qpos, plan.qpos)
    np.testing.assert_array_equal(again.error_m, plan.error_m)
    assert plan.qpos.shape == (len(problem.reference), problem.scene.model.nq)
    assert plan.frames > 0 and plan.seconds > 0


def test_commands_and_joints_keep_their_ranges(problem: WristProblem, plan: WristPlan) -> None:
    index, joints = problem.scene.index, plan.qpos[:, :6]
    assert (plan.commands >= index.ctrl_low[:6]).all()
    assert (plan.commands <= index.ctrl_high[:6]).all()
    low, high = problem.scene.model.jnt_range[:6].T
    assert (joints >= low - 1e-3).all()
    assert (joints <= high + 1e-3).all()


def test_a_plan_is_far_nearer_than_its_path_sent_as_it_is(
    problem: WristProblem, plan: WristPlan, search: Search
) -> None:
    sent = simulate(problem, search.path[1:])
    assert plan.rigid_grasp >= 0.95
    assert plan.error_m.mean() < 0.1 * sent.error_m.mean()


@pytest.mark.slow
@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize(
    ("task", "mean_mm"), [("dhand-alarmclock", 0.5), ("dmanus-crackerbox", 10)]
)
def test_other_hands_follow_too(task: str, mean_mm: float) -> None:
    # Measured: 0.2 and 8.9 mm; without a plan it is 73 and 130 mm. D'Manus' servos are soft.
    made = plan_wrist(env_builder(compose([f"task={task}"]), open_library()).wrist_problem)
    assert 1e3 * made.error_m.mean() < mean_mm


def test_a_motion_out_of_reach_is_told_with_the_joints_that_end(
    problem: WristProblem, plan: WristPlan
) -> None:
    away = torch.linspace(0, 1, len(problem.reference)).double()[:, None] * double([0.0, 0.0, 1.0])
    far = ObjectReference(problem.reference.pos + away, problem.reference.quat)
    beyond = replace(problem, reference=far)
    told = shortcoming(beyond, plan_wrist(beyond, num_threads=1))
    assert told is not None and "\n" not in told
    assert re.search(r"rigid grasp \d\d%, the hand alone \d+ mm off .*: adroit/.*ARTz$", told)
    assert shortcoming(problem, plan) is None
    model = copy.deepcopy(problem.scene.model)
    model.jnt_limited[0], model.jnt_range[0] = 0, 0.0
    free = replace(beyond, scene=replace(problem.scene, model=model))
    still = shortcoming(free, replace(plan, error_m=plan.error_m + 0.05))
    assert still is not None and "beyond" not in still


def test_the_number_of_threads_changes_nothing(problem: WristProblem, plan: WristPlan) -> None:
    told: list[tuple[int, int]] = []
    two = plan_wrist(problem, 2, lambda _, done, rounds: told.append((done, rounds)))
    np.testing.assert_array_equal(two.commands, plan.commands)
    assert [done for done, _ in told] == sorted({done for done, _ in told})
    assert all(done <= rounds for done, rounds in told)


def test_a_hand_that_is_held_stays_and_then_catches_up(problem: WristProblem) -> None:
    hold = 4
    held = replace(problem, hold_steps=hold)
    assert held.key() != problem.key()
    plan = plan_wrist(held, num_threads=1)
    points = HandAlone(held, hand_alone(held.scene)).rollout(plan.commands).points
    away = np.linalg.norm(points - held.reference.pos.numpy()[0], axis=1)
    assert away[:hold].max() < 0.01
    assert plan.error_m[:hold].max() > 0.05  # the motion goes on meanwhile
    assert plan.error_m[2 * hold :].max() < 0.01


def test_a_load_grows_with_the_rise_after_the_hold(problem: WristProblem) -> None:
    bearing = replace(problem, hold_steps=2, bears_load=True)
    load, height = bearing.load_n(), problem.reference.pos[:, 2].numpy()
    model, duck = problem.scene.model, problem.scene.index.object_body
    weight = 9.81 * float(model.body_subtreemass[duck])
    assert (load[:3] == 0).all()
    rise = height[3:] - height[0]
    np.testing.assert_allclose(load[3:], weight * (rise / 0.02).clip(0, 1))
    assert load.max() == pytest.approx(weight)  # it is lifted by more than 2 cm
    assert not replace(bearing, bears_load=False).load_n().any()


def test_what_hangs_on_a_hinge_is_not_carried(library_home: Path) -> None:
    problem = env_builder(compose(["task=door-open"]), open_library()).wrist_problem
    assert not replace(problem, bears_load=True).load_n().any()


def test_a_weight_pulls_the_base_down_as_its_spring_lets_it(problem: WristProblem) -> None:
    # At rest slides of gain k give way to a force F by F / k.
    sim = SimBatch(hand_alone(problem.scene), 2, 1, problem.substeps)
    ctrl = np.tile(problem.fingers, (2, 1))
    ctrl[:, :6] = problem.qpos[:6]
    ctrl[:, 1] += 0.1  # up, clear of the table
    palm = HandAlone(problem, hand_alone(problem.scene)).palm
    sim.reset(np.arange(2), problem.qpos, problem.qvel)
    force = np.array([[0.0, 0, 0], [0.0, 0, -3.5]])
    for _ in range(200):
        sim.push(palm, force, sim.body_pose(palm)[0])
        sim.step(ctrl)
    slides = sim.read().qpos[:, :3].numpy()
    stiffness = problem.scene.model.actuator_gainprm[0, 0]
    assert np.linalg.norm(slides[1] - slides[0]) == pytest.approx(3.5 / stiffness, rel=0.02)


def test_commands_that_bear_a_load_follow_with_it(problem: WristProblem, plan: WristPlan) -> None:
    loaded = replace(problem, bears_load=True)
    assert loaded.key() != problem.key()
    bearing = plan_wrist(loaded, num_threads=1)
    assert bearing.error_m.mean() < 0.002
    # 0.29 kg at 175 N/m are 16 mm.
    assert simulate(loaded, plan.commands).error_m.max() > 0.01


def test_a_key_tells_all_that_a_plan_depends_on(problem: WristProblem) -> None:
    scene = problem.scene
    heavy = replace(scene.index, num_compensated=6)
    windy = copy.deepcopy(scene.model)
    windy.opt.wind[0] = 1.0
    weak = copy.deepcopy(scene.model)
    weak.actuator_forcerange[0] = -1, 1
    stiff = replace(scene.hand, num_wrist_joints=0)
    others = [
        replace(problem, scene=replace(scene, index=heavy)),
        replace(problem, scene=replace(scene, model=windy)),
        replace(problem, scene=replace(scene, model=weak)),
        replace(problem, scene=replace(scene, hand=stiff)),
        replace(problem, substeps=problem.substeps + 1),
        replace(problem, hold_steps=1),
        replace(problem, qpos=problem.qpos + 1e-9),
        replace(problem, qvel=problem.qvel + 1e-9),
        replace(problem, fingers=problem.fingers + 1e-9),
    ]
    assert len({problem.key(), *(other.key() for other in others)}) == 1 + len(others)


def test_a_command_at_the_upper_end_of_its_range_comes_down_again(search: Search) -> None:
    # Differences beyond the range are zero: taken outward, they had such commands stay for good.
    top = np.repeat(search._high[None], len(search.path) - 1, axis=0)
    rollout = search._smooth_hand.rollout(top)
    model = search._linearise(top, rollout)
    assert (np.diag(model._joints_by) > 0).all()
    better = search.improve(top, Stage(2, SMOOTH_STAGE.trust), real=False)
    cost = search._cost(better, search._smooth_hand.rollout(better))
    assert cost < 0.1 * search._cost(top, rollout)


@pytest.mark.parametrize("seed", range(5))
def test_a_model_with_limits_finds_its_least(seed: int) -> None:
    random, size = np.random.default_rng(seed), 12
    jacobian, residuals = 30 * random.normal(size=(20, size)), random.normal(size=20)
    joints_by = np.tril(random.uniform(0.2, 1, (size, size)))
    limits = Limits(np.full(6, -0.1), np.full(6, 0.1))
    joints = random.uniform(-0.12, 0.12, (2, 6))
    model = Model(jacobian, residuals, joints_by, joints, limits)
    bound = np.full((2, 6), 0.05)

    def cost(step: np.ndarray) -> float:
        beyond = limits.beyond(joints + (joints_by @ step).reshape(2, 6))
        return float(((residuals + jacobian @ step) ** 2).sum() + (beyond**2).sum())

    step = model.least(-bound, bound).ravel()
    assert (np.abs(step) <= 0.05 + 1e-9).all()
    assert model.gain(step) == pytest.approx(cost(np.zeros(size)) - cost(step), rel=1e-6)
    options = {"maxiter": 5000, "maxfun": 10**6, "ftol": 1e-15, "gtol": 1e-10}
    known = minimize(cost, np.zeros(size), bounds=[(-0.05, 0.05)] * size, options=options)
    assert cost(step) == pytest.approx(known.fun, rel=1e-3)


def test_a_hold_that_leaves_no_time_is_refused(problem: WristProblem) -> None:
    replace(problem, hold_steps=9).check()
    with pytest.raises(ConfigError, match=r"hold_steps is 10: .* 20 steps; use at most 9$"):
        plan_wrist(replace(problem, hold_steps=10))


def test_a_motion_that_would_take_hours_is_refused(problem: WristProblem) -> None:
    reference = problem.reference
    long = ObjectReference(reference.pos.repeat(13, 1), reference.quat.repeat(13, 1))
    with pytest.raises(ConfigError, match=r"273 poses.*wrist_path=feasible$"):
        plan_wrist(replace(problem, reference=long))


def test_objects_stay_where_they_are_in_what_is_shown(
    problem: WristProblem, plan: WristPlan
) -> None:
    hand = problem.scene.model.nu
    assert (plan.qpos[:, hand:] == problem.qpos[hand:]).all()


def test_a_base_with_a_narrow_or_no_range_has_limits_in_order(problem: WristProblem) -> None:
    model = copy.deepcopy(problem.scene.model)
    model.jnt_range[3] = problem.qpos[3] + np.array([-0.02, 0.02])
    model.jnt_limited[0] = 0
    narrow = replace(problem, scene=replace(problem.scene, model=model))
    limits = Search(narrow, 1, silent)._limits
    assert limits.low[3] < limits.high[3]
    assert limits.low[0] == -np.inf and limits.high[0] == np.inf


def test_a_plans_path_keeps_joint_ranges_that_end_before_the_control_ranges(
    problem: WristProblem, search: Search
) -> None:
    model, ctrl_low = copy.deepcopy(problem.scene.model), problem.scene.index.ctrl_low
    least = search.path[:, 1].min() + 0.01
    model.jnt_range[1, 0] = least
    path = Search(replace(problem, scene=replace(problem.scene, model=model)), 1, silent).path
    assert ctrl_low[1] < search.path[:, 1].min() < least <= path[:, 1].min()


def test_only_residual_actions_plan_the_wrist() -> None:
    planned = "action.wrist_path=planned"
    assert compose(["action=residual", planned]).action.plans_wrist
    assert not compose([planned]).action.plans_wrist
    assert not compose(["action=residual"]).action.plans_wrist


# The hand alone


def pushing(model: mujoco.MjModel, qpos: np.ndarray, of_object: np.ndarray) -> int:
    """Return the number of contacts by which an object's geoms are pushed, or push."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    touching = data.contact.exclude == 0
    return int((of_object[data.contact.geom].any(axis=1) & touching).sum())


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("task", ["door-open", "hammer-strike"])  # dapg_hammer's is 'dapghammer'
def test_a_hand_alone_touches_no_object(task: str) -> None:
    whole = scene(task)
    before, alone = whole.digest(), hand_alone(whole)
    model, hand = whole.model, whole.hand
    robot = [model.body(i).name.startswith((f"{hand.name}/", "table")) for i in range(model.nbody)]
    of_object = ~np.array(robot)[model.geom_bodyid] & (model.geom_bodyid > 0)
    # The slides bring the palm's centre into the object's.
    data = mujoco.MjData(model)
    data.qpos[:] = open_library().motion(task).starts["planned"].qpos
    mujoco.mj_forward(model, data)
    palm = int(model.jnt_bodyid[hand.num_base_joints + hand.num_wrist_joints - 1])
    by = np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, by, None, palm)
    away = data.xipos[whole.index.object_body] - data.xipos[palm]
    data.qpos[:3] += np.linalg.solve(by[:, :3], away)
    assert pushing(model, data.qpos, of_object) > 4
    assert pushing(alone.model, data.qpos, of_object) == 0
    assert (alone.model.nq, alone.model.nv) == (model.nq, model.nv)
    assert whole.digest() == before != alone.digest()
    assert (model.pair_margin > -1).all()


PAIRED = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
<body name="cup/a"><freejoint/><geom name="cup" type="{}" size=".1 .1 .1"/></body>
<body name="arm/a"><freejoint/><geom name="arm" type="{}" size=".1 .1 .1"/></body></worldbody>
<contact><pair geom1="cup" geom2="arm"/><pair geom1="floor" geom2="cup"/></contact></mujoco>"""


@pytest.mark.parametrize("shapes", [("sphere", "capsule"), ("box", "box"), ("ellipsoid", "box")])
def test_pairs_that_a_model_names_do_not_push_either(
    shapes: tuple[str, str], problem: WristProblem
) -> None:
    model = mujoco.MjModel.from_xml_string(PAIRED.format(*shapes))
    cup, arm = np.array([False, True, False]), np.array([False, False, True])
    alone = hand_alone(replace(problem.scene, model=model, object_prefixes=("cup/",))).model
    assert pushing(model, model.qpos0, cup) >= 2
    assert pushing(alone, model.qpos0, cup) == 0
    assert pushing(alone, model.qpos0, arm) > 0  # by the floor, as before


# What is kept


def damaged(path: Path, **changes: object) -> None:
    """Write a plan's file with other arrays in it; None leaves one out."""
    with np.load(path) as file:
        arrays = dict(file) | changes
    kept = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    np.savez(path, **kept)  # type: ignore[arg-type]


def nan_within(plan: WristPlan) -> np.ndarray:
    commands = plan.commands.copy()
    commands[3, 2] = np.nan
    return commands


DAMAGE: dict[str, Callable[[Path, WristPlan], object]] = {
    "truncated": lambda path, plan: path.write_bytes(path.read_bytes()[:-300]),
    "empty": lambda path, plan: path.write_bytes(b""),
    "garbage": lambda path, plan: path.write_bytes(b"not a zip file at all" * 50),
    "shape": lambda path, plan: damaged(path, commands=plan.commands[:-1]),
    "strings": lambda path, plan: damaged(path, commands=plan.commands.astype(str)),
    "text": lambda path, plan: damaged(path, error_m="far"),
    "object": lambda path, plan: damaged(path, qpos=np.array({"a": 1}, dtype=object)),
    "ragged": lambda path, plan: damaged(path, qpos=np.array([[1], [1, 2]], dtype=object)),
    "complex": lambda path, plan: damaged(path, commands=plan.commands + 0j),
    "single": lambda path, plan: damaged(path, commands=plan.commands.astype(np.float32)),
    "nan": lambda path, plan: damaged(path, commands=nan_within(plan)),
    "missing": lambda path, plan: damaged(path, error_m=None),
    "no key": lambda path, plan: damaged(path, key=None),
    "key of strings": lambda path, plan: damaged(path, key=["a"] * 64),
}


def test_a_plan_comes_back_to_the_bit(
    problem: WristProblem, plan: WristPlan, tmp_path: Path
) -> None:
    path = path_of(tmp_path, problem)
    write(path, plan, problem)
    back = read(path, problem)
    for name in ("commands", "qpos", "error_m", "frames", "seconds"):
        np.testing.assert_array_equal(getattr(back, name), getattr(plan, name), name)
    assert back.sha256() == plan.sha256()
    assert path.name.startswith(f"{TASK}-adroit-")


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_plan_is_told_in_a_line(
    kind: str, problem: WristProblem, plan: WristPlan, tmp_path: Path
) -> None:
    path = path_of(tmp_path, problem)
    write(path, plan, problem)
    DAMAGE[kind](path, plan)
    with pytest.raises(CorruptAssetError) as error:
        read(path, problem)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_the_plan_of_another_problem_is_refused(
    problem: WristProblem, plan: WristPlan, tmp_path: Path
) -> None:
    path = path_of(tmp_path, problem)
    write(path, plan, replace(problem, hold_steps=3))
    with pytest.raises(CorruptAssetError, match=r"another version of planner or MuJoCo$"):
        read(path, problem)


class Counted:
    """Stands in for the planner and counts its calls."""

    def __init__(self, plan: WristPlan, takes_s: float = 0.0) -> None:
        self._plan, self._takes_s, self.calls = plan, takes_s, 0

    def __call__(
        self, problem: WristProblem, num_threads: int, progress: StepProgress
    ) -> WristPlan:
        self.calls += 1
        time.sleep(self._takes_s)
        progress("wrist plan", 1, 1)
        return self._plan


@pytest.fixture
def counted(plan: WristPlan, monkeypatch: pytest.MonkeyPatch) -> Counted:
    made = Counted(plan)
    monkeypatch.setattr(stored, "plan_wrist", made)
    return made


def test_a_plan_is_made_once_and_told(
    problem: WristProblem, counted: Counted, tmp_path: Path
) -> None:
    told: list[str] = []
    progress: list[tuple[str, int, int]] = []

    def note(step: str, done: int, total: int) -> None:
        progress.append((step, done, total))

    plans = WristPlans(tmp_path, None, told.append, note)
    first, second = plans(problem), plans(problem)
    assert counted.calls == 1
    assert first.sha256() == second.sha256()
    assert progress == [("wrist plan", 1, 1)]
    begun, finished = told
    assert begun.startswith(f"computing the wrist plan of '{TASK}'")
    assert path_of(tmp_path, problem).is_file()
    assert "within 1 cm in 100% of the steps" in finished


def test_a_damaged_plan_is_told_once_and_made_anew(
    problem: WristProblem, counted: Counted, tmp_path: Path
) -> None:
    told: list[str] = []
    path = path_of(tmp_path, problem)
    write(path, plan := counted._plan, problem)
    DAMAGE["strings"](path, plan)
    again = WristPlans(tmp_path, None, told.append, silent)(problem)
    assert counted.calls == 1
    assert [text for text in told if str(path) in text and "it is not used" in text] == told[:1]
    assert read(path, problem).sha256() == again.sha256() == plan.sha256()


def test_a_plan_that_may_not_be_made_is_missed(
    problem: WristProblem, counted: Counted, tmp_path: Path
) -> None:
    told: list[str] = []
    assert WristPlans(tmp_path / "library", None, told.append, progress=None)(problem) is None
    assert counted.calls == 0
    assert [text.startswith(f"no wrist plan of '{TASK}' is stored yet") for text in told] == [True]
    assert list(tmp_path.iterdir()) == []


def test_a_runs_own_plan_goes_first(
    problem: WristProblem, counted: Counted, tmp_path: Path
) -> None:
    told: list[str] = []
    library, run, plan = tmp_path / "library", tmp_path / "run", counted._plan
    own = replace(plan, commands=plan.commands + 1e-9)
    write(path_of(library, problem), plan, problem)
    write(run / FILE, own, problem)
    plans = WristPlans(library, run, told.append, progress=None)
    assert plans(problem).sha256() == own.sha256()
    (run / FILE).write_bytes(b"")
    assert plans(problem).sha256() == plan.sha256()
    (note,) = told
    assert note.startswith(str(run / FILE)) and note.endswith("it is not used")


def test_two_at_once_plan_once(
    problem: WristProblem, plan: WristPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = Counted(plan, takes_s=0.6)
    monkeypatch.setattr(stored, "plan_wrist", slow)
    found: list[str] = []

    def run() -> None:
        found.append(WristPlans(tmp_path, None, print, silent)(problem).sha256())

    both = [threading.Thread(target=run) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join(timeout=60)
    assert slow.calls == 1
    assert found == [plan.sha256()] * 2


@pytest.mark.parametrize("place", ["library", "library/wrist"])
def test_where_the_library_cannot_be_written_the_run_plans_for_itself(
    place: str, problem: WristProblem, counted: Counted, tmp_path: Path
) -> None:
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text("a file in the folder's place")
    told: list[str] = []
    plan = WristPlans(tmp_path / "library", None, told.append, silent)(problem)
    assert plan.sha256() == counted._plan.sha256() and counted.calls == 1
    assert any("cannot be written" in text and "with the run only" in text for text in told)


def test_a_runs_own_plan_serves_with_later_versions(
    problem: WristProblem, counted: Counted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = replace(counted._plan, commands=counted._plan.commands + 1e-9)
    write(tmp_path / "run" / FILE, own, problem)
    monkeypatch.setattr(problems, "VERSION", problems.VERSION + 1)
    plans = WristPlans(tmp_path / "library", tmp_path / "run", print, silent)
    assert plans(problem).sha256() == own.sha256()
    elsewhere = replace(problem, qpos=problem.qpos + 1e-3)
    assert plans(elsewhere).sha256() == counted._plan.sha256()  # not the run's: another start


def test_a_plan_that_is_stopped_leaves_nothing(problem: WristProblem, tmp_path: Path) -> None:
    def stop(step: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        WristPlans(tmp_path, None, print, stop, num_threads=1)(problem)
    assert not path_of(tmp_path, problem).exists()


# Who uses it


AT_ONCE = "+experiment=fast", "action.hold_steps=0", "action.carry_load=false"
"""As ``problem``: without hold and load."""


def fast_run(*arguments: str) -> Outcome:
    chosen = *AT_ONCE, f"task={TASK}", "keep_replay=true", "run_dir=run"
    return command("pgdm-run", "--offline", *TINY_SAC, *chosen, *arguments)


def test_a_run_keeps_its_plan_and_goes_on_with_it(
    own_library: Path, plan: WristPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    first = fast_run()
    assert (first.code, first.errors) == (0, [])
    assert "computing the wrist plan of" in " ".join(first.err.split())
    assert read_json(run / "result.json")["wrist_sha256"] == plan.sha256()
    (kept,) = (own_library / "wrist").glob("*.npz")
    assert (run / FILE).is_file()

    kept.unlink()
    monkeypatch.setattr(stored, "plan_wrist", lambda *_: pytest.fail("planned again"))
    longer = fast_run("total_frames=64")
    assert (longer.code, longer.errors) == (0, [])
    result = read_json(run / "result.json")
    assert (result["frames"], result["wrist_sha256"]) == (64, plan.sha256())
    evaluated = command("pgdm", "eval", "run", "--offline")
    assert (evaluated.code, evaluated.errors) == (0, [])
    assert not kept.exists()

    (run / FILE).write_bytes(b"")
    monkeypatch.setattr(stored, "plan_wrist", Counted(plan))
    again = command("pgdm", "eval", "run", "--offline")
    assert (again.code, again.errors, again.out) == (0, [], evaluated.out)
    told = r"run/wrist.npz.*; it is not used computing the wrist plan of 'duck-lift'"
    assert re.search(told, " ".join(again.err.split()))
    assert kept.is_file()


def test_a_run_and_its_evaluation_say_what_the_base_cannot_follow(
    own_library: Path, problem: WristProblem
) -> None:
    def pose(slide: float) -> None:
        qpos, path = problem.qpos.copy(), pregrasp_file.path_of(TASK, "adroit", "labeled")
        qpos[0] = slide  # its range ends at 0.25 m
        pregrasp_file.write(path, Pregrasp(Start(qpos, problem.qvel, None), None, {}))

    pose(0.4)
    posed = "pregrasp=labeled"
    beyond = env_builder(compose([f"task={TASK}", posed]), open_library()).wrist_problem
    kept = path_of(own_library, beyond)
    write(kept, plan_wrist(beyond, num_threads=1), beyond)
    told = rf"follow the whole motion of '{TASK}': rigid grasp .*beyond their range: adroit/ARTx"
    first = fast_run(posed)
    assert (first.code, first.errors) == (0, []) and "computing" not in first.err
    assert re.search(told, first.err)
    kept.unlink()
    evaluated = command("pgdm", "eval", "run", "--offline")
    assert (evaluated.code, evaluated.errors) == (0, [])
    assert re.search(told, evaluated.err)
    pose(0.9)
    (error,) = fast_run(posed).errors
    assert "labeled.npz: joint adroit/ARTx is at 0.900, its limits are -0.250 to 0.250" in error


def test_a_run_says_beforehand_that_its_wrist_is_planned_first(
    own_library: Path, problem: WristProblem, plan: WristPlan
) -> None:
    cfg = compose([*AT_ONCE, f"task={TASK}", "run_dir=run"])
    missing, *others = foreseen(cfg, open_library())
    assert missing.startswith(f"no wrist plan of '{TASK}' is stored yet")
    assert any("the replay takes" in note for note in others)
    assert not (own_library / "wrist").exists()
    dry = fast_run("--dry-run")
    assert dry.code == 0 and missing in " ".join((dry.out + dry.err).split())
    write(path_of(own_library, problem), plan, problem)
    assert foreseen(cfg, open_library()) == others


def test_a_plan_is_filmed(
    own_library: Path, problem: WristProblem, plan: WristPlan, tmp_path: Path
) -> None:
    try:
        gl.context_class()
    except RenderError as error:
        pytest.skip(str(error))
    write(path_of(own_library, problem), plan, problem)
    film = tmp_path / "wrist.mp4"
    done = command("pgdm", "view", TASK, "--wrist", "--video", str(film), "--offline")
    assert (done.code, done.errors) == (0, [])
    assert "within 1 cm in 75% of the steps" in " ".join(done.out.split())
    assert film.stat().st_size > 10_000


def test_views_exclude_each_other() -> None:
    both = command("pgdm", "view", TASK, "--wrist", "--reach")
    told = "error: --reach, --wrist, --ablations and --expert exclude each other"
    assert (both.code, both.errors) == (2, [told])
