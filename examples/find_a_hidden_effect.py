"""Find a hidden effect: drivers react late, the data do not say so, and IDM cannot. Discovery names it and its size."""

from idm_env.data import synthetic
from idm_env.discovery import discover

trajectories, truth = synthetic.generate(seed=4, runs=10, followers=2, seconds=120.0, effect="delay", noise=0.1)
found = discover(trajectories, seed=0)

report = found.report
best = report["found"][0]
delay = best["parameters"]["delay"]
before, after = (report["error"][k]["gap_rmse_m"] for k in ("before", "after"))
print(f"verdict: {report['verdict']}, effect: {best['effect']}")
print(
    f"delay {delay['estimate']:.3f} s ({delay['low']:.3f} to {delay['high']:.3f}), truth {truth.effects['delay']:.3f} s"
)
print(f"gap RMSE on held-out runs: {before:.2f} m before, {after:.2f} m after")
assert best["effect"] == "delay" and after < before
