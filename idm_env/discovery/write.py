"""Writes a discovery: report.json for programs, report.html for people, model.yaml for simulations."""

from __future__ import annotations

import json
from pathlib import Path

from idm_env.config import save_model
from idm_env.discovery.discover import Discovery


def write_report(discovery: Discovery, out: str | Path) -> dict[str, Path]:
    """Write ``report.json``, ``report.html`` (self-contained) and ``model.yaml`` into a folder; return their paths."""
    from jinja2 import Environment, PackageLoader

    from idm_env.discovery import pictures

    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / name for name in ("report.json", "report.html", "model.yaml")}
    paths["report.json"].write_text(json.dumps(discovery.report, indent=1, ensure_ascii=False), encoding="utf-8")
    save_model(paths["model.yaml"], discovery.model)
    environment = Environment(loader=PackageLoader("idm_env.discovery", "."), autoescape=True)
    environment.filters["number"] = number
    page = environment.get_template("report.html").render(r=discovery.report, pictures=pictures.all_of(discovery))
    paths["report.html"].write_text(page, encoding="utf-8")
    return paths


def number(x: object, digits: int = 3) -> str:
    """Return a number with so many significant digits, a dash for what is not there."""
    if x is None:
        return "–"
    return f"{x:.{digits}g}" if isinstance(x, float) else str(x)
