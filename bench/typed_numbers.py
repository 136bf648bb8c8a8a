"""Type numbers into the window's fields under four locales, and count those that are sent as others.

Run `python bench/typed_numbers.py [--count 2000] [--seed 1]`; each locale is a process of its own.
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from typed_in_locale import LOCALES, typed_in


def main() -> None:
    """Print a line for each locale."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    choices = parser.parse_args()
    for locale in LOCALES:
        begun = perf_counter()
        outcome = typed_in(locale, choices.count, choices.seed)
        print(
            f"{outcome.locale}, decimal mark {outcome.decimal_mark!r}: {len(outcome.differing)} of {outcome.typed} "
            f"numbers differ, {len(outcome.sent)} of {outcome.refused} texts that are none are sent; "
            f"{perf_counter() - begun:.0f} s"
        )
        for text in (*outcome.differing, *outcome.sent)[:5]:
            print(f"    {text}")


if __name__ == "__main__":
    main()
