"""Write docs/configuration.md from the files in conf/, which are the only place defaults live.

    python tools/configuration_page.py

tests/test_docs.py fails if the page is not what this would write.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import yaml

from pgdm.config.describe import Description, Key, describe
from pgdm.config.groups import groups
from pgdm.config.suites import suite, suites
from pgdm.sweep.studies import studies

REPOSITORY = Path(__file__).resolve().parents[1]
CONF = REPOSITORY / "conf"
PAGE = REPOSITORY / "docs" / "configuration.md"

_HEAD = """\
<!-- Made by tools/configuration_page.py from conf/: change the files there, then run it. -->
# Configuration

One run is described by the keys below. `pgdm-run KEY=VALUE` sets one, `pgdm-run GROUP=OPTION`
chooses a file of a group, `pgdm-run +experiment=NAME` applies a named set of choices, and
`pgdm-run --cfg job` prints everything that would be used, without running. A key that does not
exist, or a value of the wrong type, is an error before anything starts.

Settings of your own go into a folder with the same layout: with `--config-dir my`, the file
`my/experiment/ours.yaml` is `+experiment=ours`, and `my/task/mine.yaml` is `task=mine`.
A group and name that pgdm's own files have is an error.
"""


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def _table(keys: list[Key], prefix: str) -> list[str]:
    rows = ["| key | value | meaning |", "|---|---|---|"]
    for key in keys:
        name = f"{prefix}.{key.name}" if prefix else key.name
        value = key.value if len(key.value) <= 60 else f"{key.value[:57]}..."
        value = "null" if value == "" else value
        rows.append(f"| `{name}` | `{value}` | {_cell(key.comment)} |")
    return [*rows, ""]


def _options(group: str, found: dict[str, Description], default: str | None) -> list[str]:
    rows = ["| option | what it is |", "|---|---|"]
    for name, description in found.items():
        mark = " (default)" if name == default else ""
        option = f"+experiment={name}" if group == "experiment" else f"{group}={name}"
        rows.append(f"| `{option}`{mark} | {_cell(description.title)} |")
    return [*rows, ""]


def _suites() -> list[str]:
    rows = ["| suite | tasks | what it is |", "|---|--:|---|"]
    for name, file in suites().items():
        rows.append(f"| `-m task={name}` | {len(suite(name))} | {_cell(describe(file).title)} |")
    note = (
        "With `-m`, `task` takes suites, tasks and patterns, separated by commas; a minus takes "
        "tasks away: `-m task=tcdm30,dhand-*,-dhand-cup`. A suite of your own is "
        "`my/suite/NAME.yaml`, with the key `tasks`, a list of the same words."
    )
    members = [
        f"`{name}`: {', '.join(suite(name))}."
        for name in suites()
        if "tasks" in yaml.safe_load(suites()[name].read_text(encoding="utf-8"))
    ]
    return ["## Suites", "", *rows, "", note, "", *(line for m in members for line in (m, ""))]


def _sweeps() -> list[str]:
    rows = ["| sweep file | what it is |", "|---|---|"]
    rows += [f"| `+sweep={n}` | {_cell(describe(file).title)} |" for n, file in studies().items()]
    lines = ["## Sweep files", "", *rows, ""]
    for file in sorted((CONF / "hydra" / "launcher").glob("*.yaml")):
        found = describe(file)
        lines += [f"## hydra/launcher={file.stem}", "", found.title, ""]
        lines += _table(found.keys, "hydra.launcher")
    return lines


def _whole(file: Path) -> Description:
    """Return what a file says, with the keys of the parts that it is put together from."""
    own = describe(file)
    parts = [file.with_name(f"{name}.yaml") for name in own.defaults if name.startswith("_")]
    return replace(own, keys=[*own.keys, *(key for part in parts for key in describe(part).keys)])


def _group(group: str, default: str | None) -> list[str]:
    files = sorted((CONF / group).glob("[!_]*.yaml"))
    found = {file.stem: _whole(file) for file in files}
    lines = [f"## {group}", "", *_options(group, found, default)]
    main = default if default in found else next(iter(found))
    if group == "experiment":
        for name, description in found.items():
            lines += [f"`{name}` is:", "", "```sh", _command(description), "```", ""]
        return lines
    # A budget sets keys of the whole and of other groups.
    prefix = "" if group == "budget" else group
    lines += [f"Keys, with the values of `{main}`:", "", *_table(found[main].keys, prefix)]
    for name, description in found.items():
        changed = _changes(description, found[main], prefix)
        if changed:
            lines += [f"`{group}={name}` changes:", "", *_table(changed, "")]
    return lines


def _command(experiment: Description) -> str:
    """Return what one would type without the named experiment."""
    choices = [
        f"{group.removeprefix('override /')}={option}" if option else f"+experiment={group}"
        for group, option in experiment.defaults.items()
    ]
    return " ".join(["pgdm-run", *choices, *(f"{k.name}={k.value}" for k in experiment.keys)])


def _changes(description: Description, main: Description, prefix: str) -> list[Key]:
    """Return the keys that differ or are new, in full, with the main file's comments."""
    known = {key.name: key for key in describe(CONF / "config.yaml").keys}
    known |= {f"{prefix}.{key.name}".lstrip("."): key for key in main.keys}
    known |= {f"eval.{key.name}": key for key in describe(CONF / "eval" / "default.yaml").keys}
    changed = []
    for key in description.keys:
        # A file of package _global_ names its keys in full already.
        whole = key.name in known or key.name.startswith(f"{prefix}.")
        name = key.name if whole else f"{prefix}.{key.name}"
        if name not in known:  # what this option has besides
            changed.append(Key(name, key.value, key.comment))
        elif key.value != known[name].value:
            changed.append(Key(name, key.value, key.comment or known[name].comment))
    return changed


def _tasks() -> list[str]:
    lines = [
        "## task",
        "",
        "| task | hand | pre-grasp | motion | in tcdm30 | success in the paper |",
        "|---|---|---|---|---|---|",
    ]
    for file in sorted((CONF / "task").glob("[!_]*.yaml")):
        task = yaml.safe_load(file.read_text(encoding="utf-8"))
        hand = next(
            option
            for entry in task["defaults"]
            if isinstance(entry, dict)
            for key, option in entry.items()
            if "/hand" in key
        )
        share = task["paper_success"]
        success = "not reported" if share is None else f"{share:.1%}"
        lines.append(
            f"| `task={file.stem}` | {hand} | {task['pregrasp_source']} "
            f"| {task['trajectory_source']} | {'yes' if task['tcdm30'] else ''} | {success} |"
        )
    shared = describe(CONF / "task" / "_tcdm.yaml")
    note = "Keys, as they are shared by all tasks (`???`: every task gives its own):"
    return [*lines, "", note, "", *_table(shared.keys, "task")]


def page() -> str:
    """Return the page."""
    config = describe(CONF / "config.yaml")
    lines = [_HEAD, "## What every run has", "", *_table(config.keys, "")]
    for group in groups():
        lines += _tasks() if group == "task" else _group(group, config.defaults.get(group))
    lines += [*_suites(), *_sweeps()]
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE.relative_to(REPOSITORY))
