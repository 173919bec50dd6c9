"""Every law alone on three measured files, cross-fitted by discovery's own function.

python studies/2026-11-27-independent-split/crossed_laws.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

from idm_env.data import load
from idm_env.data.recorders import on_one_clock
from idm_env.discovery import bases, crossed, march, model as terms
from idm_env.discovery.compare import compare
from idm_env.discovery.discover import _split, prepare
from idm_env.discovery.model import Hypothesis
from idm_env.effects import base_named, make

CASES = {
    "TGSIM": ("tgsim_pairs", ()),
    "I-80 pairs": ("ngsim_i80_pairs", ()),
    "AstaZero, ACC": ("openacc_astazero", ("acc_run=ACC",)),
}
NULL = Hypothesis((), march.Catalogue((), located=False))
SOFT = make("gap_stiffness")
LAWS = {
    "IDM": NULL,
    "linear constant time gap": Hypothesis((), march.Catalogue((), base_named("constant_time_gap"), located=False)),
    "IDM, own stiffness": Hypothesis(
        (terms.personal(SOFT),), march.Catalogue((SOFT,), located=False, personal=(SOFT.name,))
    ),
    "IDM with three own gains": bases.personal(NULL, base_named("idm")),
    "improved IDM with three own gains": bases.personal(NULL, base_named("iidm")),
}

for case, (name, where) in CASES.items():
    trajectories = load(Path(sys.argv[1]) / f"{name}.parquet").where(where)
    records = prepare(on_one_clock(trajectories), "driver")
    fold = crossed.folds_of(records.runs, _split(records, 0.25, 0)[1], 0)
    values = np.zeros((int(fold.max()) + 1, 0))
    judged = {law: crossed.crossed(records, model, values, fold) for law, model in LAWS.items()}
    for law, one in judged.items():
        for error, c in compare(judged["IDM"], one).items():
            print(
                f"{case}, {law}, {error}: {c.after:.2f}, {c.ratio:.2f} ({c.low:.2f} … {c.high:.2f}), {c.outcome.value}"
            )
