"""Printed files: written once, imported once, and said once."""

import sys

from idm_env.scalar import library


def test_what_was_not_met_before_is_announced_once(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(library, "folder", lambda: tmp_path)
    library.announce.cache_clear()
    made = library.load("words", "x = 1\n")
    assert made.x == 1 and str(tmp_path) in caplog.text and len(caplog.records) == 1
    assert library.load("words", "x = 2\n").x == 2 and len(caplog.records) == 1
    # Another process finds the file, and has nothing to say.
    del sys.modules[made.__name__]
    library.announce.cache_clear()
    again = library.load("words", "x = 1\n")
    assert again is not made and again.x == 1 and len(caplog.records) == 1
    assert len(list(tmp_path.glob("*.py"))) == 2
