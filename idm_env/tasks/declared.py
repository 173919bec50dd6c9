"""One of a catalogue: a name of it, an object of one's own, or the place of one in a file that is trusted."""

from collections.abc import Mapping
from typing import TypeVar

from idm_env.effects import registry
from idm_env.jobs import trust
from idm_env.validation import nearest, shown

T = TypeVar("T")


def one_declared(entry: object, kind: type[T], known: Mapping[str, T], where: str) -> T:
    """Resolve an entry: an instance of ``kind``, a name of the catalogue, or ``file.py:name``.

    ValueError, in one line, for an unknown name, and for the place of code that is not trusted or has no such thing.
    """
    if isinstance(entry, kind):
        return entry
    if not isinstance(entry, str) or ":" not in entry:
        if isinstance(entry, str) and entry in known:
            return known[entry]
        raise ValueError(f"{where}: {shown(entry)} is unknown.{nearest(str(entry), known)}")
    place = entry.rpartition(":")[0]
    if registry.module_at(place) is None and not trust.permission():
        raise ValueError(
            f"{where}: {shown(entry)} is code of {shown(place)}, which is not run unasked. Read it, then give --trust, "
            f"trusted=True in Python, or {trust.VARIABLE}=1."
        )
    member = registry.member(entry, where)[1]
    if not isinstance(member, kind):
        raise ValueError(f"{where}: {shown(entry)} is no {kind.__name__}. Name one that the file declares.")
    return member
