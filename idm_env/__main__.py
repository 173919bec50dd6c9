"""``python -m idm_env`` and the command ``idm-env``."""

import signal
import sys

from idm_env.cli import end_at_once


def main() -> None:
    """Run the command line; without its extra, say in one line what to install."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)  # ``cli`` takes over when work begins
    try:
        from idm_env.cli.commands import run
    except ImportError as error:
        sys.exit(f"error: {error}")
    run()


if __name__ == "__main__":
    main()
