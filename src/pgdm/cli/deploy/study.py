"""``pgdm deploy study``: export and simulate all runs of a task."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from pgdm.cli.console.screen import bars, notify, tables
from pgdm.cli.deploy.export import ExportRequest, Place, converted
from pgdm.cli.deploy.simulate import SimulateRequest, simulated
from pgdm.config.saved import load_config
from pgdm.deploy.convert import ConvertCfg
from pgdm.deploy.playback import write
from pgdm.errors import ConfigError, PgdmError
from pgdm.runs.files import write_json
from pgdm.runs.folder import find_runs

PLAYBACK, RESULTS = "playback.npz", "playbacks.json"
_EPISODES, _SEED = 32, 0


def run_study(folder: Path, task: str, speed: float, boxes: int, offline: bool) -> int:
    """Export and simulate all runs of a task below a folder; print and store a table.

    Raises:
        ConfigError: if there is no such run, the settings of a run are damaged, or ``speed`` is not
            above 0.
    """
    cfg = ConvertCfg(speed=speed)
    cfg.check()
    runs = [run.path for run in find_runs(folder) if load_config(run.path).task.id == task]
    if not runs:
        raise ConfigError(f"there is no run of '{task}' below {folder}")
    rows: dict[str, dict[str, float | str]] = {}
    for number, run in enumerate(runs, 1):
        name = str(run.relative_to(folder.absolute()))
        notify(f"{name} ({number} of {len(runs)})")
        try:
            rows[name] = _played(run, cfg, boxes, offline)
        except PgdmError as error:
            rows[name] = {"failed": str(error)}
    settings = {"task": task, "speed": speed, "boxes": boxes, "seed": _SEED}
    write_json(folder / RESULTS, {**settings, "runs": rows})
    _print(rows)
    print(f"also in {folder / RESULTS}")
    return 1 if any("failed" in row for row in rows.values()) else 0


def _played(run: Path, cfg: ConvertCfg, boxes: int, offline: bool) -> dict[str, float | str]:
    """Export and simulate a run; return its row of the table."""
    out = run / PLAYBACK
    request = ExportRequest(run, out, _EPISODES, False, False, False, None, offline)
    done = converted(request, cfg, Place())
    if not done.possible:
        reasons = [v.described for v in done.usage.violations] + [done.unreached or ""]
        return {"failed": f"the arm cannot play it: {reasons[0]}"}
    write(out, done.playback)
    with bars() as progress:
        _, _, outcome = simulated(SimulateRequest(out, boxes, _SEED, None, offline), progress)
    share = done.usage.share
    return {
        "held": float(outcome.held.mean()),
        "height_m": float(outcome.height_m[-1].mean()),
        "lifted_s": float(outcome.lifted_s.mean()),
        "ik_error_m": float(done.path.position_error_m.max()),
        "ik_error_rad": float(done.path.rotation_error_rad.max()),
        "joint_margin_rad": float(share["position"].min()),
        "velocity_share": float(share["velocity"].max()),
        "acceleration_share": float(share["acceleration"].max()),
        "jerk_share": float(share["jerk"].max()),
    }


def _print(rows: dict[str, dict[str, float | str]]) -> None:
    table = Table(box=None, pad_edge=False)
    for name in ("run", "held", "IK error", "margin", "velocity", "acceleration", "jerk"):
        table.add_column(name)
    for name, row in rows.items():
        if "failed" in row:
            table.add_row(name, str(row["failed"]))
            continue
        shares = [
            f"{100 * float(row[f'{q}_share']):.0f}%" for q in ("velocity", "acceleration", "jerk")
        ]
        table.add_row(
            name,
            f"{100 * float(row['held']):.0f}%",
            f"{1e3 * float(row['ik_error_m']):.3f} mm",
            f"{float(row['joint_margin_rad']):.3f} rad",
            *shares,
        )
    tables().print(table)
