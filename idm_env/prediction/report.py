"""The page of a run of predictions: metrics over all agents, by scene and by kind, and scenes from above."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from idm_env.prediction.metrics import ENOUGH_SCENES, HORIZONS
from idm_env.reports import page

WHAT = (("minADE", "minADE (m)"), ("minFDE", "minFDE (m)"), ("miss_rate", "miss rate"), ("mAP", "mAP"))


def write(out: Path, report: dict[str, Any], pictures: Iterable[page.Block]) -> dict[str, Any]:
    """Write and return the report."""
    several = "" if report["scenarios"] == 1 else "s"
    title = f"Predictions of {report['agents']} agents in {report['scenarios']} scenario{several}"
    names: dict[str, Any] = {
        "pictures": page.Block("gallery", rows=tuple(pictures)),
        "metrics": metrics,
        "groups": groups,
    }
    names |= {"shortened": page.shortened, "enough_scenes": ENOUGH_SCENES}
    return page.write_report(out, title, Path(__file__).with_name("predict.html"), report, **names)


def metrics(rows: Sequence[dict[str, Any]]) -> page.Block:
    """Return the table of methods, one row per horizon and one figure a column, with intervals."""
    table = []
    for seconds in reversed(HORIZONS):
        for row in rows:
            cells: dict[str, Any] = {"method": row["method"], "agents": row["agents"], "seconds ahead": seconds}
            for name, title in WHAT:
                low, high = row["intervals"][f"{name}_{seconds}s"]
                cells[title] = row[f"{name}_{seconds}s"]
                finite = low == low
                cells[f"{title}: 95 %"] = page.Cell(f"{low:.2f} … {high:.2f}" if finite else "–", low)
            table.append(cells)
    return page.table(table, digits={title: 2 for _, title in WHAT}, first=True)


def groups(what: str, methods_of: dict[str, list[dict[str, Any]]]) -> page.Block:
    """Return the table of methods by kind or scene at the longest horizon, one figure a column."""
    last, rows = HORIZONS[-1], []
    for name, methods in methods_of.items():
        for row in methods:
            values = {f"{words} {last} s": row[f"{key}_{last}s"] for key, words in WHAT}
            rows.append({what: name, "method": row["method"], "agents": row["agents"], **values})
    return page.table(rows, digits={f"{words} {last} s": 2 for _, words in WHAT})
