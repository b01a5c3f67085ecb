"""Run folders as a training leaves them, without the training."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from pgdm.runs.folder import RunFolder
from pgdm.runs.log import RunLog
from pgdm.tracking.mlflow import Store, store_uri

STEP = 4096
LENGTH = 10  # iterations


def config(seed: int = 0, **changes: Any) -> dict[str, Any]:
    whole = {
        "task": {"id": "hammer-use1", "objects": ["hammer"], "paper_success": None},
        "hand": {"name": "adroit"},
        "method": {"name": "pgdm", "reward": {"tracking_weight": 10.0}},
        "ablation": {"name": "none"},
        "pregrasp": {"source": "planned"},
        "obs": {"layout": "released"},
        "action": {"kind": "residual"},
        "algo": {"name": "ppo_fast", "hidden": [256, 128]},
        "tracking": {"kind": "mlflow", "uri": None, "experiment": "pgdm"},
        "seed": seed,
        "total_frames": LENGTH * STEP,
        "budget": "smoke",
        "run_dir": "anywhere",
        "resume": "auto",
    }
    return whole | changes


def make(path: Path, seed: int = 0, **changes: Any) -> RunFolder:
    """Return a run that has just started."""
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.yaml").write_text(yaml.safe_dump(config(seed, **changes)))
    return RunFolder(path)


def train_metrics(iteration: int) -> dict[str, float]:
    return {"train/return": 10.0 * iteration, "train/steps_per_s": 2000.0 + iteration}


def eval_metrics(iteration: int) -> dict[str, float]:
    named = {"success": iteration / 100, "com_error_released": 3e-4, "lifted": 0.5}
    return {f"{g}/{k}": v for g in ("eval_sampled", "eval_deterministic") for k, v in named.items()}


def train(folder: RunFolder, first: int = 1, last: int = LENGTH) -> None:
    """Append iterations first..last to the run's log, an evaluation at every fifth."""
    log = RunLog(folder.path / "metrics.jsonl")
    for i in range(first, last + 1):
        place = {"frames": i * STEP, "iteration": i, "time_s": 2.0 * i}
        log.append(train_metrics(i), kind="train", **place)
        if i % 5 == 0:
            log.append(eval_metrics(i), kind="eval", **place)


def end(folder: RunFolder, status: str = "finished") -> None:
    """Write what the end of a run writes."""
    videos, checkpoints = folder.path / "videos", folder.path / "checkpoints"
    for place in (videos, checkpoints):
        place.mkdir(exist_ok=True)
    (videos / "frames_000000040960.mp4").write_bytes(b"film")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(videos / "frames_000000040960.png")
    for name in ("best", "frames_000000036864", "frames_000000040960"):
        (checkpoints / f"{name}.ckpt").write_text(name)
    result = {
        "status": status,
        "frames": LENGTH * STEP,
        "metrics": eval_metrics(LENGTH),
        "steps_per_s": 1987.6,
        "asset_source": "checkout",
        "git": "0123abc",
    }
    (folder.path / "result.json").write_text(json.dumps(result))


def truth(folder: RunFolder) -> dict[str, dict[int, float]]:
    """Return what a run has recorded: each metric at each step."""
    shown: dict[str, dict[int, float]] = {}
    for record in folder.log.read():
        for name, value in record.items():
            if "/" in name:
                shown.setdefault(name, {})[int(record["frames"])] = float(value)
    return shown


_databases: list[Path] = []


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an MLflow database without runs, the same one to all modules that import this."""
    if not _databases:
        root = tmp_path_factory.mktemp("database")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            Store.open(store_uri(root), "other")
        _databases.append(root / "mlflow.db")
    return _databases[0]
