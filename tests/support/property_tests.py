"""How many examples a property is tried with: a quarter in the test line, three times as many in the thorough tests."""

from hypothesis import settings


def examples(usual: int) -> int:
    """Return a number of examples as the tier that runs has it.

    The test line repeats its examples (`--hypothesis-seed`), so that a failure is the fault of a change; the nightly
    run draws new ones.
    """
    return max(5, usual * settings.default.max_examples // 100)
