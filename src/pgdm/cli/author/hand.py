"""``pgdm author hand``: make a hand from MJCF or URDF, print its properties and draw it."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from pgdm.author.hand import AuthoredHand, HandRequest, author_hand
from pgdm.cli.console.screen import bars, console, notify
from pgdm.errors import ConfigError, RenderError, amount
from pgdm.sim.hand_sheet import write_hand_sheet


def pairs(option: str, words: Sequence[str]) -> dict[str, str]:
    """Parse ``a=b,c=d``, possibly split over several words, into a dictionary.

    Raises:
        ConfigError: an entry does not have that form, or a name occurs twice.
    """
    found: dict[str, str] = {}
    for word in ",".join(words).split(","):
        name, sign, value = word.strip().partition("=")
        if not (sign and name and value):
            raise ConfigError(f"{option} '{word}' is not valid; give NAME=VALUE, NAME=VALUE, ...")
        if name in found:
            raise ConfigError(f"{option} has '{name}' twice")
        found[name] = value
    return found


def numbers(option: str, text: str) -> tuple[float, float, float]:
    """Parse a text such as ``0,-0.3,0.2``.

    Raises:
        ConfigError: it does not consist of three numbers.
    """
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError as error:
        raise ConfigError(f"{option} '{text}' is not valid; give three numbers X,Y,Z") from error
    return x, y, z


def angles(words: Sequence[str]) -> dict[str, float]:
    """Parse ``--reset`` into positions by joint, rad or m.

    Raises:
        ConfigError: a value is not a number.
    """
    found = {}
    for name, text in pairs("--reset", words).items():
        try:
            found[name] = float(text)
        except ValueError as error:
            raise ConfigError(f"--reset {name}={text}: '{text}' is not a number") from error
    return found


def run(request: HandRequest) -> None:
    """Make a hand, print what was found and changed, and draw it.

    Raises:
        PgdmError: the file cannot be used, a value is wrong, or the hand cannot be stored.
    """
    with bars() as progress:
        made = author_hand(request, progress)
    for note in made.notes:
        print(f"note: {note}")
    table = Table(box=None, show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, text in (*_found(made), *made.checks.rows()):
        table.add_row(name, text)
    console().print(table, markup=False)
    print(f"hand:     {made.folder / 'hand.xml'}")
    print(f"settings: {made.settings}")
    _draw(made)
    print(f"next:     pgdm-run +experiment=fast task=hammer-use1 hand={made.name}")


def _found(made: AuthoredHand) -> list[tuple[str, str]]:
    found = made.anatomy
    fingers = ", ".join(f"{f.human} ({amount(len(f.joints), 'joint')})" for f in found.fingers)
    gains = sorted({s.kp for s in made.servos.values()})
    given = sum(servo.given for servo in made.servos.values())
    reset = {
        made.scene.model.joint(j).name.rpartition("/")[2]: float(q)
        for j, q in enumerate(made.scene.index.reset)
        if q
    }
    moved = ", ".join(f"{name} {value:.3f}" for name, value in reset.items())
    rows = [
        ("side", made.side),
        ("fingers", f"{fingers}; found by {found.found_by}"),
        ("wrist", f"joints that move the palm: {len(found.wrist_joints)}"),
        ("servos", f"gain {', '.join(f'{g:g}' for g in gains)}; {given} with the file's gain"),
        ("reset", f"all joints at zero{f', but {moved}' if moved else ''}"),
    ]
    if made.source.mimics:
        rows.append(("coupled", "; ".join(made.source.mimics)))
    return rows


def _draw(made: AuthoredHand) -> None:
    try:
        path = write_hand_sheet(made.scene, made.mean, made.folder / "picture.png")
    except RenderError as error:
        notify(f"no picture: {error}")
        return
    print(f"picture:  {path}")
