"""What the test line tries of many: a quarter of a property's examples, and some members of a family of cases.

The thorough tests try three times as many examples, and the other members.
"""

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import settings


def examples(usual: int) -> int:
    """Return a number of examples as the tier that runs has it.

    The test line repeats its examples (`--hypothesis-seed`), so that a failure is the fault of a change; the nightly
    run draws new ones.
    """
    return max(5, usual * settings.default.max_examples // 100)


def thorough(*values: object) -> Any:
    """Parameters of a case whose mechanism other cases of the same test show in the test line."""
    return pytest.param(*values, marks=pytest.mark.thorough)


def every_third(members: Sequence[object]) -> list[object]:
    """Return the members of a large family as cases: one of three in the test line, the others thorough."""
    return [thorough(member) if number % 3 else member for number, member in enumerate(members)]
