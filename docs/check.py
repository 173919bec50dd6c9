"""Opens pages in headless Chromium, wide and narrow, and says what is wrong: ``python docs/check.py PAGE …``.

A harness page shows every page in a frame of 1100 and of 400 pixels and measures it. Wrong is: an error in the console,
anything asked of the network, and a page that is wider than its window.
"""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

WIDTHS = (1100, 400)
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
HARNESS = """<!doctype html><meta charset="utf-8"><title>pages</title><body><pre id="found"></pre><script>
const pages = PAGES, widths = WIDTHS, found = [];
function look(page, width) {
  return new Promise(done => {
    const frame = document.createElement("iframe");
    frame.style.cssText = `border:0;height:900px;width:${width}px`;
    frame.onload = () => setTimeout(() => {
      const shown = frame.contentDocument, root = shown.documentElement;
      const asked = frame.contentWindow.performance.getEntriesByType("resource").map(e => e.name);
      found.push({page, width, scroll: root.scrollWidth, body: shown.body ? shown.body.scrollWidth : 0,
                  text: shown.body ? shown.body.innerText.length : 0,
                  asked: asked.filter(n => /^(https?|wss?|ftp):/.test(n))});
      frame.remove(); done();
    }, 300);
    frame.src = page; document.body.appendChild(frame);
  });
}
(async () => { for (const page of pages) for (const width of widths) await look(page, width);
  document.getElementById("found").textContent = "FOUND" + JSON.stringify(found) + "END"; })();
</script></body>"""


def browser() -> str | None:
    """Return the browser of this machine, if any."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def wrong(pages: Sequence[Path]) -> list[str]:
    """Return what is wrong with pages, one line each. RuntimeError if the browser shows nothing."""
    program = browser()
    if program is None:
        raise RuntimeError("no Chromium here. Install it with: apt-get install chromium")
    with tempfile.TemporaryDirectory() as place:
        harness = Path(place) / "harness.html"
        addresses = json.dumps([page.resolve().as_uri() for page in pages])
        text = HARNESS.replace("PAGES", addresses).replace("WIDTHS", json.dumps(WIDTHS))
        harness.write_text(text, encoding="utf-8")
        command = [
            program, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--allow-file-access-from-files", "--host-resolver-rules=MAP * ~NOTFOUND",
            "--disable-background-networking", "--enable-logging=stderr",
            f"--user-data-dir={place}/profile", "--window-size=1200,1000",
            f"--virtual-time-budget={4000 + 2000 * len(pages) * len(WIDTHS)}", "--dump-dom", harness.as_uri(),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    shown = re.search(r"FOUND(\[.*?\])END", html.unescape(done.stdout), re.DOTALL)
    if shown is None:
        raise RuntimeError(f"{program} showed nothing: {done.stderr[-300:]}")
    found = _console(done.stderr)
    for one in json.loads(shown[1]):
        name = Path(unquote(one["page"])).name
        if max(one["scroll"], one["body"]) > one["width"] + 1:
            found.append(f"{name} is {max(one['scroll'], one['body'])} px wide in a window of {one['width']} px")
        found += [f"{name} asks the network for {address}" for address in one["asked"]]
        if not one["text"]:
            found.append(f"{name} is empty at {one['width']} px")
    return sorted(set(found))


def _console(log: str) -> list[str]:
    """Return errors that pages wrote to the console."""
    lines = [line for line in log.splitlines() if "CONSOLE" in line]
    return [line.split("CONSOLE", 1)[1] for line in lines if re.search(r"Uncaught|Error|error|Failed|Refused", line)]


class _Links(HTMLParser):
    """Collects addresses and anchors of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note where a tag leads, and what leads to it."""
        given = dict(attrs)
        for name in ("href", "src"):
            if given.get(name):
                self.links.append(str(given[name]))
        self.anchors |= {str(given[n]) for n in ("id", "name") if given.get(n)}


def dead(site: Path) -> list[str]:
    """Return links within a site that lead nowhere, and whatever a page loads from the network, one line each."""
    pages = {}
    for path in sorted(site.rglob("*.html")):
        pages[path.resolve()] = _Links()
        pages[path.resolve()].feed(path.read_text(encoding="utf-8"))
    found = []
    for path, page in pages.items():
        for link in page.links:
            if re.match(r"(https?:|mailto:|data:|javascript:)", link):
                continue
            address, anchor = urldefrag(link)
            target = (path.parent / unquote(address.split("?")[0])).resolve() if address else path
            if target.is_dir():
                target = target / "index.html"
            if not target.exists():
                found.append(f"{path.relative_to(site.resolve())} leads to {link}, which is not there")
            elif anchor and target in pages and unquote(anchor) not in pages[target].anchors:
                found.append(f"{path.relative_to(site.resolve())} leads to {link}, which has no such place")
    return found


if __name__ == "__main__":
    told = wrong([Path(name) for name in sys.argv[1:]])
    print("\n".join(told) or "nothing is wrong")
    sys.exit(bool(told))
