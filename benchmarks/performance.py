"""All figures of speed: ``python benchmarks/performance.py --out out/bench`` (what ``idm-env bench`` runs)."""

from __future__ import annotations

import argparse

from idm_env import bench
from idm_env.bench import tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", help="folder for performance.json, performance.png and report.html")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(bench.SIZES))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    a = parser.parse_args()
    result = bench.run(
        a.out, sizes=a.sizes, rounds=a.rounds, compiled=not a.no_compile, others=not a.no_peers, verbose=a.verbose
    )
    for title, rows, words in tables.of(result):
        print(f"\n{title}. {words}")
        for row in rows:
            print("  " + "  ".join(f"{name} {v:.4g}" if isinstance(v, float) else str(v) for name, v in row.items()))


if __name__ == "__main__":
    main()
