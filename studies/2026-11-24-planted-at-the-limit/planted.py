"""Effects planted at the limit that ``explain`` states: ``python planted.py SEED …``, a line of JSON for each.

A generated set without an effect (drivers' noise 0.1 m/s²) is explained; its ``would_be_found`` are limits. Each set is
generated once more, the same drivers and noise, with one effect of that strength, and is explained afresh. The limit's
side is that of the parameter's default, in the sign that the generator has.
"""

import json
import sys

from benchmarks.discovery import RESPONSE, TRUE
from idm_env.data import synthetic
from idm_env.discovery import discover
from idm_env.effects import ALL


def strength(name: str, limit: dict) -> float | None:
    """Return the planted strength; None where the limit is of a parameter that the effect does not declare."""
    p = next((p for p in ALL[name].declared if p.name == limit["parameter"]), None)
    if p is None:
        return None
    null, away = p.null or 0.0, limit["would_be_found"]
    return (null + (away if p.default > null else -away)) * TRUE[name][1]


def main(seed: int, most: int = 8) -> None:
    """Print what becomes of every second effect that has a limit, from the first or second one on by the seed."""
    limits = {e["effect"]: e for e in discover(synthetic.generate(seed, ou=0.1)[0], seed=seed).report["excluded"]}
    names = [n for n in TRUE if n in synthetic.EFFECTS and limits.get(n, {}).get("would_be_found")]
    for name in [n for n in names if n not in ("speed_zone", "regime_shift")][seed % 2 :: 2][:most]:
        planted = strength(name, limits[name])
        if planted is None:
            continue
        report = discover(synthetic.generate(seed, effect={name: planted}, ou=0.1)[0], seed=seed).report
        told = {x["effect"] or x["label"] for x in report["found"]} | {y for x in report["found"] for y in x["equivalent"]}
        right = name in told or (name in RESPONSE and bool(RESPONSE & told))
        nearest = report["candidates"][0]["effect"]
        print(json.dumps({"seed": seed, "effect": name, "strength": planted, "verdict": report["verdict"],
                          "told": sorted(told), "right": right, "nearest": nearest}), flush=True)  # fmt: skip


for argument in sys.argv[1:]:
    main(int(argument))
