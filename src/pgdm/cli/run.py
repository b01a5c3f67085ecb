"""``pgdm-run``: from a command line to finished runs."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.cli.errors import EXPECTED, check_environment, guarded, report
from pgdm.cli.flags import Flags, read_flags
from pgdm.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from pgdm.config.schema import ExperimentCfg


@dataclass(frozen=True)
class _Job:
    """One run of a command line."""

    name: str
    """What tells it from the others, such as ``seed=1``."""
    composed: DictConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pgdm-run`` and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    return guarded(lambda: _main(read_flags(arguments), debug), debug)


def _main(flags: Flags, debug: bool) -> int:
    if "--help" in flags.ours:
        from pgdm.cli.help import help_text

        print(help_text(flags.config_dir))
        return 0
    if "--version" in flags.ours:
        from importlib.metadata import version

        print(f"pgdm {version('pgdm')}")
        return 0
    check_environment()
    jobs = _compose(flags)
    set_up_logging(debug)
    return _run_all(_checked(jobs), debug)


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


def _compose(flags: Flags) -> list[_Job]:
    """Let Hydra make the settings of each run; an empty list if it only printed something."""
    import hydra
    from hydra.core.hydra_config import HydraConfig

    from pgdm.config.store import COMPOSITION_ERRORS, check_overrides, conf_dir, explain

    if flags.config_dir is not None and not Path(flags.config_dir).is_dir():
        raise ConfigError(f"--config-dir '{flags.config_dir}' is not a folder")
    check_overrides(flags.overrides)
    jobs: list[_Job] = []

    def collect(composed: DictConfig) -> None:
        # Runs start only after Hydra is done: all settings are then known to be right, and its
        # handling of errors and signals is out of the way.
        jobs.append(_Job(" ".join(HydraConfig.get().overrides.task), composed))

    app = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(collect)
    with _hydra_command_line(flags):
        try:
            app()
        except COMPOSITION_ERRORS as error:
            raise explain(error, flags.overrides) from error
    return jobs


@contextmanager
def _hydra_command_line(flags: Flags) -> Iterator[None]:
    """Show Hydra a command line of its own, and have it raise errors instead of printing them."""
    arguments = [*flags.hydras, *flags.overrides]
    argv, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    with ExitStack() as stack:
        if flags.multirun:
            # Hydra writes multirun.yaml for its own use.
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="pgdm-run-"))
            arguments.append(f"hydra.sweep.dir={folder}")
        sys.argv = ["pgdm-run", *arguments]
        os.environ["HYDRA_FULL_ERROR"] = "1"
        try:
            yield
        finally:
            sys.argv = argv
            if full_error is None:
                del os.environ["HYDRA_FULL_ERROR"]
            else:
                os.environ["HYDRA_FULL_ERROR"] = full_error


def _checked(jobs: list[_Job]) -> list[ExperimentCfg]:
    """Turn all settings into experiments before the first one starts."""
    from pgdm.config.store import from_dict_config

    configs = []
    for job in jobs:
        try:
            configs.append(from_dict_config(job.composed))
        except ConfigError as error:
            if len(jobs) == 1:
                raise
            raise ConfigError(f"{error} (in the run {job.name}; none was started)") from error
    shared = [name for name, times in Counter(cfg.run_dir for cfg in configs).items() if times > 1]
    if shared:
        raise ConfigError(
            f"several of the runs would share run_dir '{shared[0]}' (none was started); leave "
            "run_dir out, or make it differ: run_dir=out/${seed}"
        )
    return configs


def _run_all(configs: list[ExperimentCfg], debug: bool) -> int:
    """Run one after the other; a failed one does not stop the others, an interrupted one does."""
    from pgdm.cli.train import train

    codes = []
    for number, cfg in enumerate(configs, 1):
        if len(configs) > 1:
            print(f"run {number} of {len(configs)}: {cfg.run_dir}", file=sys.stderr)
        try:
            codes.append(train(cfg))
        except EXPECTED as error:
            codes.append(report(error, debug))
        if codes[-1] >= 128:
            return codes[-1]
    failed = sum(code != 0 for code in codes)
    if failed and len(configs) > 1:
        print(f"{failed} of {len(configs)} runs failed", file=sys.stderr)
    return max(codes, default=0)
