"""The command line: commands, refusals before anything slow is imported, and a check of this machine."""

import os


def end_at_once(number: int, frame: object) -> None:
    """Handle SIGINT while imports run: end with one line and code 130."""
    shown = b"\x1b[?25h" if os.isatty(2) else b""  # bars hide the cursor
    os.write(2, shown + b"interrupted.\n")
    os._exit(130)
