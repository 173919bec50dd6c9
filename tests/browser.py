"""Headless Chromium for tests that look at pages: docs/check.py, which is no part of the package."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


def _loaded() -> ModuleType:
    spec = importlib.util.spec_from_file_location("idm_env_docs_check", ROOT / "docs" / "check.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


check = _loaded()


def there_is_one() -> bool:
    """Tell whether there is a browser; warn where there is none."""
    if check.browser() is None:
        warnings.warn("no Chromium here (apt-get install chromium): pages are not looked at", stacklevel=2)
    return check.browser() is not None


@pytest.fixture(scope="module")
def chromium() -> None:
    """Skip, loudly, where there is no browser."""
    if not there_is_one():
        pytest.skip("no Chromium")


def after(page: Path, script: str) -> str:
    """Return a page's text after a script has run at its end."""
    acted = page.with_name(f"acted-{page.name}")
    text = page.read_text(encoding="utf-8")
    acted.write_text(text.replace("</body>", f"<script>{script}</script></body>"), encoding="utf-8")
    command = [
        check.browser(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
        f"--user-data-dir={page.parent}/profile", "--virtual-time-budget=3000", "--dump-dom", acted.as_uri(),
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
