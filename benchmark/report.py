"""Measure time and memory of `pgdm report` on as many and as long runs as the paper's.

    python benchmark/report.py [--keep FOLDER]

Fabricates 150 finished runs, 50 tasks with three seeds, with the files of a run of 50M frames
(2 GB), then runs the command twice in a separate process and stores the measurements in results/.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from pgdm.config.compose import PAPER_FRAMES, compose_plain
from pgdm.config.groups import available

RESULT = Path(__file__).parent / "results" / "report.json"
SEEDS = 3
STEP = 4096  # frames per iteration
EVAL_EVERY = 244  # iterations, about 1M frames
# Makes a line as long as in a real run's log.
OTHERS = ", ".join(f'"train/metric_{i}": 0.{i:02d}23456789012345' for i in range(28))


def tasks() -> list[dict[str, Any]]:
    """Return the configuration of each task of the paper."""
    found = (compose_plain([f"task={name}"]) for name in available("task"))
    return [config for config in found if config["task"]["paper_success"] is not None]


def fabricate(root: Path, config: dict[str, Any], seed: int, frames: int = PAPER_FRAMES) -> None:
    """Write the folder of a finished run whose success rises to about that of the paper."""
    chance = random.Random(f"{config['task']['id']} {seed}")
    folder = root / config["task"]["id"] / f"s{seed}"
    (folder / "videos").mkdir(parents=True)
    whole = {**config, "seed": seed, "total_frames": frames, "budget": "paper"}
    (folder / "config.yaml").write_text(yaml.safe_dump({"format": 1, **whole}))
    final = min(1.0, config["task"]["paper_success"] * chance.uniform(0.85, 1.05))
    metrics: dict[str, float] = {}
    with open(folder / "metrics.jsonl", "w") as log:
        for i in range(1, frames // STEP + 2):
            head = f'{{"frames": {i * STEP}, "iteration": {i}, "time_s": {i * 2.1:.3f}, "kind": '
            learnt = 1 - math.exp(-5.0 * i * STEP / frames)
            log.write(f'{head}"train", {OTHERS}, "train/return": {900 * learnt:.6f}}}\n')
            if i % EVAL_EVERY == 0 or i * STEP >= frames:
                metrics = evaluation(final * learnt, chance)
                log.write(f'{head}"eval", {json.dumps(metrics)[1:]}\n')
    result = {"status": "finished", "frames": i * STEP, "metrics": metrics, "git": "0" * 40}
    result |= {"pregrasp_used": "planned", "versions": {"python": platform.python_version()}}
    (folder / "result.json").write_text(json.dumps(result))
    film = folder / "videos" / f"frames_{i * STEP:012d}.mp4"
    film.write_bytes(b"film")
    shades = np.random.default_rng(seed).integers(60, 200, (240, 320, 3), dtype=np.uint8)
    Image.fromarray(shades).resize((640, 480), Image.Resampling.NEAREST).save(
        film.with_suffix(".png")
    )


def evaluation(success: float, chance: random.Random) -> dict[str, float]:
    """Return as many metrics as a real evaluation has."""
    found: dict[str, float] = {}
    for kind in ("sampled", "deterministic"):
        noisy = min(1.0, max(0.0, success + chance.gauss(0, 0.02)))
        named = {"success": noisy, "com_error_released": 2e-2 * math.exp(-4 * noisy)}
        named |= {"lifted": min(1.0, 1.2 * noisy), "ori_error": 1.5 - noisy}
        named |= {f"metric_{n}": chance.random() for n in range(12)}
        found |= {f"eval_{kind}/{name}": value for name, value in named.items()}
        found |= {f"eval_{kind}/{name}_std": 0.1 * value for name, value in named.items()}
    return found


def measure(runs: Path, out: Path) -> float:
    """Run the command and return its time, s."""
    program = "import sys; from pgdm.cli.main import main; sys.exit(main())"
    start = time.perf_counter()
    command = [sys.executable, "-c", program, "report", str(runs), "--out", str(out)]
    subprocess.run(command, check=True)
    return round(time.perf_counter() - start, 1)


def main() -> None:
    """Fabricate runs, measure the command, and store the measurements."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--keep", type=Path, help="folder in which to keep runs and report")
    keep = parser.parse_args().keep
    place = keep or Path(tempfile.mkdtemp(prefix="pgdm-report-"))
    runs, out = place / "runs", place / "report"
    try:
        if not runs.exists():
            for config in tasks():
                for seed in range(SEEDS):
                    fabricate(runs, config, seed)
        seconds = [measure(runs, out) for _ in range(2)]
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        logs = list(runs.rglob("metrics.jsonl"))
        found = {
            "command": "python benchmark/report.py",
            "runs": len(logs),
            "frames_a_run": PAPER_FRAMES,
            "records_gb": round(sum(log.stat().st_size for log in logs) / 1e9, 2),
            "seconds": seconds,
            "cpu_seconds": round((used.ru_utime + used.ru_stime) / len(seconds), 1),
            "peak_memory_mb": used.ru_maxrss // 1024,
            "page_mb": round((out / "report.html").stat().st_size / 1e6, 2),
            "cores": len(os.sched_getaffinity(0)),
            "load": round(os.getloadavg()[0], 1),  # including other programs
            "python": platform.python_version(),
        }
    finally:
        if keep is None:
            shutil.rmtree(place)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
