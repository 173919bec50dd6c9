"""Writes a discovery: report.json for programs, report.html for people, models for simulations."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from idm_env.discovery.finish import Discovery, corrected
from idm_env.discovery.records import Records
from idm_env.discovery.selection import Decided
from idm_env.discovery.summary import candidates_of
from idm_env.jobs.storage import plain, results, write_json
from idm_env.model_file import save_model
from idm_env.reports.undecided import EXPLAINED, FOUND, SEARCH


def write_report(discovery: Discovery, out: str | Path) -> dict[str, Path]:
    """Write report.json, report.html (self-contained) and models into a folder; return their paths by file name.

    ``model.yaml`` is the model that the verdict is about; where two were compared, the other lies beside it as
    ``model_idm.yaml`` or ``model_corrected.yaml``, and laws of kinds of drivers as ``model_group_1.yaml`` and so
    on. A finding in a state that has no name is ``found_effect.py``, too.
    """
    from idm_env.discovery import page

    with results(out, EXPLAINED) as folder:
        found_effect = discovery.found_effect
        unnamed = (FOUND,) if found_effect else ()
        paths = {name: folder / name for name in ("report.json", "report.html", *discovery.models, *unnamed)}
        for name in EXPLAINED:  # the other model of an earlier run would be taken for one of this
            if name not in paths:
                (folder / name).unlink(missing_ok=True)
        write_json(paths["report.json"], discovery.report)
        for name, model in discovery.models.items():
            save_model(paths[name], model)
        if found_effect:
            paths[FOUND].write_text(found_effect, encoding="utf-8")
        page.write(paths["report.html"], discovery)
    return paths


def write_search(out: Path, decided: Decided, prepared: Records, by: str) -> Path:
    """Write what a search saw where its judgement failed; return the path of ``search.json``.

    All candidates of every round, and the terms that were chosen with their values. The model that they make is
    ``model_search.yaml``, where it can be made. What an earlier run wrote stays.
    """
    final = decided.steps[-1] if decided.steps else decided.null
    values = {t.label: final.values[final.model.where(t.label)].tolist() for t in final.model.terms}
    with results(out, EXPLAINED) as folder:
        path = folder / SEARCH[0]
        write_json(path, plain({"chosen": values, "candidates": candidates_of(decided.rounds, {})}))
        with suppress(ValueError):  # that may be what failed
            save_model(folder / SEARCH[1], corrected(prepared, final, final.theta, by))
    return path
