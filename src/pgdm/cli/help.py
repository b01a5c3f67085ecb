"""The text of ``pgdm-run --help``, generated from ``conf/``."""

from __future__ import annotations

import shutil
import textwrap
from pathlib import Path

from pgdm.config.describe import Description, describe
from pgdm.config.groups import available, conf_dir, groups
from pgdm.config.suites import suite, suites
from pgdm.errors import ConfigError, amount
from pgdm.files import reason
from pgdm.sweep.studies import studies

_HEAD = """\
pgdm-run: train a policy on one task or many, or resume runs that were stopped.

usage: pgdm-run [KEY=VALUE | GROUP=OPTION | +experiment=NAME | +sweep=NAME]...
                [FLAG]...

Examples
  pgdm-run +experiment=quickstart              a first run: at most ten minutes
  pgdm-run task=cup-pour1                      another task for 50M frames
  pgdm-run +experiment=fast task=cup-pour1     the same task in 300,000 frames
  pgdm-run task=hammer-use1 total_frames=200_000 run_dir=out/a seed=3
  pgdm-run -m task=duck-lift,cup-pour1 seed=0,1,2     a sweep of six runs
  pgdm-run -m 'task=tcdm30,dhand-*' --dry-run  show a sweep's plan
  pgdm-run +sweep=validate_tcdm50 budget=smoke a short version of a study
  pgdm-run task=cup-pour1 --cfg job            print all settings, start nothing
  the same command again, or pgdm resume RUN   resumes a stopped run
"""

_FLAGS = """\
Flags
  -m, --multirun     a sweep: one run for each combination of values a,b,c
  --dry-run          show a sweep's plan, or the terms of one run; start nothing
  --offline          never download assets; use earlier downloads
  --config-dir DIR   add your own settings: DIR/task/mine.yaml is task=mine
  --cfg job          print all settings (--resolve: with references resolved)
  --info [WHAT]      where settings come from: config, defaults, searchpath, ...
  --debug            show the traceback of an error, and log more
  -h, --help         this text          --hydra-help   flags of Hydra
  --version          the version of pgdm

Exit codes: 0 done, 1 failed, 2 wrong settings, 130 or 143 stopped by a signal
(and saved).
"""


def help_text(config_dir: str | None = None) -> str:
    """Return the help, including options from the user's settings folder ``config_dir``."""
    width = min(shutil.get_terminal_size().columns, 100)
    config = describe(conf_dir() / "config.yaml")
    lines = [_HEAD, "Groups (GROUP=OPTION; * is the default)"]
    for group in groups(config_dir):
        default = config.defaults.get(group)
        names = [f"{n}*" if n == default else n for n in available(group, config_dir)]
        lines.append(_entry("+experiment" if group == "experiment" else group, names, width))
    lines += ["  (the default hand is the task's)", "", "Keys (KEY=VALUE)"]
    lines += _keys(config, "", width)
    lines += [
        "  Groups have keys too, such as algo.learning_rate: --cfg job prints them all,",
        "  docs/configuration.md explains each.",
        "",
        "Suites (-m task=SUITE, or combined: -m 'task=tcdm30,dhand-*,-dhand-cup')",
        *(_suite(name, file, config_dir, width) for name, file in suites(config_dir).items()),
        "",
        "Sweep files (+sweep=NAME, or your own file: +sweep=PATH.yaml)",
        *(_entry(n, _title(file).split(), width, 18) for n, file in studies(config_dir).items()),
        "",
        "Keys of a sweep",
        *_keys(describe(conf_dir() / "sweep" / "default.yaml"), "sweep.", width),
        "",
    ]
    for file in sorted((conf_dir() / "hydra" / "launcher").glob("*.yaml")):
        found = describe(file)
        title = f"Launcher (hydra/launcher={file.stem}): {found.title}"
        lines.append(textwrap.fill(title, width, subsequent_indent="  "))
        lines += [*_keys(found, "hydra.launcher.", width), ""]
    return "\n".join([*lines, _FLAGS])


def _keys(found: Description, prefix: str, width: int) -> list[str]:
    left = [f"{prefix}{key.name}={key.value}" for key in found.keys]
    most = min(max(map(len, left)), width // 2)
    comments = [key.comment.rstrip(".").split() for key in found.keys]
    return [_entry(key, words, width, most + 2) for key, words in zip(left, comments, strict=True)]


def _title(file: Path) -> str:
    try:
        return describe(file).title
    except (OSError, ValueError) as error:
        return f"cannot be read: {reason(error)}"


def _suite(name: str, file: Path, config_dir: str | None, width: int) -> str:
    try:
        text = f"{amount(len(suite(name, config_dir)), 'task')}: {_title(file)}"
    except ConfigError as error:
        text = f"cannot be read: {error} ({file})"
    return _entry(name, text.split(), width, 17)


def _entry(name: str, words: list[str], width: int, indent: int = 14) -> str:
    """Return a name with words next to it, or below it if the name is long."""
    return textwrap.fill(
        " ".join(words) or "-",
        width,
        initial_indent=f"  {name:<{indent}}",
        subsequent_indent=" " * (indent + 2),
        break_on_hyphens=False,
        break_long_words=False,
    )
