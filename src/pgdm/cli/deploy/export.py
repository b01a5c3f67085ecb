"""``pgdm deploy export``: convert an episode of a trained policy into a playback."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pgdm.cli.console.screen import bars, console, notify
from pgdm.cli.deploy.check import describe
from pgdm.deploy.arm import ArmIk, Floats, Setup
from pgdm.deploy.convert import ConvertCfg, Converted, convert
from pgdm.deploy.limits import PAYLOAD_KG
from pgdm.deploy.playback import write
from pgdm.deploy.rollout import roll_out
from pgdm.export.trained import of_run
from pgdm.library.arms import ensure_panda
from pgdm.seeding import torch_stream
from pgdm.sim.scene import Scene


@dataclass(frozen=True)
class ExportRequest:
    """What to export, and where to."""

    run: Path
    out: Path
    episodes: int
    """Number of episodes to choose from, if actions are sampled or the task is randomised."""
    sampled: bool
    """Whether actions are sampled; otherwise they are the policy's mean."""
    best: bool
    """Whether to take the best checkpoint instead of the last."""
    force: bool
    """Whether to write the playback even if the arm cannot play it."""
    seed: int | None
    offline: bool


@dataclass(frozen=True)
class Place:
    """Where the arm stands and how the hand is mounted, see `Setup`."""

    arm_at: Floats | None = None
    """None: the default of the hand; likewise for ``mount``."""
    table_height_m: float = Setup.table_height_m
    mount: Floats | None = None


def run_export(request: ExportRequest, cfg: ConvertCfg, place: Place) -> int:
    """Write the playback and print how much of the arm's limits it uses; return the exit code.

    The code is 1 if the arm cannot play the playback, even if the file is written anyway.

    Raises:
        PgdmError: if a setting is wrong, the run is damaged, its policy loses the object in all
            episodes, or a file cannot be fetched or written.
    """
    begun = time.monotonic()
    done = converted(request, cfg, place)
    describe(request.out, done.playback, done.usage)
    miss, turn = done.path.position_error_m.max(), done.path.rotation_error_rad.max()
    say = partial(console().print, soft_wrap=True, markup=False, highlight=False)
    say(f"inverse kinematics: errors of at most {1e3 * miss:.3f} mm and {turn:.5f} rad")
    drawn = {key: round(value, 3) for key, value in done.playback.facts["variation"].items()}
    say(f"episode: {done.playback.facts['episodes']} {drawn or ''}")
    if done.unreached:
        say(f"violation: {done.unreached}")
    if not (done.possible or request.force):
        notify("the arm cannot play this: nothing was written; slow it down with --speed, move arm "
               "or hand with --arm or --mount, or write it anyway with --force")  # fmt: skip
        return 1
    write(request.out, done.playback)
    say(f"written: {request.out} ({time.monotonic() - begun:.1f} s)")
    return 0 if done.possible else 1


def converted(request: ExportRequest, cfg: ConvertCfg, place: Place) -> Converted:
    """Roll out the policy of a run, and convert its best episode.

    Raises:
        PgdmError: as for `run_export`.
    """
    cfg.check()
    trained = of_run(request.run, request.best)
    experiment = trained.cfg
    offline = request.offline or experiment.offline
    setup = Setup.of(experiment.hand.name, place.arm_at, place.table_height_m, place.mount)
    with bars() as progress:
        trained = replace(trained, cfg=replace(experiment, offline=offline))
        builder = trained.builder(notify, progress)
    _warn_of_payload(builder.scene)
    seed = experiment.seed if request.seed is None else request.seed
    # Without noise and without randomness in the task all episodes are the same.
    count = request.episodes if request.sampled or experiment.task.randomize else 1
    noise = torch_stream(seed, "deploy") if request.sampled else None
    with bars() as progress:
        arm = ArmIk(ensure_panda(offline, notify, progress=progress), setup)
        env = builder.make(count, min(count, 16), seed, "deploy", auto_reset=False)
        rollouts = roll_out(env, trained.network, noise, lambda n, of: progress("episodes", n, of))
        chosen = rollouts[0]
        facts = {
            "task": experiment.task.id,
            "hand": experiment.hand.name,
            "object_mass": experiment.sim.object_mass,
            "checkpoint": Path(trained.name).name,
            "frames": trained.frames,
            "asset_source": builder.scene.asset_source,
            "episodes": f"best of {len(rollouts)} that did not end early, of {count}",
            "metrics": {k: v for k, v in chosen.metrics.items() if "/" not in k and v == v},
            "variation": chosen.variation,
            "start_qpos": chosen.qpos[0].tolist(),
        }
        progress("inverse kinematics", 0, 1)
        return convert(chosen, builder.scene, arm, setup, cfg, facts)


def _warn_of_payload(scene: Scene) -> None:
    body = scene.model.body(f"{scene.hand.name}/{scene.hand.mount_body}").id
    mass = float(scene.model.body_subtreemass[body])
    if mass > PAYLOAD_KG:
        notify(
            f"the hand's model weighs {mass:.1f} kg, more than the arm's payload of {PAYLOAD_KG} kg"
        )
