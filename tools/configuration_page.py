"""Write docs/configuration.md from the files in conf/, which are the only place defaults live.

    python tools/configuration_page.py

tests/test_docs.py fails if the page is not what this would write.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from pgdm.config.describe import Description, Key, describe

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
`my/experiment/fast.yaml` is `+experiment=fast`, and `my/task/mine.yaml` is `task=mine`.
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


def _group(group: str, default: str | None) -> list[str]:
    files = sorted((CONF / group).glob("[!_]*.yaml"))
    found = {file.stem: describe(file) for file in files}
    lines = [f"## {group}", "", *_options(group, found, default)]
    main = default if default in found else next(iter(found))
    if group == "experiment":
        for name, description in found.items():
            lines += [f"`{name}` is:", "", "```sh", _command(description), "```", ""]
        return lines
    lines += [f"Keys, with the values of `{main}`:", "", *_table(found[main].keys, group)]
    for name, description in found.items():
        changed = _changes(description, found[main], group)
        if changed:
            lines += [f"`{group}={name}` changes:", "", *_table(changed, "")]
    return lines


def _command(experiment: Description) -> str:
    """Return what one would type without the named experiment."""
    choices = [f"{g.removeprefix('override /')}={o}" for g, o in experiment.defaults.items()]
    return " ".join(["pgdm-run", *choices, *(f"{k.name}={k.value}" for k in experiment.keys)])


def _changes(description: Description, main: Description, group: str) -> list[Key]:
    """Return the keys that differ, named as on the command line, with the main file's comments."""
    known = {key.name: key for key in describe(CONF / "config.yaml").keys}
    known |= {f"{group}.{key.name}": key for key in main.keys}
    changed = []
    for key in description.keys:
        # A file of package _global_ names its keys in full already.
        name = key.name if key.name in known else f"{group}.{key.name}"
        if key.value != known[name].value:
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
    for folder in sorted(p for p in CONF.iterdir() if p.is_dir() and p.name[0] not in "._"):
        own = folder.name == "task"
        lines += _tasks() if own else _group(folder.name, config.defaults.get(folder.name))
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE.relative_to(REPOSITORY))
