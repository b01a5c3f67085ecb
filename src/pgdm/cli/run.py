"""``pgdm-run``: from a command line to finished runs."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence

from pgdm.cli.console.errors import USAGE, guarded
from pgdm.cli.flags import Flags, read_flags
from pgdm.cli.jobs import read_jobs


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pgdm-run`` and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    command = shlex.join(["pgdm-run", *arguments])
    return guarded(lambda: _main(read_flags(arguments), command, debug), debug)


def _main(flags: Flags, command: str, debug: bool) -> int:
    asks_nothing = not flags.overrides and not flags.hydras and not flags.ours - {"--debug"}
    if "--help" in flags.ours or asks_nothing:
        from pgdm.cli.help import help_text

        print(help_text(flags.config_dir))
        return USAGE if asks_nothing else 0
    if "--version" in flags.ours:
        from importlib.metadata import version

        print(f"pgdm {version('pgdm')}")
        return 0
    from pgdm.config.foreign import check_method, named_methods, trust_method
    from pgdm.config.groups import own_folders
    from pgdm.sweep.studies import default_name, open_study

    study, typed, written = open_study(flags.overrides, flags.config_dir)
    flags.overrides, flags.typed = [*written, *typed], typed
    if study is not None and not flags.multirun:
        flags.hydras.append("--multirun")
    from pgdm.cli.console.logging_setup import set_up_logging
    from pgdm.cli.console.screen import bars, loading

    with bars(patience_s=2.0) as progress:
        asked = read_jobs(flags, progress)
    if not asked.jobs:
        return 0
    set_up_logging(debug)
    named = named_methods(typed, own_folders(flags.config_dir))
    for _, settings in asked.jobs:
        if (settings.get("method") or {}).get("name") in named:
            trust_method(settings)
        check_method(settings, "a settings file")
    # Imported this late because they load MuJoCo and torch; wrong names are reported before that.
    if asked.is_sweep:
        with loading():
            from pgdm.cli.plan import run_planned

        return run_planned(asked, default_name(typed, study), command)
    with loading():
        from pgdm.cli.train import show, train
        from pgdm.config.compose import checked
        from pgdm.experiment import foreseen
        from pgdm.library import open_library
        from pgdm.tracking import located

    cfg = checked(asked.jobs[0][1])
    if "--dry-run" in flags.ours:
        notes: list[str] = []
        located(cfg.tracking, notes.append)
        with bars(patience_s=2.0) as progress:
            progress("compiling the scene", 0, 1)
            notes += foreseen(cfg, open_library())
        show(cfg, notes)
        return 0
    return train(cfg)
