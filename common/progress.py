"""A progress bar: redrawn on a terminal, a plain line now and then in a log."""
import sys
import time

from tqdm import tqdm

from common import ranks


class Lines:
    """Passes tqdm's redrawn line on to stderr as a plain line, at most every 30 s."""

    last = time.monotonic()

    def write(self, text: str):
        if text.strip() and time.monotonic() - self.last >= 30:
            self.last = time.monotonic()
            print(text.strip(), file=sys.stderr, flush=True)


def bar(over, desc: str, **kw) -> tqdm:
    """A progress bar over an iterable, or over a number of steps told by update()."""
    log = {"file": Lines(), "ncols": 0, "mininterval": 5, "miniters": 1}
    kw |= {"dynamic_ncols": True} if sys.stderr.isatty() else log
    kw |= {"disable": ranks.RANK > 0}
    return tqdm(over if hasattr(over, "__iter__") else range(over), desc, **kw)
