"""Files in one piece, results that overwrite nothing of a user's, and work that can go on.

One mechanism for every command. ``write`` replaces a file only by a whole one. ``results`` guards a folder of results:
no output is an input, and nothing is overwritten that ``run.json`` there does not name as ours. ``Store`` holds what an
interrupted run goes on with, in a folder of our own that only its ``run.json`` makes removable. ``alone`` lets one job
at a time write to a folder. ``read`` turns whatever is wrong with a file into one line with a cure.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote

if TYPE_CHECKING:
    import polars as pl

MARK = "run.json"
"""The file that says what in a folder is ours."""
UNFINISHED = "idm-env-unfinished"
"""Folder in a folder of results in which interrupted runs leave what they go on with."""
AFRESH = "Leave out --resume to start afresh."
LOCK = ".idm-env-lock"
"""The file in a folder that a job holds while it writes there, and in which it says who it is."""
LOCK_SECONDS = 2.0
"""How long a folder may be held by somebody who is about to end (s)."""
FORMULA = r"^[=+\-@\t\r\n]"
"""What a cell begins with that a spreadsheet takes for a formula."""

_OWNER = "idm-env"
_PART = ".idm-env-part"
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
R = TypeVar("R")

# -- files -----------------------------------------------------------------------------------------------------------


def write(path: Path, writer: Callable[[Path], Any], *, shared: bool = False) -> None:
    """Let ``writer`` write a file; one of that name is replaced only by a whole one.

    ``shared``: others may write the same file at the same time, and the last whole one stays.
    OSError, in one line, where the disk is full; nothing is left of the file then.
    """
    mine = f"-{uuid.uuid4().hex}" if shared else ""
    part = path.with_name(f".{path.stem}{_PART}{mine}{path.suffix}")
    try:
        writer(part)
        os.replace(part, path)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        reason = full(error)
        if reason is None:
            raise
        raise OSError(f"{path} cannot be written: {reason}. Free space there and run again.") from None


def full(error: BaseException) -> str | None:
    """Return why nothing more can be written, or None; libraries in Rust tell the number of the error in words."""
    number = error.errno if isinstance(error, OSError) else None
    numbers = [n for n in _FULL if n == number or f"os error {n})" in str(error)]
    return os.strerror(numbers[0]) if numbers else None


def lacks_memory(error: BaseException) -> bool:
    """Return whether an error is a lack of memory: torch has no class for it on a CPU, and says so in words."""
    words = ("can't allocate memory", "out of memory")
    return isinstance(error, MemoryError) or any(word in str(error) for word in words)


def write_text(path: Path, content: str) -> None:
    """Write a text file in one piece."""
    write(path, lambda part: part.write_text(content, encoding="utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write JSON; NaN and infinities, which JSON does not have, become null."""
    write_text(path, json.dumps(plain(content), indent=1, ensure_ascii=False) + "\n")


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: NaN and infinities are null, numpy's arrays and numbers Python's.

    Of a dataclass the fields; one whose default is None is left out where it is None.
    """
    if is_dataclass(value) and not isinstance(value, type):
        items = [(f, getattr(value, f.name)) for f in fields(value)]
        return {f.name: plain(x) for f, x in items if x is not None or f.default is not None}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return value


def write_csv(path: Path, table: pl.DataFrame | pl.LazyFrame) -> None:
    """Write a table as csv in one piece: every csv of ours.

    A text that a spreadsheet would take for a formula, in a cell or as a column's name, gets an apostrophe in front;
    numbers stay numbers, also where they are texts.
    """
    import polars as pl

    rows = table.lazy()
    schema = rows.collect_schema()
    words = [name for name, kind in schema.items() if kind in (pl.String, pl.Categorical, pl.Enum)]
    for name in words:
        text = pl.col(name).cast(pl.String)
        formula = text.str.contains(FORMULA) & text.cast(pl.Float64, strict=False).is_null()
        rows = rows.with_columns(pl.when(formula).then("'" + text).otherwise(text).alias(name))
    rows = rows.rename({name: f"'{name}" for name in schema if re.match(FORMULA, name)})
    write(path, rows.sink_csv)


def read(path: Path, reader: Callable[[Path], R], cure: str) -> R:
    """Return the ``reader``'s result for a file of ours; ValueError with the cure, in one line, for a broken file."""
    try:
        return reader(path)
    except Exception as error:
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise ValueError(f"{path} is broken ({reason}). {cure}") from None


def fingerprint(*parts: object) -> str:
    """Return a digest of files (a path's bytes, where there is a file), arrays and tensors, and all else by repr."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path) and part.is_file():
            with part.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        elif hasattr(part, "detach"):
            digest.update(part.detach().cpu().numpy().tobytes())
        elif hasattr(part, "tobytes"):
            digest.update(part.tobytes())
        else:
            digest.update(repr(part).encode(errors="surrogateescape"))
        digest.update(b"\0")
    return digest.hexdigest()


# -- results ---------------------------------------------------------------------------------------------------------


def not_an_input(output: Path, inputs: Iterable[Path | str | None]) -> None:
    """Raise ValueError where an output is the same file as an input, through links too."""
    for source in inputs:
        if source is not None and output.exists() and Path(source).exists() and os.path.samefile(output, source):
            raise ValueError(f"{source} is an input, and {output} would overwrite it. Give --out another place.")


def refuse_unwritable(path: Path, option: str) -> None:
    """Raise ValueError where no file can be made at ``path``, which is tried; nothing of that is left."""
    new = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path.with_name(f".{path.name}{_PART}-try"), Path.touch)
        path.with_name(f".{path.name}{_PART}-try").unlink()
    except (OSError, ValueError) as error:
        if full(error):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{path} cannot be written ({reason}). Give {option} another place.") from None
    finally:
        for folder in new:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def results(out: str | Path, names: Sequence[str], inputs: Iterable[Path | str | None] = ()) -> Iterator[Path]:
    """Give ``out`` as a folder that exists, into which the files ``names`` may be written while this lasts.

    ValueError, before anything is written, if ``out`` is a file, an output is an input, an input is part of what an
    interrupted run left, or a file of such a name was not written by us or was changed since.
    """
    folder, inputs = Path(out), list(inputs)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file. Give --out a folder.")
    left = _real(folder / UNFINISHED)
    for source in inputs:
        if source is not None and _real(source).is_relative_to(left):
            raise ValueError(f"{source} belongs to an interrupted run, which removes it at its end. Copy it elsewhere.")
        if source is not None and Path(source).is_dir() and _real(folder).is_relative_to(_real(source)):
            raise ValueError(f"{folder} lies in {source}, whose files are all read. Give --out a folder elsewhere.")
    for name in names:
        not_an_input(folder / name, inputs)
    with hold_folder(folder):
        mark = _mark(folder)
        if mark is None and os.path.lexists(folder / MARK):
            raise ValueError(f"{folder / MARK} is not one of {_OWNER}'s. Move it, or give --out another folder.")
        ours: dict[str, str | None] = dict((mark or {}).get("files", {}))
        for name in names:
            path = folder / name
            if os.path.lexists(path) and not (
                name in ours and path.is_file() and ours[name] in (None, fingerprint(path))
            ):
                reason = f"was changed since {_OWNER} wrote it" if name in ours else f"was not written by {_OWNER}"
                raise ValueError(f"{path} {reason}. Move it, or give --out another folder.")
        # No digest: being written. Whoever is killed leaves files that the next run may replace.
        _sign(folder, files={**ours, **dict.fromkeys(names)})
        try:
            yield folder
        finally:
            now = {name: fingerprint(folder / name) for name in names if (folder / name).is_file()}
            files = {name: value for name, value in ours.items() if name not in names} | now
            if files:
                _sign(folder, files=files)
            else:
                (folder / MARK).unlink(missing_ok=True)


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Hold a folder, which is made if missing, while this lasts; whoever holds it may do so again.

    The system lets go of the lock when its process ends, however that ends. Where there are no locks nothing is held.

    Raises:
        ValueError: If another job holds it, with its process, machine and beginning; and if it cannot be made.
    """
    new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if full(error):
            raise
        raise ValueError(f"{folder} cannot be made ({error.strerror}). Give --out another folder.") from None
    place, me = _real(folder), (os.getpid(), threading.get_ident())
    if _holders.get(place) == me:
        yield
        return
    lock = _locked(folder)
    _holders[place] = me
    try:
        yield
    finally:
        del _holders[place]
        if lock is not None:
            with suppress(OSError):
                (folder / LOCK).unlink()
            os.close(lock)
        if new:
            with suppress(OSError):  # a refusal leaves nothing behind, and what was written stays
                folder.rmdir()


_holders: dict[Path, tuple[int, int]] = {}


def _locked(folder: Path) -> int | None:
    """Return the open lock of a folder, or None where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    path, until = folder / LOCK, time.monotonic() + LOCK_SECONDS
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):  # removed by who held it: the next file of that name is another
                if os.path.samestat(os.fstat(lock), os.stat(path)):
                    with suppress(OSError):  # a full disk
                        os.ftruncate(lock, 0)
                        holder = f"process {os.getpid()} on {socket.gethostname()}, since {time.ctime()}"
                        os.write(lock, holder.encode())
                    return lock
            os.close(lock)
        except BlockingIOError:
            holder = os.pread(lock, 200, 0).decode(errors="replace") or "another process"
            os.close(lock)
            if time.monotonic() > until:
                raise ValueError(
                    f"{folder} is being written to by {holder}. Wait for its end, or give --out another folder."
                ) from None
            time.sleep(0.1)
        except OSError:  # a file system without locks
            os.close(lock)
            return None


def _real(path: Path | str) -> Path:
    """Return a path without links; ``Path.resolve`` has no answer where one leads to itself."""
    return Path(os.path.realpath(path))


def _mark(folder: Path) -> dict[str, Any] | None:
    """Return the content of a folder's ``run.json``, or None where it is none of ours."""
    try:
        mark = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    ours = isinstance(mark, dict) and mark.get("written_by") == _OWNER and isinstance(mark.get("files", {}), dict)
    return mark if ours else None


def _sign(folder: Path, **content: Any) -> None:
    write_text(folder / MARK, json.dumps({"written_by": _OWNER, **content}, indent=1) + "\n")


# -- unfinished work -------------------------------------------------------------------------------------------------


class Store:
    """Saved state of an interrupted run: contents by key, and files of the run's own under ``folder``.

    The folder belongs to one run, told by the fingerprint of its data and options in its ``run.json``. Without
    ``resume`` it is emptied, but only if that ``run.json`` is a store's, and nothing on the way there is a link.
    ``folder`` None keeps everything in memory only.

    Raises:
        ValueError: In one line, for a folder of another run, one that is not ours, and broken files.
    """

    def __init__(self, folder: Path | None, run: str, resume: bool) -> None:
        self.folder = folder
        self._memory: dict[str, bytes] = {}
        if folder is None:
            return
        _refuse_links(folder)
        if folder.is_dir() and any(_PART not in path.name for path in folder.iterdir()):
            mark = _mark(folder)
            if mark is None or not isinstance(mark.get("fingerprint"), str):
                raise ValueError(
                    f"{folder / MARK} is broken or missing, so that nothing there is known to be {_OWNER}'s. Delete "
                    f"{folder} to start afresh, or give --out another folder."
                )
            if resume:
                if mark.get("fingerprint") != run:
                    raise ValueError(f"{folder} was left by a run on other data or options. {AFRESH}")
                return
            _remove(folder)
        folder.mkdir(parents=True, exist_ok=True)
        _sign(folder, fingerprint=run)

    def put(self, key: str, content: Any) -> None:
        """Keep tensors and plain values, nested in mappings and lists."""
        import torch

        buffer = io.BytesIO()
        torch.save(content, buffer)
        self._put(key, buffer.getvalue())

    def get(self, key: str) -> Any:
        """Return the content that ``put`` saved, or None."""
        import torch

        return self._get(key, lambda content: torch.load(io.BytesIO(content), weights_only=True))

    def put_json(self, key: str, content: Any) -> None:
        """Keep plain values."""
        self._put(key, json.dumps(content).encode())

    def get_json(self, key: str) -> Any:
        """Return the content that ``put_json`` saved, or None."""
        return self._get(key, json.loads)

    def saved_names(self) -> list[str]:
        """Return the names under which contents are kept, sorted."""
        if self.folder is None:
            return sorted(self._memory)
        return sorted(p.stem for p in self.folder.glob("*.kept") if _PART not in p.name)

    def remove(self) -> None:
        """Remove everything: the run has ended."""
        if self.folder is not None and "fingerprint" in (_mark(self.folder) or {}):
            _refuse_links(self.folder)
            _remove(self.folder)
            if self.folder.parent.name == UNFINISHED:
                with suppress(OSError):  # another command has left something there
                    self.folder.parent.rmdir()

    def _put(self, key: str, content: bytes) -> None:
        key = quote(key, safe="")
        if self.folder is None:
            self._memory[key] = content
        else:
            sealed = hashlib.sha256(content).digest() + content
            write(self.folder / f"{key}.kept", lambda part: part.write_bytes(sealed), shared=True)

    def _get(self, key: str, reader: Callable[[bytes], Any]) -> Any:
        key = quote(key, safe="")
        if self.folder is None:
            return reader(self._memory[key]) if key in self._memory else None
        path = self.folder / f"{key}.kept"
        return read(path, lambda p: reader(_unsealed(p)), AFRESH) if path.exists() else None


def _refuse_links(folder: Path) -> None:
    """Raise ValueError where a store's folder, one in it, or the one of unfinished work around it, is a link."""
    around = [folder.parent] if folder.parent.name == UNFINISHED else []
    for path in [*around, folder, *(folder.iterdir() if folder.is_dir() and not folder.is_symlink() else ())]:
        if path.is_symlink():
            raise ValueError(f"{path} is a link, and what it leads to is nobody's to remove. Remove the link.")


def _remove(folder: Path) -> None:
    """Delete a folder of ours; its ownership marker goes last, so an interrupted deletion can be resumed."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != MARK:
            path.unlink()
    shutil.rmtree(folder)


def _unsealed(path: Path) -> bytes:
    """Return the content of a file that begins with the content's digest."""
    sealed = path.read_bytes()
    if hashlib.sha256(sealed[32:]).digest() != sealed[:32]:
        raise ValueError(f"its {len(sealed)} bytes are not what was written")
    return sealed[32:]
