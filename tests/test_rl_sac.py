from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import SACLoss, SoftUpdate

from pgdm.errors import ConfigError, RunError
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.evaluate import Evaluator, network_of
from pgdm.rl.networks import ActionValue, SquashedCfg, SquashedPolicy
from pgdm.rl.sac import SACCfg, SACLearner, columns
from pgdm.rl.sac_loss import SoftActorCriticLoss
from pgdm.rl.trainer import Extras, Trainer
from pgdm.seeding import torch_stream
from toy_envs import TOY_SAC, PointEnv, trainer_cfg

SHORT = replace(TOY_SAC, steps_per_env=8, warmup_steps=8, batch_size=32)
"""64 frames an iteration; the first one is the warm-up."""
D, A, M = 5, 2, 64
TRAINED = "actor_network_params.module.0.module"
"""Prefix of the trained policy in the loss's state."""


class Lines(Callback):
    """Records the metrics of each iteration except times."""

    def __init__(self) -> None:
        self.noted: list[dict[str, float]] = []

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        self.noted.append({k: v for k, v in metrics.items() if "steps_per_s" not in k})


def trained(
    cfg: SACCfg = SHORT, frames: int = 512, seed: int = 3, threads: int = 1
) -> tuple[Trainer, list[dict[str, float]]]:
    lines = Lines()
    settings = trainer_cfg(cfg, total_frames=frames, seed=seed, num_threads=threads)
    trainer = Trainer(PointEnv(), settings, Extras(callbacks=[lines]))
    trainer.run()
    return trainer, lines.noted


def flat(state: Any) -> Any:
    """Return a state with its tensors as bytes."""
    if isinstance(state, Tensor):
        return state.numpy().tobytes()
    if isinstance(state, dict):
        return {k: flat(v) for k, v in state.items() if k != "elapsed_s"}
    return [flat(v) for v in state] if isinstance(state, list | tuple) else state


# The training as a whole.


def test_sac_brings_the_point_to_the_origin() -> None:
    evaluation = Evaluator(lambda n: PointEnv(n, seed=1), 16, 4, seed=3)
    trainer = Trainer(
        PointEnv(), trainer_cfg(TOY_SAC, total_frames=2048), Extras(evaluation=evaluation)
    )
    before = evaluation.evaluate(trainer.model)
    after = trainer.run().evaluation
    assert before is not None
    for kind in ("eval_sampled", "eval_deterministic"):
        # Both are negative; the distance to the origin falls to a third or less.
        assert after[f"{kind}/return"] > before[f"{kind}/return"] / 3


def test_the_same_seed_repeats_to_the_bit_whatever_the_global_stream() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = trained()
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    again, other = trained(), trained(seed=4)
    assert first[1] == again[1]
    assert flat(first[0].state_dict()) == flat(again[0].state_dict())
    assert first[1] != other[1]


def test_the_exploration_noise_is_standard_normal_and_correlated_over_steps() -> None:
    torch.manual_seed(0)
    learner = build(PointEnv(2000), replace(SHORT, noise_correlation=0.9))
    obs = torch.zeros(2000, D)
    with torch.no_grad():
        mean, std = learner.model(learner.model.normalizer(obs))
    actions = torch.stack([learner.explore(obs)[0] for _ in range(8)])
    noise = ((actions.double().atanh() - mean) / std).flatten(1)  # (8, 4000)
    assert noise.mean(1).abs().max() < 0.06
    assert (noise.std(1) - 1).abs().max() < 0.05
    lag = [float((noise[0] * noise[k]).mean()) for k in (1, 5)]
    assert lag == pytest.approx([0.9, 0.9**5], abs=0.05)


def test_the_average_follows_the_trained_policy_and_shares_its_statistics() -> None:
    env = PointEnv()
    learner = build(env, replace(SHORT, average_rate=0.25, actor_interval=1, warmup_steps=1))
    before = {name: p.detach().clone() for name, p in learner.model.net.named_parameters()}
    learner.after_step(one_step(env, obs=torch.randn(env.num_envs, D)))
    learner.during_step()  # one update
    trained = learner.state_dict()["loss"]
    assert not torch.equal(before["6.bias"], trained[f"{TRAINED}.net.6.bias"])
    for name, mean in learner.model.net.named_parameters():
        expected = before[name] + 0.25 * (trained[f"{TRAINED}.net.{name}"] - before[name])
        torch.testing.assert_close(mean.detach(), expected)
    assert torch.equal(learner.model.normalizer.mean, trained[f"{TRAINED}.normalizer.mean"])
    assert learner.model.normalizer.mean.abs().sum() > 0


@pytest.mark.parametrize("bfloat16", [False, True])
def test_updates_during_the_physics_change_no_bit(
    bfloat16: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"bf16": True})
    # Wide enough for torch to split the products over its threads.
    cfg = replace(SHORT, hidden=[256, 256], bfloat16=bfloat16)
    alone, overlapping = (trained(cfg, frames=256, threads=threads) for threads in (1, 2))
    assert alone[1] == overlapping[1]
    assert flat(alone[0].state_dict()) == flat(overlapping[0].state_dict())


def test_logged_values_and_when_they_begin() -> None:
    _, noted = trained(frames=192)
    learned = {"train/loss_critic", "train/loss_policy", "train/entropy", "train/temperature"}
    assert not learned & noted[0].keys()  # acting only
    assert learned <= noted[1].keys()
    assert noted[1]["train/temperature"] == pytest.approx(TOY_SAC.temperature_init, rel=0.1)
    assert all(math.isfinite(value) for name, value in noted[2].items() if name in learned)


@pytest.mark.parametrize(("actor_interval", "policies"), [(1, 12), (3, 4)])
def test_the_number_of_updates(actor_interval: int, policies: int) -> None:
    env = PointEnv()
    cfg = replace(SHORT, updates_per_step=3, actor_interval=actor_interval, warmup_steps=2)
    learner = build(env, cfg)
    counts: dict[str, int] = {}
    for name, optimizer in learner._optimizers.items():
        optimizer.register_step_post_hook(
            lambda *_, name=name: counts.update({name: counts.get(name, 0) + 1})
        )
    step = one_step(env)
    for _ in range(6):  # the first two are the warm-up
        learner.during_step()
        learner.after_step(step)
    assert counts == {"critics": 12, "policy": policies, "temperature": policies}


@pytest.mark.parametrize("betas", [[0.9], [0.9, 1.0], [-0.1, 0.9], [0.9, 0.99, 0.999]])
def test_invalid_decay_rates_are_refused(betas: list[float]) -> None:
    with pytest.raises(ConfigError, match=r"^algo.adam_betas is \[.*such as \[0.9,0.99\]$"):
        Trainer(PointEnv(), trainer_cfg(replace(TOY_SAC, adam_betas=betas)))


def test_the_replay_has_the_announced_size(tmp_path: Path) -> None:
    env = PointEnv()
    cfg = trainer_cfg(SHORT, total_frames=100)  # 2 iterations of 64
    Trainer(env, cfg, Extras(replay_folder=tmp_path / "replay")).run()
    on_disk = sum(path.stat().st_size for path in (tmp_path / "replay").glob("*.bin"))
    # 5 + 5 observations and 2 actions of 2 bytes, term and discount of 4, termination of 1.
    assert on_disk == SHORT.disk_bytes(env, env.num_envs, 100) == 128 * (2 * 12 + 2 * 4 + 1)


# One update.


def build(env: PointEnv, cfg: SACCfg) -> SACLearner:
    return SACLearner(env, cfg, 3, 1024, None, "cpu", 1)


def one_step(
    env: PointEnv, near: float = -1.0, terminated: bool = False, obs: Tensor | None = None
) -> dict[str, Any]:
    """Return a step of all simulations with a given reward before weighting."""
    n = env.num_envs
    return {
        "observation": torch.zeros(n, D) if obs is None else obs,
        "action": torch.zeros(n, A),
        "next": {
            "observation": torch.zeros(n, D),
            "terminated": torch.full((n, 1), terminated),
            "truncated": torch.zeros(n, 1, dtype=torch.bool),
            "raw_terms": {"near": torch.full((n,), near)},
        },
    }


def constant(learner: SACLearner, critics: list[float], targets: list[float]) -> None:
    """Let each critic and each target critic return a constant."""
    state = copy.deepcopy(learner.state_dict())
    for prefix, values in (("qvalue", critics), ("target_qvalue", targets)):
        last = f"{prefix}_network_params.module.net.6"
        state["loss"][f"{last}.weight"].zero_()
        state["loss"][f"{last}.bias"] = torch.tensor(values)[:, None]
    learner.load_state_dict(state)


@pytest.mark.parametrize(
    ("terminated", "target"),
    [
        (True, 0.1 * -3.0),
        # The lower of the two target critics counts; the temperature is negligible.
        (False, 0.1 * -3.0 + 0.5 * 4.0),
    ],
)
def test_the_critics_target(terminated: bool, target: float) -> None:
    env = PointEnv()
    cfg = replace(TOY_SAC, gamma=0.5, reward_scale=0.1, warmup_steps=1, temperature_init=1e-9)
    learner = build(env, cfg)
    learner.after_step(one_step(env, near=-3.0, terminated=terminated))
    constant(learner, critics=[1.0, 2.0], targets=[5.0, 4.0])
    learner.during_step()
    logged = learner.learn(None)  # it does not use the rollout
    assert logged["loss_critic"] == pytest.approx((1 - target) ** 2 + (2 - target) ** 2, rel=1e-5)


def test_target_critics_move_by_the_target_rate() -> None:
    env = PointEnv()
    learner = build(env, replace(TOY_SAC, target_rate=0.25, warmup_steps=1))
    learner.after_step(one_step(env))
    before = flat_params(learner, "target_qvalue")
    learner.during_step()
    expected = 0.75 * before + 0.25 * flat_params(learner, "qvalue")
    torch.testing.assert_close(flat_params(learner, "target_qvalue"), expected)
    assert not torch.equal(before, expected)


def flat_params(learner: SACLearner, prefix: str) -> Tensor:
    loss = learner.state_dict()["loss"]
    return torch.cat([v.flatten() for k, v in loss.items() if k.startswith(f"{prefix}_network")])


def test_a_changed_weight_applies_to_past_frames_too() -> None:
    env = PointEnv()
    learner = build(env, replace(TOY_SAC, reward_scale=0.5))
    for near in (-1.0, -2.0, -3.0):
        learner.after_step(one_step(env, near))
    state = learner.state_dict()
    first = learner._batch()["next", "reward"]
    env.set_weights({"near": 4.0})
    learner.load_state_dict(state)  # the same rows
    second = learner._batch()["next", "reward"]
    assert set(first.flatten().tolist()) == {-0.5, -1.0, -1.5}
    assert torch.equal(second, 4 * first)


def test_observations_are_standardised_as_for_the_policy() -> None:
    env = PointEnv()
    learner = build(env, TOY_SAC)
    obs = torch.arange(8.0)[:, None].expand(8, D).contiguous()
    learner.after_step(one_step(env, obs=obs))
    # 0 to 7: mean 3.5, variance (64 - 1) / 12 = 5.25.
    batch = learner._batch()
    expected = (torch.arange(8.0) - 3.5) / math.sqrt(5.25)
    got = batch["observation"][:, 0]
    assert ((got[:, None] - expected).abs().min(1).values < 1e-5).all()
    torch.testing.assert_close(batch["next", "observation"], torch.full((M, D), float(expected[0])))


def test_columns_have_room_for_all_terms() -> None:
    env = PointEnv()
    env.weights = {"near": 1.0, "far": 2.0, "there": 0.0}
    shapes = {name: column.shape for name, column in columns(env).items()}
    assert shapes == {
        "observation": (D,),
        "action": (A,),
        "terms": (3,),
        "discount": (),
        "terminated": (),
        "next_observation": (D,),
    }


def test_a_loss_that_is_not_finite_is_named_and_changes_nothing() -> None:
    env = PointEnv()
    learner = build(env, replace(TOY_SAC, warmup_steps=1))
    learner.after_step(one_step(env))
    before = learner.state_dict()
    env.set_weights({"near": math.inf})
    with pytest.raises(
        RunError, match=r"^the loss of the critics is (inf|nan); .*is good"
    ) as raised:
        learner.during_step()
    assert "\n" not in str(raised.value)
    after = learner.state_dict()
    for part in ("model", "loss", "optimizers"):
        assert flat(after[part]) == flat(before[part])


def test_truncated_steps_are_not_learned_from() -> None:
    env = PointEnv()
    learner = build(env, SHORT)
    step = one_step(env)
    step["next"]["truncated"][2] = True
    learner.after_step(step)
    assert len(learner._replay) == env.num_envs - 1


def test_observations_after_a_termination_are_not_used() -> None:
    env = PointEnv()
    learner = build(env, replace(SHORT, warmup_steps=1))
    step = one_step(env)
    step["next"]["terminated"][:] = True
    step["next"]["observation"][:] = math.nan
    learner.after_step(step)
    learner.during_step()  # raises if it is used


def test_a_weight_that_is_not_finite_is_an_error_before_anything_is_saved() -> None:
    env = PointEnv()
    trainer = Trainer(env, trainer_cfg(SHORT))
    rollout = trainer._collector.rollout()
    with torch.no_grad():
        next(trainer._learner.model.parameters()).fill_(math.nan)
    with pytest.raises(RunError, match=r"a weight is not finite .*the last checkpoint is good"):
        trainer._learner.learn(rollout)


# The loss.


def networks(critics: int = 2) -> tuple[SquashedPolicy, list[ActionValue]]:
    weights = torch_stream(0, "weights")
    policy = SquashedPolicy(SquashedCfg("squashed", D, A, [16, 8], -1.0, 10.0), weights)
    return policy, [ActionValue(D, A, [16, 8], weights) for _ in range(critics)]


def sac_loss(
    policy: SquashedPolicy, critics: list[ActionValue], temperature: float = 0.3
) -> SoftActorCriticLoss:
    loss = SoftActorCriticLoss(
        policy,
        critics,
        gamma=0.9,
        temperature=temperature,
        target_entropy=-2.0,
        generator=torch_stream(0, "policy"),
    )
    SoftUpdate(loss, tau=0.01)  # it warns if nothing updates its targets
    return loss


def batch_of(size: int) -> TensorDict:
    stream = torch_stream(1, "batch")
    ended = torch.rand(size, 1, generator=stream) < 0.3
    after = {
        "observation": torch.randn(size, D, generator=stream),
        "reward": torch.randn(size, 1, generator=stream),
        "terminated": ended,
        "done": ended,
    }
    whole = {
        "observation": torch.randn(size, D, generator=stream),
        "action": torch.rand(size, A, generator=stream) * 2 - 1,
        "next": TensorDict(after, batch_size=[size]),
    }
    return TensorDict(whole, batch_size=[size])


def still(policy: SquashedPolicy, mean: float, log_std: float) -> None:
    """Let the policy return a constant mean and deviation, before the squashing."""
    last = policy.net[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias[:A] = mean
        last.bias[A:] = log_std


def answer(critic: ActionValue, value: float) -> None:
    last = critic.net[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(value)


@pytest.mark.parametrize(
    ("ended", "discount"), [(False, None), (False, 0.25), (True, None), (True, 0.25)]
)
def test_a_hand_worked_transition(ended: bool, discount: float | None) -> None:
    policy, critics = networks()
    still(policy, mean=0.5, log_std=-1.0)
    answer(critics[0], 2.0)
    answer(critics[1], 3.0)
    loss = sac_loss(policy, critics, temperature=0.3)
    batch = batch_of(1)
    batch["next", "reward"] = torch.tensor([[0.7]])
    batch["next", "terminated"] = batch["next", "done"] = torch.tensor([[ended]])
    if discount is not None:  # as from the environment's soft end
        batch["next", "discount"] = torch.tensor([[discount]])

    # The next action to be drawn is tanh(0.5 + z / e), of density
    # N(z) * e / (1 - tanh^2) in each of its entries.
    noise = torch.randn(1, A, generator=torch_stream(0, "policy")).double()
    action = torch.tanh(0.5 + math.exp(-1) * noise)
    each = -(noise**2) / 2 - math.log(2 * math.pi) / 2 + 1 - torch.log(1 - action**2)
    log_prob = float(each.sum())
    gamma = 0.9 if discount is None else 0.9 * discount
    target = 0.7 if ended else 0.7 + gamma * (2.0 - 0.3 * log_prob)
    got = float(loss.critic_loss(batch).detach())
    assert got == pytest.approx((2 - target) ** 2 + (3 - target) ** 2, rel=1e-4)

    loss = sac_loss(policy, critics, temperature=0.3)  # restarts its stream
    got_policy, got_temperature, entropy = loss.policy_and_temperature_loss(batch)
    assert float(entropy) == pytest.approx(-log_prob, rel=1e-4)
    assert float(got_policy.detach()) == pytest.approx(0.3 * log_prob - 2.0, rel=1e-4)
    # The temperature falls while the entropy is above -2. TorchRL's loss is linear in its log.
    [slope] = torch.autograd.grad(got_temperature, [loss.log_alpha])
    assert float(slope) == pytest.approx(-log_prob + 2.0, rel=1e-4)


def test_the_target_entropy_falls_with_the_frames_seen() -> None:
    # From -1 to -3 nat an entry over 80 frames, 8 a step: after 2 steps -1.4, after 12 -3.
    cfg = replace(SHORT, warmup_steps=1, target_entropy=-1.0, target_entropy_end=-3.0)
    env = PointEnv()
    learner = build(env, replace(cfg, target_entropy_frames=80))
    for steps, expected in ((2, -1.4), (10, -3.0)):
        for _ in range(steps):
            learner.after_step(one_step(env))
        learner.during_step()
        assert float(learner._loss.target_entropy) == pytest.approx(expected * env.action_dim)


@pytest.mark.parametrize(("has", "wanted"), [("avx2", False), ("amx_bf16", True), ("bf16", True)])
def test_bfloat16_only_where_the_processor_has_it(
    monkeypatch: pytest.MonkeyPatch, has: str, wanted: bool
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {has: True})
    single, either = (trained(replace(SHORT, bfloat16=b), frames=192)[1] for b in (False, True))
    assert (single != either) == wanted


def test_values_are_not_rounded_by_bfloat16() -> None:
    # bfloat16 values near 12 are 0.06 apart: only a handful would be distinct.
    critic = networks()[1][0]
    with torch.no_grad():
        critic.net[-1].bias.fill_(12.0)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            values = critic(torch.randn(256, D), torch.rand(256, A))
    assert values.dtype == torch.float32
    assert len(values.unique()) > 200


def test_equals_torchrls_own_loss() -> None:
    policy, critics = networks()
    ours = sac_loss(policy, critics)
    theirs = SACLoss(
        ours.actor_network,
        [
            TensorDictModule(critic, ["observation", "action"], ["state_action_value"])
            for critic in networks()[1]
        ],
        loss_function="l2",
        alpha_init=0.3,
        target_entropy=-2.0,
    )
    theirs.make_value_estimator(gamma=0.9)
    SoftUpdate(theirs, tau=0.01)
    theirs.load_state_dict(ours.state_dict())
    batch = batch_of(M)
    before = torch.get_rng_state()

    def like_ours(compute: Callable[[], Any]) -> Any:
        torch.set_rng_state(ours._generator.get_state())
        try:
            return compute()
        finally:
            torch.set_rng_state(before)

    close = {"rtol": 1e-4, "atol": 1e-6}
    expected, _ = like_ours(lambda: theirs.qvalue_v2_loss(batch))
    got = ours.critic_loss(batch)
    torch.testing.assert_close(got, expected, **close)
    torch.testing.assert_close(
        gradients(got, ours.qvalue_network_params),
        gradients(expected, theirs.qvalue_network_params),
        **close,
    )
    expected, about = like_ours(lambda: theirs.actor_loss(batch))
    got, temperature, entropy = ours.policy_and_temperature_loss(batch)
    torch.testing.assert_close(got, expected, **close)
    torch.testing.assert_close(
        gradients(got, ours.actor_network_params),
        gradients(expected, theirs.actor_network_params),
        **close,
    )
    torch.testing.assert_close(entropy, -about["log_prob"].mean(), **close)
    torch.testing.assert_close(temperature, theirs.alpha_loss(about["log_prob"]).mean(), **close)
    assert torch.equal(torch.get_rng_state(), before)


def gradients(loss: Tensor, params: Any) -> list[Tensor]:
    return list(torch.autograd.grad(loss, list(params.parameters()), retain_graph=True))


def test_the_lowest_of_any_number_of_critics_counts() -> None:
    for values in ([1.0], [3.0, 1.0, 2.0]):
        policy, critics = networks(len(values))
        for critic, value in zip(critics, values, strict=True):
            answer(critic, value)
        loss, _, _ = sac_loss(policy, critics, temperature=1e-9).policy_and_temperature_loss(
            batch_of(4)
        )
        assert float(loss.detach()) == pytest.approx(-1.0)


# The policy.


def squashed(bias: Tensor | None = None, log_std: float = -1.0) -> SquashedPolicy:
    cfg = SquashedCfg("squashed", D, A, [16, 8], log_std, 10.0)
    return SquashedPolicy(cfg, torch_stream(0, "weights"), bias)


def test_a_mean_beyond_the_limit_is_scaled_down_and_no_other() -> None:
    policy = squashed()  # A = 2
    limited = SquashedPolicy(replace(policy.cfg, pre_tanh_limit=1.0), torch_stream(0, "weights"))
    obs = torch.zeros(1, D)
    # Average magnitude 2.5: divided by 2.5. Average magnitude 0.5: as it is.
    for raw, expected in (([4.0, -1.0], [1.6, -0.4]), ([0.75, -0.25], [0.75, -0.25])):
        for network, wanted in ((policy, raw), (limited, expected)):
            with torch.no_grad():
                network.net[-1].weight.zero_()
                network.net[-1].bias[:2] = torch.tensor(raw)
            mean, std = network(obs)
            torch.testing.assert_close(mean.detach(), torch.tensor([wanted]))
            torch.testing.assert_close(std.detach(), torch.full((1, 2), math.exp(-1.0)))
            torch.testing.assert_close(network.mean(obs), mean.tanh())


def test_the_limit_is_kept_in_checkpoints_and_older_ones_have_none() -> None:
    learner = build(PointEnv(), replace(SHORT, pre_tanh_limit=0.5))
    settings = asdict(learner.model.cfg)
    again = network_of(settings, learner.model.state_dict())
    assert again.cfg.pre_tanh_limit == 0.5
    del settings["pre_tanh_limit"]
    assert network_of(settings, learner.model.state_dict()).cfg.pre_tanh_limit is None


def test_actions_are_squashed() -> None:
    policy = squashed(torch.tensor([0.9, -0.9]), log_std=0.5)
    obs = torch.randn(1000, D, generator=torch_stream(0, "obs"))
    action, mean = policy.sample(obs, torch_stream(0, "actions"))
    assert float(action.abs().max()) <= 1
    assert float(action[:, 0].min()) < -0.5  # with noise
    assert float(mean.abs().max()) < 1


def test_a_sample_is_the_squashed_mean_and_noise() -> None:
    policy = squashed()
    obs = torch.randn(3, D, generator=torch_stream(0, "obs"))
    loc, scale = policy(obs)
    noise = torch.randn(3, A, generator=torch_stream(0, "actions"))
    action, mean = policy.sample(obs, torch_stream(0, "actions"))
    torch.testing.assert_close(mean, torch.tanh(loc.detach()))
    torch.testing.assert_close(action, torch.tanh(loc + scale * noise).detach())
    # The initial deviation is exp(-1).
    torch.testing.assert_close(scale, torch.full((3, A), math.exp(-1)), rtol=0.05, atol=0)


def test_it_starts_at_the_warm_start() -> None:
    obs = torch.randn(16, D, generator=torch_stream(0, "obs"))
    mean = squashed(torch.tensor([0.25, -0.5])).act(obs, deterministic=True)
    torch.testing.assert_close(mean, torch.tensor([0.25, -0.5]).expand(16, 2), rtol=0, atol=0.02)
    # Clipped, as it could not learn where tanh is flat.
    mean = squashed(torch.tensor([1.0, -3.0])).act(obs, deterministic=True)
    torch.testing.assert_close(mean, torch.tensor([0.95, -0.95]).expand(16, 2), rtol=0, atol=0.02)


@pytest.mark.parametrize(("warm", "start"), [(True, [0.25, -0.5]), (False, [0.0, 0.0])])
def test_the_warm_start_can_be_left_out(warm: bool, start: list[float]) -> None:
    trainer = Trainer(PointEnv(), trainer_cfg(replace(TOY_SAC, warm_start=warm)))
    mean = trainer.model.act(torch.zeros(1, D), deterministic=True)
    torch.testing.assert_close(mean, torch.tensor([start]), rtol=0, atol=0.02)


def test_sampled_and_deterministic_actions() -> None:
    policy = squashed()
    obs = torch.randn(4, D, generator=torch_stream(0, "obs"))
    assert torch.equal(policy.act(obs, deterministic=True), policy.act(obs, deterministic=True))
    first = policy.act(obs, torch_stream(0, "a"))
    assert torch.equal(policy.act(obs, torch_stream(0, "a")), first)
    assert not torch.equal(policy.act(obs, torch_stream(1, "a")), first)
    assert not torch.equal(policy.act(obs, deterministic=True), first)
    with pytest.raises(RunError, match="needs a generator"):
        policy.act(obs)
