"""The page of a run of predictions: metrics over all agents, by scene and by kind, and scenes from above."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from idm_env.jobs import storage
from idm_env.prediction.metrics import ENOUGH_SCENES, HORIZONS
from idm_env.reports import page

WHAT = (("minADE", "minADE (m)"), ("minFDE", "minFDE (m)"), ("miss_rate", "miss rate"), ("mAP", "mAP"))


def write(out: Path, report: dict[str, Any], pictures: Iterable[page.Block]) -> None:
    """Write ``report.json`` and ``report.html``."""
    storage.write_json(out / "report.json", report)
    left_out = report["left_out"]
    scored = f"Of {report['agents']} agents {report['agents_with_known_future']} have a known future and are scored."
    blocks = [
        page.lead(f"{scored} {report['account']}"),
        page.gallery(pictures),
        page.note(
            "Scored at 2 Hz. minADE and minFDE are those of the best of up to six futures; an agent is missed where no "
            "future ends in a box around the truth that grows with time and speed. mAP asks besides that confident "
            "futures be the right ones. The other methods have one future each."
        ),
        page.heading("All agents"),
        metrics(report["methods"]),
        page.note(_how(report)),
        *_groups("By kind", "kind", report["kinds"]),
        *_groups("By scene", "scene", report["scenes"]),
        page.heading("Data"),
        page.text(report["account"]),
    ]
    if left_out:
        items = [f"{item['what']}: {item['reason']}" for item in left_out]
        blocks += [page.heading("Left out"), page.bullets(page.shortened(items))]
    if report["notes"]:
        items = [f"{item['scenario']}: {item['note']}" for item in report["notes"]]
        blocks += [page.heading("Notes"), page.bullets(page.shortened(items))]
    several = "" if report["scenarios"] == 1 else "s"
    title = f"Predictions of {report['agents']} agents in {report['scenarios']} scenario{several}"
    page.write_page(out / "report.html", title, blocks)


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


def _how(report: dict[str, Any]) -> str:
    whole = len(report["scenes"]) >= ENOUGH_SCENES
    words = f"whole scenes drawn anew ({len(report['scenes'])})" if whole else "agents drawn anew"
    few = (
        ""
        if whole
        else f" They say nothing of how scenes differ (there are {len(report['scenes'])}): another may lie outside."
    )
    return f"95 %: bootstrap intervals, {words}.{few} A click on a heading sorts."


def _groups(title: str, what: str, groups: dict[str, list[dict[str, Any]]]) -> list[page.Block]:
    """Return the table of methods by kind or scene at the longest horizon, one figure a column."""
    last = HORIZONS[-1]
    rows = [
        {
            what: name, "method": row["method"], "agents": row["agents"],
            **{f"{words} {last} s": row[f"{key}_{last}s"] for key, words in WHAT},
        }
        for name, methods in groups.items() for row in methods
    ]  # fmt: skip
    if not rows:
        return []
    digits = {f"{words} {last} s": 2 for _, words in WHAT}
    return [page.heading(title), page.table(rows, digits=digits)]
