"""What every benchmark result carries besides its numbers, and how it is written."""

import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from stmuav_jax.view.io import versions, write_atomically

RESULTS = Path(__file__).parent / "results"


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    )
    return done.stdout.strip()


def environment() -> dict[str, Any]:
    """Commit, dirty flag, versions, machine and date."""
    return {
        "commit": _git("rev-parse", "HEAD") or "unknown",
        "dirty": bool(_git("status", "--porcelain", "--untracked-files=no")),
        "versions": versions(),
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load_at_start": os.getloadavg()[0],
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def write(name: str, content: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write one benchmark's result; returns the path."""
    text = json.dumps({"environment": environment(), **content}, indent=2) + "\n"
    return write_atomically(folder / f"{name}.json", text.encode())
