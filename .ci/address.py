"""Write the project's public address wherever one belongs: ``python .ci/address.py https://github.com/OWNER/NAME``.

None is known yet. CITATION.cff's ``repository-code`` is the one that counts; ``tests/test_wheel.py`` compares others.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

BADGE = "[![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)]({link})"
NOTEBOOK = "examples/first_hour.ipynb"


def addresses(root: Path) -> dict[str, str | None]:
    """Return the address that every file states, None where it states none."""
    notebook = " ".join("".join(cell["source"]) for cell in json.loads((root / NOTEBOOK).read_text("utf-8"))["cells"])
    wanted = {
        "CITATION.cff": r'^repository-code: "(.*)"$',
        "pyproject.toml": r'^Repository = "(.*)"$',
        "conda/recipe.yaml": r"^  repository: (.*)$",
    }
    found = {file: re.search(what, (root / file).read_text("utf-8"), re.MULTILINE) for file, what in wanted.items()}
    for file, text in (("README.md", (root / "README.md").read_text("utf-8")), (NOTEBOOK, notebook)):
        found[file] = re.search(r"colab\.research\.google\.com/(github/\S+)/blob/main/", text)
    return {
        file: None
        if m is None
        else m[1].replace("github/", "https://github.com/", 1)
        if m[1][:7] == "github/"
        else m[1]
        for file, m in found.items()
    }


def write(root: Path, address: str) -> None:
    """Write an address into files that state none. ValueError for what is no address of a repository on GitHub."""
    owned = re.fullmatch(r"https://github\.com/([\w.-]+/[\w.-]+)", address)
    if not owned:
        raise ValueError(f"{address} is no https://github.com/OWNER/NAME. Give the repository's address.")
    badge = BADGE.format(link=f"https://colab.research.google.com/github/{owned[1]}/blob/main/{NOTEBOOK}")
    urls = {
        "Repository": "",
        "Documentation": "/tree/main/docs",
        "Changelog": "/blob/main/CHANGELOG.md",
        "Issues": "/issues",
    }
    table = "".join(f'{name} = "{address}{end}"\n' for name, end in urls.items())
    for file, before, after in (
        ("CITATION.cff", "license: MIT\n", f'license: MIT\nrepository-code: "{address}"\n'),
        (
            "pyproject.toml",
            "[project.optional-dependencies]",
            f"[project.urls]\n{table}\n[project.optional-dependencies]",
        ),
        ("conda/recipe.yaml", "about:\n", f"about:\n  repository: {address}\n"),
        ("README.md", "# idm_env\n", f"# idm_env\n\n{badge}\n"),
    ):
        text = (root / file).read_text("utf-8")
        (root / file).write_text(text.replace(before, after, 1), "utf-8")
    notebook = json.loads((root / NOTEBOOK).read_text("utf-8"))
    notebook["cells"][0]["source"] = ["# The first hour\n", "\n", f"{badge}\n", *notebook["cells"][0]["source"][1:]]
    code = "".join(notebook["cells"][1]["source"]).replace(
        'wheel = next(Path.cwd().glob("idm_env-*.whl"))', f'source = "git+{address}"'
    ).replace('f"{wheel}[data,kernels]"', 'f"idm-env[data,kernels] @ {source}"')  # fmt: skip
    notebook["cells"][1]["source"] = code.splitlines(keepends=True)
    (root / NOTEBOOK).write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    write(Path(__file__).resolve().parents[1], sys.argv[1])
