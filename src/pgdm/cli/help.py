"""The text of ``pgdm-run --help``, made from what is in ``conf/``."""

from __future__ import annotations

import shutil
import textwrap

from pgdm.config.describe import Description, describe
from pgdm.config.groups import available, conf_dir, groups
from pgdm.config.suites import suite, suites
from pgdm.sweep.studies import studies

_HEAD = """\
pgdm-run: train a policy on one task or many, or go on with runs that were stopped.

usage: pgdm-run [KEY=VALUE | GROUP=OPTION | +experiment=NAME | +sweep=NAME]... [FLAG]...

Examples
  pgdm-run +experiment=quickstart              the first thing to try: about four minutes
  pgdm-run task=cup-pour1                      another task, the paper's PPO for 50M steps
  pgdm-run task=cup-pour1 algo=ppo_fast action=residual total_frames=1_000_000 budget=reduced
  pgdm-run task=hammer-use1 total_frames=200_000 run_dir=out/a seed=3
  pgdm-run -m task=duck-lift,cup-pour1 seed=0,1,2        a sweep of six runs
  pgdm-run -m task=tcdm30,dhand-* seed=0,1,2 --dry-run   what a sweep over suites would do
  pgdm-run +sweep=validate_tcdm50 budget=smoke           a study of the paper, at a small budget
  pgdm-run task=cup-pour1 --cfg job            print all settings, and do nothing
  the same command again                       goes on where a stopped run was saved
"""

_FLAGS = """\
Flags
  -m, --multirun     a sweep: one run for each combination of the values given as a,b,c
  --dry-run          show the plan of a sweep, or the terms of a single run, and start nothing
  --offline          never use the network; missing assets are an error
  --config-dir DIR   your own settings beside pgdm's: DIR/task/mine.yaml is task=mine
  --cfg job          print all settings (--resolve: with references filled in), and do nothing
  --info [WHAT]      where the settings come from: all, config, defaults, defaults-tree, searchpath
  --debug            show the traceback of an error, and log more
  -h, --help         this text          --hydra-help   flags of Hydra
  --version          the version of pgdm

Exit codes: 0 done, 1 failed, 2 wrong settings, 130 or 143 stopped from outside (and saved).
"""


def help_text(config_dir: str | None = None) -> str:
    """Return the help, with the options of the user's own settings folder too."""
    width = min(shutil.get_terminal_size().columns, 100)
    config = describe(conf_dir() / "config.yaml")
    lines = [_HEAD, "Groups (GROUP=OPTION; * is the default)"]
    for group in groups(config_dir):
        default = config.defaults.get(group)
        names = [f"{n}*" if n == default else n for n in available(group, config_dir)]
        lines.append(_entry("+experiment" if group == "experiment" else group, names, width))
    lines += ["  (the default hand is the task's)", "", "Keys (KEY=VALUE)", *_keys(config, "")]
    lines += [
        "  Groups have keys too, such as algo.learning_rate: --cfg job prints them all,",
        "  docs/configuration.md explains each.",
        "",
        "Suites (-m task=SUITE; or more, or less: -m task=tcdm30,dhand-*,-dhand-cup)",
        *(
            f"  {name:<16} {len(suite(name, config_dir)):>2} tasks: {describe(file).title}"
            for name, file in suites(config_dir).items()
        ),
        "",
        "Sweep files (+sweep=NAME, or a file of yours: +sweep=PATH.yaml)",
        *(f"  {n:<18} {describe(file).title}" for n, file in studies(config_dir).items()),
        "",
        "Keys of a sweep",
        *_keys(describe(conf_dir() / "sweep" / "default.yaml"), "sweep."),
        "",
    ]
    for file in sorted((conf_dir() / "hydra" / "launcher").glob("*.yaml")):
        found = describe(file)
        lines.append(f"Launcher (hydra/launcher={file.stem}): {found.title}")
        lines += [*_keys(found, "hydra.launcher."), ""]
    return "\n".join([*lines, _FLAGS])


def _keys(found: Description, prefix: str) -> list[str]:
    left = [f"  {prefix}{key.name}={key.value}" for key in found.keys]
    width = max(map(len, left))
    said = [key.comment.partition(" [")[0].rstrip(".") for key in found.keys]
    return [f"{key:<{width}}  {comment}" for key, comment in zip(left, said, strict=True)]


def _entry(name: str, options: list[str], width: int) -> str:
    return textwrap.fill(
        " ".join(options),
        width,
        initial_indent=f"  {name:<14}",
        subsequent_indent=" " * 16,
        break_on_hyphens=False,
        break_long_words=False,
    )
