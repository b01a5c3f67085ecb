"""The text of ``pgdm-run --help``, made from what is in ``conf/``."""

from __future__ import annotations

import shutil
import textwrap

from pgdm.config.describe import describe
from pgdm.config.groups import available, conf_dir, groups

_HEAD = """\
pgdm-run: train a policy on one task, or go on with a run that was stopped.

usage: pgdm-run [KEY=VALUE | GROUP=OPTION | +experiment=NAME]... [FLAG]...

Examples
  pgdm-run +experiment=quickstart              the first thing to try: about four minutes
  pgdm-run task=cup-pour1                      another task, the paper's PPO for 50M steps
  pgdm-run task=cup-pour1 algo=ppo_fast action=residual total_frames=1_000_000 budget=reduced
  pgdm-run task=hammer-use1 total_frames=200_000 run_dir=out/a seed=3
  pgdm-run -m task=duck-lift,cup-pour1 seed=0,1,2        six runs, one after the other
  pgdm-run task=cup-pour1 --cfg job            print all settings, and do nothing
  the same command again                       goes on where a stopped run was saved
"""

_FLAGS = """\
Flags
  -m, --multirun     one run for each combination of the values given as a,b,c
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
    lines += ["  (the default hand is the task's)", "", "Keys (KEY=VALUE)"]
    for key in config.keys:
        left = f"  {key.name}={key.value}"
        lines.append(f"{left:<28} {key.comment.partition(' [')[0].rstrip('.')}")
    lines += [
        "  Groups have keys too, such as algo.learning_rate: --cfg job prints them all,",
        "  docs/configuration.md explains each.",
        "",
        _FLAGS,
    ]
    return "\n".join(lines)


def _entry(name: str, options: list[str], width: int) -> str:
    return textwrap.fill(
        " ".join(options),
        width,
        initial_indent=f"  {name:<14}",
        subsequent_indent=" " * 16,
        break_on_hyphens=False,
        break_long_words=False,
    )
