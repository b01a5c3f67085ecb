"""``pgdm zoo ...``: policies of finished studies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pgdm.cli.console.screen import loading, tables
from pgdm.cli.options import Offline
from pgdm.errors import ConfigError, amount, check_name

app = typer.Typer(
    name="zoo",
    help="Trained policies: list them, fetch them, reproduce their results.",
    no_args_is_help=True,
)

Place = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="PLACE",
        help="Folder or http(s) address of the zoo [PGDM_ZOO, else zoo/ of the checkout].",
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name in pgdm zoo list.")]


@app.command("list")
def list_policies(place: Place = None) -> None:
    """List the policies with their results."""
    from rich.markup import escape
    from rich.table import Table

    from pgdm.zoo import Zoo

    zoo = Zoo(place)
    table = Table(
        caption="success and error (released form, m) of sampled actions; no noise: success of the "
        "mean action"
    )
    for head in ("name", "task", "hand", "method", "algo", "action", "seed", "frames"):
        table.add_column(head, no_wrap=True)
    for head in ("success", "no noise", "error", "kB"):
        table.add_column(head, justify="right", no_wrap=True)
    for name, entry in zoo.entries.items():
        texts = (name, entry.task, entry.hand, entry.method, entry.algo, entry.action)
        table.add_row(
            *map(escape, texts),
            str(entry.seed),
            f"{entry.frames:,}",
            f"{entry.success:.1%}",
            f"{entry.deterministic:.1%}",
            f"{entry.com_error_released:.2e}",
            f"{entry.bytes / 1000:.0f}",
        )
    tables().print(table)
    total = sum(entry.bytes for entry in zoo.entries.values())
    print(f"{amount(len(zoo.entries), 'policy', 'policies')} in {zoo.place}, {total / 1e6:.1f} MB")


@app.command()
def show(name: Name, place: Place = None) -> None:
    """Print settings, result, hashes and provenance of a policy, as YAML."""
    import yaml

    from pgdm.zoo import Zoo

    with loading():
        from pgdm.export.tensors import about

    print(yaml.safe_dump(about(Zoo(place).content(name), name), sort_keys=False), end="")


@app.command()
def get(
    name: Name,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write [NAME.safetensors].")
    ] = None,
    place: Place = None,
) -> None:
    """Copy a policy out of the zoo, as a safetensors file."""
    from pgdm import files, paths
    from pgdm.zoo import Zoo

    with loading():
        from pgdm.export.tensors import unpacked
    path = out or Path(f"{name}.safetensors")
    if path.suffix != ".safetensors":
        raise ConfigError(f"--out '{path}': give a name that ends in .safetensors")
    content = unpacked(Zoo(place).content(name), name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with paths.replacing(path) as temp:
            temp.write_bytes(content)
    except OSError as error:
        raise ConfigError(f"cannot write '{path}': {files.reason(error)}") from error
    print(f"policy: {path} ({path.stat().st_size / 1e6:.2f} MB)")


@app.command("eval")
def evaluate(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME...", help="Names in pgdm zoo list [all].")
    ] = None,
    place: Place = None,
    offline: Offline = False,
) -> None:
    """Evaluate policies again, and compare with the stored results.

    The exit code is 1 if a result is not reproduced bit-identically.
    """
    from pgdm.zoo import Zoo

    zoo = Zoo(place)
    for name in names or ():
        check_name("policy of the zoo", name, zoo.entries)
    with loading():
        from pgdm.cli.evaluate import EvalRequest, evaluate_policy
        from pgdm.cli.policies import PolicyRequest
        from pgdm.zoo.place import PREFIX

    worst = 0
    for name in names or zoo.entries:
        request = PolicyRequest(f"{PREFIX}{name}", zoo=zoo)
        code = evaluate_policy(EvalRequest(request, None, False, False, None, offline))
        worst = max(worst, code)
        if code > 1:  # stopped by a signal
            break
    raise typer.Exit(worst)
