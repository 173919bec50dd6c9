"""The publications that effects are taken from, by name and year, as ``idm-env effects --cite`` prints them."""

import json
from pathlib import Path

PUBLICATIONS: dict[str, str] = json.loads(Path(__file__).with_name("references.json").read_text(encoding="utf-8"))
