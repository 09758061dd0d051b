"""The benchmark suite: problems x methods x tolerances x peers.

    python benchmarks/suite.py                      everything
    python benchmarks/suite.py --only scaling batch only these sections
    python benchmarks/suite.py --size one           the smallest run of each, for tests
    python benchmarks/suite.py --no-peers           ours only

Every section writes `results/suite_<section>.json` as soon as it is done, so that an
interrupted run keeps what it has; `report.py` makes the page from these files.
"""

import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

# compile times are measured
jax.config.update("jax_enable_compilation_cache", False)

from peers.adapter import Peer
from sections.gradient import gradient
from sections.hexacopter import hexacopter
from sections.ours import peers
from sections.precision import describe, published_problems, stiff_variants, work_precision
from sections.size import FULL, ONE, Size
from sections.speed import batch, scaling
from sections.vector_steps import vector_steps
from shared.record import make_parser, write_record

SECTIONS: dict[str, Callable[[Size, list[Peer]], dict[str, Any]]] = {
    "work_precision": work_precision, "batch": batch, "scaling": scaling, "gradient": gradient,
    "hexacopter": hexacopter, "published": published_problems, "stiff": stiff_variants,
    "vector_steps": vector_steps,
}  # fmt: skip


def machine() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = (x.split(":", 1)[1].strip() for x in lines if x.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def main() -> None:
    """Run what was asked for."""
    parser = make_parser(__doc__, **{"no-peers": "ours only"})
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--size", choices=("full", "one"), default="full")
    options = parser.parse_args()
    size = FULL if options.size == "full" else ONE
    there, absent = ([], []) if options.no_peers else peers()
    for row in absent:
        print(f"skipped: {row['method']}: {row['reason']}", flush=True)
    options.results.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        print(f"== {name}", flush=True)
        clock = time.perf_counter()
        content = SECTIONS[name](size, there)
        took = time.perf_counter() - clock
        head = {"section": name, "size": options.size, "took_seconds": took, "machine": machine()}
        compared = {"peers": describe(there), "skipped": absent}
        path = write_record(f"suite_{name}", {**head, **compared, **content}, options.results)
        print(f"{path}, {took:.0f} s", flush=True)


if __name__ == "__main__":
    main()
