"""Elements of SUMO's XML files, one at a time, with errors that name the element in one line."""

import gzip
import os
import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from idm_env import validation


def elements(path: Path, roots: tuple[str, ...]) -> Iterator[Element]:
    """Yield the elements directly below the root of a file, ``.gz`` too; each is emptied after its turn.

    ValueError for a file that is missing, is no XML, or has another root.
    """
    if not os.path.isfile(path):
        raise ValueError(f"{str(path)[-200:]!r} is no file. Give the path of an XML file of SUMO.")
    opener = gzip.open if path.suffix == ".gz" else open
    cure = f"Give a file with <{'> or <'.join(roots)}>, as SUMO's tools write it."
    try:
        with opener(path, "rb") as file:
            depth, root = 0, Element("")
            for event, element in ElementTree.iterparse(file, ("start", "end")):
                depth += 1 if event == "start" else -1
                if event == "start" and depth == 1:
                    root = element
                    if root.tag not in roots:
                        raise ValueError(f"{path.name} begins with <{validation.shown(root.tag)[1:-1]}>. {cure}")
                elif event == "end" and depth == 1:
                    yield element
                    root.clear()
    except (ElementTree.ParseError, EOFError, zlib.error, gzip.BadGzipFile, LookupError) as error:
        raise ValueError(f"{path.name} is no whole XML ({' '.join(str(error).split())}). {cure}") from None


def name(element: Element) -> str:
    """Return a short form of an element for errors: its tag, and its id or its ends."""
    keys = ("id",) if "id" in element.attrib else ("from", "to", "index", "edges")
    words = " ".join(f'{key}="{element.get(key, "")[:60]}"' for key in keys if key in element.attrib)
    return f"<{element.tag} {words}>".replace(" >", ">")


def text(element: Element, key: str) -> str:
    """Return an attribute; ValueError where the element lacks it."""
    value = element.get(key)
    if value is None:
        raise ValueError(f"{name(element)} has no {key}. Write the file again with SUMO's tools.")
    return value


def number(element: Element, key: str, default: float | None = None, low: float = -1e12, above: bool = False) -> float:
    """Return an attribute as a number of at least ``low``, or ``above`` it; ValueError for any other."""
    if default is not None and key not in element.attrib:
        return default
    return parsed(text(element, key), element, key, low, above)


def parsed(value: str, element: Element, key: str, low: float, above: bool = False) -> float:
    """Return a word of an attribute as ``number`` returns the whole of it; ValueError as there."""
    with suppress(ValueError):
        if low <= (x := float(value)) < 1e12 and not (above and x == low):
            return x
    rule = "" if low < -1e11 else f" {'above' if above else 'of at least'} {low:g}"
    raise ValueError(f"{name(element)}: {key} = {validation.shown(value)} must be a number{rule}.")


def seconds(element: Element, key: str, default: float | None = None) -> float:
    """Return a time from 0 on (s), of seconds or ``[days:]hours:minutes:seconds``; ValueError for any other."""
    value = element.get(key, "")
    if not re.fullmatch(r"(\d+:)?\d+:\d+:\d+(\.\d*)?", value):
        return number(element, key, default, 0.0)
    parts = zip(reversed(value.split(":")), (1.0, 60.0, 3600.0, 86400.0), strict=False)
    return sum(factor * float(part) for part, factor in parts)
