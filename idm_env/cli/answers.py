"""Printed results of commands: tables on stdout, sentences on stderr."""

import os
from pathlib import Path
from typing import Any

from idm_env.extras import needed

with needed("the command line"):
    import typer
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

# A path, a column or a sentence may have brackets and colons in it: nothing is markup.
PLAIN: dict[str, Any] = {"markup": False, "emoji": False}
console = Console(stderr=True, **PLAIN)


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Print rows as a table on stdout; the names of columns are those of the first row."""
    from idm_env.reports.page import number

    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        side: Any = "left" if isinstance(rows[0][name], str) else "right"
        table.add_column(name.replace("_", " "), overflow="fold", justify=side)
    for row in rows:
        table.add_row(*("–" if v is None else number(v) if isinstance(v, float) else str(v) for v in row.values()))
    Console(**PLAIN).print(table)


def filtered(result: dict[str, Any]) -> None:
    """Print the errors of a filter or a reconstruction beside those of other methods."""
    from idm_env.trajectories.report import methods, points

    if rows := result["left_out_points"]:
        show(f"{rows[0]['points']} points of the file that were left out", points(rows))
    show("Methods on these data", methods(result["methods"]))


def _account(result: dict[str, Any]) -> str:
    from idm_env.data import Repair
    from idm_env.reports.page import account

    return account(Repair(**each) for each in result["data"]["repairs"])


def undecided(result: dict[str, Any], out: Path) -> None:
    """Say why nothing can be told."""
    console.print(Text.assemble("Verdict: ", ("cannot tell", "bold"), f". {result['sentence']}"), soft_wrap=True)
    finished(out, _account(result))


def explained(result: dict[str, Any], models: tuple[str, ...], out: Path) -> None:
    """Print the findings of ``explain`` and the errors on held-out runs before and after."""
    if not result["models"]:
        undecided(result, out)
        return
    from idm_env.discovery.result import Ceilings
    from idm_env.discovery.rolled import Rolled
    from idm_env.discovery.words import ceilings, error_rows, rolled
    from idm_env.reports.undecided import FOUND

    console.print(Text.assemble("Verdict: ", (result["verdict"].replace("_", " "), "bold"), ". "), end="")
    console.print(result["sentence"], soft_wrap=True, highlight=False)
    before = result["error"]["before"]
    if before is not None:
        show("Errors on held-out runs", error_rows(result, models))
    for name, state, text in rolled({file: Rolled(**figures) for file, figures in result["rolled"].items()}):
        console.print(f"{name}: {text}", style="bold red" if state else "", highlight=False)
    if before is not None:
        limits = ceilings(Ceilings(**result["ceilings"]), before["gap_rmse_m"], result["error"]["floor"]["gap_rmse_m"])
        console.print(f"What could be explained at all: {limits}", style="dim", highlight=False)
    files = sorted(result["models"].items(), key=lambda item: item[0] != "model.yaml")
    best = ", what the verdict says" if len(files) > 1 else ""
    words = (f"{file} is {name}{best if not i else ''}" for i, (file, name) in enumerate(files))
    console.print("; ".join(words), highlight=False)
    if (out / FOUND).is_file():
        console.print(f"{FOUND} is the shape as an effect, to be used and changed", highlight=False)
    finished(out, _account(result))


def citations(effects: dict[str, Any]) -> list[str]:
    """Return every publication once, with the effects that are taken from it, and which effects name none."""
    by_source: dict[str, list[str]] = {}
    for name, cls in effects.items():
        for source in cls.sources:
            by_source.setdefault(source, []).append(name)
    bare = [name for name, cls in effects.items() if not cls.sources]
    lines = [f"{source} [{', '.join(names)}]" for source, names in sorted(by_source.items())]
    return [*lines, *([f"Without a publication of their own: {', '.join(bare)}."] if bare else [])]


def end_failed(why: str) -> None:
    """End with code 1 and one red line where work ended with nothing to rely on."""
    if why:
        console.print(Text(f"error: {why}", style="bold red"), soft_wrap=True)
        raise typer.Exit(1)


def show_path(word: str, path: Path) -> None:
    """Say where a file lies, in full."""
    console.print(Text.assemble(f"{word}: ", (os.path.realpath(path), "bold")), soft_wrap=True)


def finished(out: Path, account: str) -> None:
    """Print the account of the data and the path of the report."""
    console.print(account, soft_wrap=True, highlight=False)
    show_path("Report", out / "report.html")
