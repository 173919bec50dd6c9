"""Calibrate drivers by gradients through the simulator, and see which parameters the data tell."""

from idm_env.data import episodes, synthetic
from idm_env.fitting.fit import fit

trajectories, truth = synthetic.generate(seed=3, runs=2, followers=2, seconds=90.0, noise=0.05)
found = fit(episodes(trajectories, max_gap=None, smooth=True), by="driver", loss="mse")

drivers = {f"{r['run_id']}/{r['vehicle_id']}": r for r in truth.drivers.to_dicts()}
for row in found.table():
    name = row["parameter"].split(".")[1]
    true = drivers[row["group"]][name]
    print(
        f"{row['group']:>8} {name:<15} {row['estimate']:7.3f} ± {1.96 * row['standard_error']:.3f}   truth {true:7.3f}"
    )
assert bool(found.converged.all())
