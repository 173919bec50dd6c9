"""Writes a discovery: report.json for programs, report.html for people, model.yaml for simulations."""

from __future__ import annotations

from pathlib import Path

from idm_env.config import save_model
from idm_env.discovery.discover import Discovery
from idm_env.keep import results
from idm_env.report import write_json, write_page

OUTPUT = ("report.json", "report.html", "model.yaml")


def write_report(discovery: Discovery, out: str | Path) -> dict[str, Path]:
    """Write ``report.json``, ``report.html`` (self-contained) and ``model.yaml`` into a folder; return their paths."""
    from idm_env.discovery import page

    with results(out, OUTPUT) as folder:
        paths = {name: folder / name for name in OUTPUT}
        write_json(paths["report.json"], discovery.report)
        save_model(paths["model.yaml"], discovery.model)
        title = f"What is missing? {discovery.verdict.replace('_', ' ')}"
        write_page(paths["report.html"], title, page.blocks(discovery))
    return paths
