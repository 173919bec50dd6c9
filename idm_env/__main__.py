"""``python -m idm_env`` and the command ``idm-env``."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; without its extra, say in one line what to install."""
    try:
        from idm_env.cli.commands import run
    except ImportError as error:
        sys.exit(f"error: {error}")
    run()


if __name__ == "__main__":
    main()
