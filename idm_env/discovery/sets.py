"""``explain`` over one data set or over many: one folder of results each, and a table of all verdicts."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from idm_env.data import Trajectories
from idm_env.data.joined import names_of
from idm_env.data.pieces import cure, recordings
from idm_env.discovery.discover import discover
from idm_env.discovery.write import write_report
from idm_env.jobs import storage
from idm_env.jobs.executor import Executor, Serial
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.shards import Parts
from idm_env.reports import page, undecided
from idm_env.reports.undecided import EXPLAINED

SETS = ("sets.csv", "report.html")
"""What ``explain_sets`` writes beside the folders of the sets."""
COLUMNS = ("set", "verdict", "effects", "gap_rmse_before_m", "gap_rmse_after_m", "sentence", "folder")


@dataclass(frozen=True)
class Question:
    """How ``explain`` reads a file and what it looks for: see ``discover`` and ``data.load``."""

    by: str = "driver"
    effects: tuple[str, ...] | None = None
    known: tuple[str, ...] = ()
    seed: int = 0
    ring_length: float | None = None
    place: str | None = None
    layout: str = "auto"
    where: tuple[str, ...] | None = None
    base: str = "idm"
    columns: str | None = None
    split_s: float | None = None


def explain(
    path: Path, out: Path, question: Question, *, resume: bool = False, on_progress: OnProgress | None = None,
    trajectories: Trajectories | None = None,
) -> tuple[dict[str, Any], tuple[str, ...]]:  # fmt: skip
    """Explain one file, write the results, and return the report and the names of the models compared.

    ``trajectories`` are those of the file where they have been read before.
    """
    progress = on_progress or silent
    with storage.results(out, EXPLAINED, [path]):
        if trajectories is None:
            progress("reading", 0, 0, path.name)
            names = ("ring_length", "place", "layout", "columns", "where")
            how: dict[str, Any] = {name: getattr(question, name) for name in names}
            trajectories = recordings(path, seconds=question.split_s, **how)
        advice = cure(trajectories)
        if advice is not None:
            return undecided.write(trajectories, advice, out), ()
        request: dict[str, Any] = {name: getattr(question, name) for name in ("by", "effects", "known", "seed", "base")}
        discovery = discover(trajectories, out=out, resume=resume, on_progress=progress, **request)
        progress("writing the report", 0, 0, "")
        write_report(discovery, out)
    result: dict[str, Any] = json.loads((out / "report.json").read_text(encoding="utf-8"))
    return result, tuple(discovery.judgement.results)


@dataclass(frozen=True)
class _Set:
    """One data set, where its results go, and where it is marked as done."""

    number: int
    path: Path
    out: Path
    question: Question
    parts: Parts
    resume: bool
    asked: page.Asked

    def __str__(self) -> str:
        return self.path.name


def explain_sets(
    paths: Sequence[Path],
    out: Path,
    question: Question,
    *,
    resume: bool = False,
    executor: Executor | None = None,
    on_progress: OnProgress | None = None,
) -> list[dict[str, Any]]:
    """Explain every file by itself, into ``out/NAME``, and return one row per file, also written to ``sets.csv``.

    A file that cannot be used has its reason in its row; the others are done. No result depends on ``executor``.
    """
    progress, out = on_progress or silent, out.absolute()
    names = names_of(paths)
    with storage.results(out, SETS, paths):
        stamps = [(p, p.stat().st_size, p.stat().st_mtime_ns) if p.exists() else p for p in paths]
        parts = Parts(out / storage.UNFINISHED / "sets", storage.fingerprint(question, stamps), resume)
        command = page.ASKED.get()
        sets = []
        for n, (path, name) in enumerate(zip(paths, names, strict=True)):
            line = command._replace(files=(str(path),))
            sets += [_Set(n, path.absolute(), out / name, question, parts, resume, line)] * (not parts.done(n))
        done = len(paths) - len(sets)
        for _ in (executor or Serial()).map(_explain_set, sets, progress):
            done += 1
            progress("sets", done, len(paths), "")
        rows = parts.summaries()
        page.ASKED.set(command)
        storage.write_csv(out / "sets.csv", pl.DataFrame(rows, infer_schema_length=None).select(COLUMNS))
        template = Path(__file__).with_name("sets.html")
        page.write_page(out / "report.html", f"{len(rows)} data sets", template=template, sets=rows)
        parts.remove()
    return rows


def _explain_set(one: _Set, on_progress: OnProgress) -> None:
    page.ASKED.set(one.asked._replace(command="explain"))
    row: dict[str, Any] = dict.fromkeys(COLUMNS) | {"set": one.path.name, "folder": one.out.name}
    try:
        report, _ = explain(one.path, one.out, one.question, resume=one.resume, on_progress=on_progress)
    except ValueError as error:
        one.parts.finish(one.number, row | {"verdict": "not done", "effects": "", "sentence": str(error)})
        return
    before, after = report["error"]["before"], (report["partial"] or report["error"])["after"]
    row |= {"verdict": report["verdict"], "sentence": report["sentence"]}
    row |= {"effects": " ".join(finding["effect"] or finding["label"] for finding in report["found"])}
    ends = {"gap_rmse_before_m": before and before["gap_rmse_m"], "gap_rmse_after_m": after and after["gap_rmse_m"]}
    one.parts.finish(one.number, row | ends)
