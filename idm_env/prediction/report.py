"""The page of a run of predictions: metrics over all agents, by scene and by kind, and scenes from above."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from idm_env import report as page
from idm_env.prediction.metrics import HORIZONS

WHAT = (("minADE", "minADE (m)"), ("minFDE", "minFDE (m)"), ("miss_rate", "miss rate"), ("mAP", "mAP"))


def write(out: Path, report: dict[str, Any], pictures: Iterable[page.Block]) -> None:
    """Write ``report.json`` and ``report.html``."""
    page.write_json(out / "report.json", report)
    left_out = report["left_out"]
    scored = f"{report['agents_with_known_future']} of them have a known future and are scored, at 2 Hz."
    lost = f"{len(left_out)} files or agents were left out (below)." if left_out else "Nothing was left out."
    blocks = [
        page.lead(f"{scored} {lost}"),
        page.note(
            "minADE and minFDE are those of the best of up to six futures; an agent is missed where no future ends in "
            "a box around the truth that grows with time and speed. mAP asks besides that confident futures be the "
            "right ones. The other methods have one future each."
        ),
        page.heading("All agents"),
        metrics(report["methods"]),
    ]
    for title, groups in (("By scene", report["scenes"]), ("By kind", report["kinds"])):
        blocks.append(page.heading(title))
        for name, rows in groups.items():
            blocks += [page.text(name), metrics(rows)]
    blocks += [page.heading("From above"), page.gallery(pictures)]
    if left_out:
        items = [f"{item['what']}: {item['reason']}" for item in left_out]
        blocks += [page.heading("Left out"), page.bullets(page.shortened(items))]
    if report["notes"]:
        items = [f"{item['scenario']}: {item['note']}" for item in report["notes"]]
        blocks += [page.heading("Notes"), page.bullets(page.shortened(items))]
    title = f"Predictions of {report['agents']} agents in {report['scenarios']} scenarios"
    page.write_page(out / "report.html", title, blocks)


def metrics(rows: Sequence[dict[str, Any]]) -> page.Block:
    """Return the table of methods; of each metric the three horizons in one cell."""
    columns = [f"{title} at {', '.join(str(s) for s in HORIZONS)} s" for _, title in WHAT]
    table = []
    for row in rows:
        cells: dict[str, Any] = {"method": row["method"], "agents": row["agents"]}
        for (name, _), column in zip(WHAT, columns, strict=True):
            values = [row[f"{name}_{s}s"] for s in HORIZONS]
            cells[column] = " · ".join(f"{v:.2f}" if v == v else "–" for v in values)
        table.append(cells)
    return page.table(table, first=True)
