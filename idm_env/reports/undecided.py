"""The report of ``explain`` on one recording, which cannot tell: written before torch and numba are imported."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from idm_env.jobs.storage import results, write_json
from idm_env.reports import page
from idm_env.reports.diagrams import space_time

if TYPE_CHECKING:
    from idm_env.data import Trajectories

FOUND = "found_effect.py"
"""An effect in a state that has no name."""
GROUPS = tuple(f"model_group_{number}.yaml" for number in range(1, 9))
"""Laws of several kinds of drivers."""
SEARCH = ("search.json", "model_search.yaml")
"""What a search saw whose judgement failed, and the model that it had come to."""
_MODELS = ("model.yaml", "model_idm.yaml", "model_law.yaml", "model_corrected.yaml")
EXPLAINED = ("report.json", "report.html", *_MODELS, *GROUPS, FOUND, *SEARCH)
"""What ``explain`` writes."""


def write(trajectories: Trajectories, cure: str, out: Path, inputs: Iterable[Path] = ()) -> dict[str, Any]:
    """Write and return the report on one recording, of which nothing can be held out, with the ``cure``.

    The report has the keys of every report of ``explain``; there is no model.
    """
    sentence = f"{trajectories.source} is one recording, so no run can be held out as a test set. {cure}"
    report: dict[str, Any] = {"verdict": "cannot_tell", "reason": "few_runs", "sentence": sentence, "details": [cure]}
    report |= {"found": [], "known": [], "helps": {}, "ladder": None, "interval": None, "models": {}, "partial": None}
    report |= {"candidates": [], "shared": None, "excluded": [], "parameters": [], "data": trajectories.summary()}
    report["error"] = {"held_out_runs": [], "held_out_drivers": [], "before": None, "after": None}
    report |= {"prior": None, "bases": [], "completed": None, "fleet": None, "rolled": {}, "versions": page.versions()}
    cards = [
        ("Recordings", "", "1"),
        ("Drivers behind a leader", "", str(len(trajectories.followers()))),
        ("What to do", "", cure),
    ]
    with results(out, EXPLAINED, inputs) as folder:
        for name in EXPLAINED:  # a model of an earlier run would be taken for one of this
            (folder / name).unlink(missing_ok=True)
        write_json(folder / "report.json", report)
        picture = page.picture(space_time(trajectories), "The recording: a line per vehicle, coloured by speed.")
        blocks = [page.Block("lead", sentence), page.Block("lights", rows=tuple(cards)), picture]
        page.write_page(folder / "report.html", "One recording cannot tell what IDM lacks", blocks)
    return report
