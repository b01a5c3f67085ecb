"""``pgdm-run``: from a command line to finished runs."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Sequence

from pgdm.cli.compose import compose_all
from pgdm.cli.errors import check_environment, guarded
from pgdm.cli.flags import Flags, read_flags


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pgdm-run`` and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    command = shlex.join(["pgdm-run", *arguments])
    return guarded(lambda: _main(read_flags(arguments), command, debug), debug)


def _main(flags: Flags, command: str, debug: bool) -> int:
    if "--help" in flags.ours:
        from pgdm.cli.help import help_text

        print(help_text(flags.config_dir))
        return 0
    if "--version" in flags.ours:
        from importlib.metadata import version

        print(f"pgdm {version('pgdm')}")
        return 0
    check_environment()
    from pgdm.sweep.studies import default_name, open_study

    study, typed, written = open_study(flags.overrides, flags.config_dir)
    flags.overrides = [*written, *typed]
    if study is not None and not flags.multirun:
        flags.hydras.append("--multirun")
    composed = compose_all(flags)
    if not composed.jobs:
        return 0
    # Here: they load the simulator and torch, and a wrong name should be answered before that.
    from pgdm.cli.plan import run_planned
    from pgdm.cli.train import show, train
    from pgdm.config.store import from_dict_config
    from pgdm.experiment import foreseen
    from pgdm.library import open_library

    set_up_logging(debug)
    if composed.is_sweep:
        return run_planned(composed, default_name(typed, study), command)
    cfg = from_dict_config(composed.jobs[0][1])
    if "--dry-run" in flags.ours:
        show(cfg, foreseen(cfg, open_library()))
        return 0
    return train(cfg)


class _NoticeHandler(logging.Handler):
    """Prints as ``notify`` does, above the live line of progress and not into it."""

    def emit(self, record: logging.LogRecord) -> None:
        from pgdm.cli.train import notify

        notify(self.format(record))


def set_up_logging(debug: bool) -> None:
    """Send what modules log to stderr, each as one line."""
    handler = _NoticeHandler()
    logging.basicConfig(
        format="%(levelname)s: %(message)s", level=logging.WARNING, handlers=[handler]
    )
    logging.getLogger("pgdm").setLevel(logging.DEBUG if debug else logging.WARNING)
    # Warnings of libraries are for developers.
    logging.captureWarnings(True)
    logging.getLogger("py.warnings").setLevel(logging.WARNING if debug else logging.ERROR)
