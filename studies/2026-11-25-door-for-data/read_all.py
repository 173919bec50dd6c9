"""Read every file of a folder as ``idm-env`` does, and print what became of it: ``python read_all.py FOLDER``."""

import sys
from pathlib import Path

from idm_env.data import load

for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        read = load(path)
    except Exception as error:
        print(f"{path.name}: {type(error).__name__}: {error}")
    else:
        print(f"{path.name}: {read.table.height} rows, {read.table['vehicle_id'].n_unique()} vehicles, {read.repairs}")
