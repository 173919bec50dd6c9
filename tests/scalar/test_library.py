"""Printed texts and machine code: written once, taken by content, healed where damaged, kept from others."""

import logging
import os
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

from idm_env.compiled.scalar import library

TEXT = """
from numba import carray, types

from idm_env.compiled.kernels.compiler import compiler, phase


@compiler()
def looped(x):
    return 2 * x + {added}


@phase(types.int64(types.int64))
def called(x):
    return 3 * x + {added}
"""
DAMAGE = {
    "cut": lambda kept: kept[: len(kept) // 2],
    "empty": lambda kept: b"",
    "zeros": lambda kept: bytes(len(kept)),
    "one bit": lambda kept: kept[:-9] + bytes([kept[-9] ^ 1]) + kept[-8:],
    "text": lambda kept: b"import os; os.system('false')\n",
}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of one's own, for as long as a test lasts."""
    monkeypatch.setenv("IDM_ENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    for cached in (library._serving, library.announce):
        cached.cache_clear()
    yield tmp_path / "cache"
    for cached in (library._serving, library.announce):
        cached.cache_clear()


def values(added=1):
    """Return what a printed loop and a printed phase give in a process that has not met them."""
    import ctypes

    made = library.load("tried", TEXT.format(added=added))
    del sys.modules[made.__name__]
    return made.looped(5), ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(made.called.address)(5)


def content(folder):
    """Return the names and texts of what is kept; machine code of one text may differ in its order of symbols."""
    return {p.name: p.read_bytes() if p.suffix == ".py" else b"" for p in folder.iterdir()}


def test_what_was_not_met_before_is_announced_once(cache, caplog):
    assert values() == (11, 16)
    assert values(2) == (12, 17)
    assert len(caplog.records) == 1 and str(cache) in caplog.text
    before = {p: p.stat().st_mtime_ns for p in cache.iterdir()}
    library.announce.cache_clear()
    assert values() == (11, 16)
    assert {p: p.stat().st_mtime_ns for p in cache.iterdir()} == before  # taken, and nothing said
    assert len(caplog.records) == 1 and sorted(p.suffix for p in before) == [".nbc"] * 4 + [".py"] * 2


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", ["looped-*.nbc", "called-*.nbc", "*.py"])
def test_a_damaged_file_heals_in_one_line(cache, caplog, kind, damage):
    assert values() == (11, 16)
    before = content(cache)
    (path,) = cache.glob(kind)
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    caplog.clear()
    assert values() == (11, 16)
    assert [r.getMessage().startswith(f"{path} is damaged (") for r in caplog.records] == [True]
    assert "\n" not in caplog.records[0].getMessage() and content(cache) == before
    caplog.clear()
    assert values() == (11, 16) and not caplog.records


def test_a_changed_expression_or_a_line_of_somebody_else_in_a_printed_file_is_not_run(cache, tmp_path):
    """The file of a printed text is to be read by people: its name, and what it holds, decide nothing."""
    values()
    (path,) = cache.glob("*.py")
    path.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n" + path.read_text().replace("2 * x", "7 * x"))
    assert values() == (11, 16) and not (tmp_path / "ran").exists() and "7 * x" not in path.read_text()


def test_machine_code_that_cannot_be_kept_is_compiled_each_time(cache, monkeypatch):
    def full(*given, **more):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(library.os, "fdopen", full)
    assert values() == values() == (11, 16)
    assert not list(cache.iterdir())


def opened_to_all(place):
    place.chmod(0o777)


def opened_to_the_group(place):
    place.chmod(0o770)


def lies_where_others_may_put_another(place):
    place.parent.chmod(0o777)


def belongs_to_another(place):
    if os.getuid() != 0:
        pytest.skip("only root gives files away")
    os.chown(place, 12345, 12345)


@pytest.mark.parametrize(
    "spoil", [opened_to_all, opened_to_the_group, lies_where_others_may_put_another, belongs_to_another]
)
@pytest.mark.parametrize("variable", ["IDM_ENV_CACHE", "NUMBA_CACHE_DIR"])
def test_a_cache_that_others_may_write_to_is_left_alone(tmp_path, cache, monkeypatch, caplog, spoil, variable):
    place = tmp_path / "shared" / "cache"
    place.mkdir(parents=True)
    spoil(place)
    monkeypatch.setenv(variable, str(place))
    assert values() == (11, 16)
    assert not list(place.iterdir())
    warned = [r.getMessage() for r in caplog.records if str(place) in r.getMessage() and r.levelno == logging.WARNING]
    assert len(warned) == 1 and ("Run: chmod go-w" in warned[0] or "of your own" in warned[0])


def test_folders_that_are_made_serve_whatever_the_umask(tmp_path, cache, monkeypatch):
    monkeypatch.setenv("IDM_ENV_CACHE", str(tmp_path / "new" / "cache"))
    before = os.umask(0)
    try:
        assert library.folder() == tmp_path / "new" / "cache"
    finally:
        os.umask(before)


def test_folders_below_a_sticky_one_serve(tmp_path):
    (tmp_path / "own").mkdir()
    tmp_path.chmod(0o1777)
    assert library.exposed(tmp_path / "own") is None


def test_where_no_folder_serves_nothing_is_kept_and_nothing_left(tmp_path, cache, monkeypatch):
    """Each process left a temporary folder of its own."""
    (tmp_path / "file").write_text("")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("IDM_ENV_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(library.tempfile, "tempdir", None)
    assert values() == (11, 16)
    assert not list(temporary.iterdir()) and library.folder() is None


def test_all_that_is_compiled_is_kept_in_one_way():
    """Loops of kernels and of records alike: none has a cache of numba's own."""
    import importlib

    import numba

    from idm_env import compat

    package = Path(library.__file__).parents[2]
    found = set()
    for path in sorted(package.rglob("*.py")):
        if "kernels.compiler" not in path.read_text() and "compiled" not in path.read_text():
            continue
        name = ".".join(("idm_env", *path.relative_to(package).with_suffix("").parts)).removesuffix(".__init__")
        for each in vars(importlib.import_module(name)).values():
            if isinstance(each, numba.core.registry.CPUDispatcher):
                assert isinstance(each._cache, compat._KeptCode), f"{name}.{each.__name__}"
                found.add(each.__module__.split(".")[2])
    assert {"kernels", "records"} <= found
