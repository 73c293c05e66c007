"""`dvc repro` without its hint to push what was made: nothing here has a remote, and DVC has no setting for the hint.

The commands of the stages write to the terminal themselves, so that their live lines stay live: only DVC's own words
pass through here.
"""

import io
import sys

HINT = "Use `dvc push`"


class WithoutHint(io.TextIOWrapper):
    """Standard output but for the lines that begin with the hint."""

    def write(self, text: str) -> int:
        """As of a file. DVC writes a line and its end one after the other."""
        if text.startswith(HINT):
            self.dropped = not text.endswith("\n")
            return len(text)
        if text == "\n" and getattr(self, "dropped", False):
            self.dropped = False
            return 1
        return super().write(text)


if __name__ == "__main__":
    from dvc.cli import main

    out = sys.stdout.buffer
    sys.stdout = WithoutHint(out, encoding=sys.stdout.encoding, errors="backslashreplace", line_buffering=True)
    sys.exit(main(["repro", *sys.argv[1:]]))
