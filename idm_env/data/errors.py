"""Errors of the data package, and the repairs that it counts."""

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field


class DataError(ValueError):
    """A file that cannot be used: one line that names the value, the rule and the cure."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


@dataclass(frozen=True)
class Repair:
    """One thing that was changed or left out, with how often.

    Attributes:
        kind: A short name, the same in every report, such as ``"duplicated time"``.
        count: How many rows, tracks or vehicles (`text` says which).
        text: One sentence for a reader.
    """

    kind: str
    count: int
    text: str

    def __str__(self) -> str:
        return self.text


def repaired(kind: str, count: int, words: str) -> list[Repair]:
    """Return the repair of so many, told by their number and ``words``; nothing where there are none."""
    return [Repair(kind, count, f"{count} {words}")] if count else []


@dataclass
class Counted:
    """Repairs by kind and wording, added up over the pieces of a file."""

    found: dict[tuple[str, str], int] = field(default_factory=dict)

    def add(self, repairs: Sequence[Repair]) -> None:
        """Count repairs; a number at the beginning of a text is added up."""
        for repair in repairs:
            text = repair.text.removeprefix(f"{repair.count} ")
            key = repair.kind, ("# " if text != repair.text else "") + text
            again = key in self.found and not text.startswith("#") and text == repair.text
            self.found[key] = repair.count if again else self.found.get(key, 0) + repair.count

    def repairs(self) -> tuple[Repair, ...]:
        """Return the repairs with their sums."""
        return tuple(Repair(kind, n, text.replace("# ", f"{n} ", 1)) for (kind, text), n in self.found.items())


def nearest(name: str, names: Iterable[str], cutoff: float = 0.5) -> str | None:
    """Return the most similar of `names`, ignoring case, or None if none is similar."""
    by_lower = {other.lower(): other for other in names}
    matches = difflib.get_close_matches(name.lower(), list(by_lower), n=1, cutoff=cutoff)
    return by_lower[matches[0]] if matches else None


def listed(names: Iterable[str], most: int = 12) -> str:
    """Return names as one comma-separated phrase, cut after `most` of them."""
    all_names = [str(name) for name in names]
    shown = ", ".join(all_names[:most])
    return shown if len(all_names) <= most else f"{shown} and {len(all_names) - most} more"


def refuse_missing(names: Iterable[str], columns: Iterable[str], source: str) -> None:
    """Raise DataError for the first of the names that is no column."""
    if absent := [name for name in names if name not in columns]:
        raise missing_column(absent[0], columns, source)


def missing_column(name: str, columns: Iterable[str], source: str, others: Iterable[str] = ()) -> DataError:
    """Return the error for a column that a file lacks, suggesting the nearest name that is none of `others`."""
    names = list(columns)
    guess = nearest(name, set(names) - set(others))
    cure = f"did you mean {guess!r}? Rename it." if guess else f"the file has: {listed(names)}."
    return DataError(f"{source}: column {name!r} is missing; {cure}")
