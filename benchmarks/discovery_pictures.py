"""The pictures of docs/closing-the-loop.md, from data made here: ``python -m benchmarks.discovery_pictures``."""

from __future__ import annotations

from pathlib import Path

from idm_env.data import synthetic
from idm_env.discovery import discover, pictures


def main() -> None:
    trajectories, _ = synthetic.generate(3, effect="brake_light", ou=0.05)
    found = discover(trajectories)
    for name, figure in (
        ("ranking", pictures.ranking(found.rounds[0])),
        ("look_alikes", pictures.look_alikes(found)),
        ("gaps", pictures.gaps(found)),
    ):
        assert figure is not None
        path = Path("docs") / f"discovery_{name}.png"
        figure.savefig(path, dpi=90, bbox_inches="tight")
        print(path)


if __name__ == "__main__":
    main()
