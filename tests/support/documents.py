"""Documents of every kind of content, and of the module that docs/present.md shows."""

import re

from dragrig.present.document import (
    Code,
    Column,
    Document,
    Facts,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    Text,
    TextKind,
)
from dragrig.present.numbers import decimals, significant
from places import ROOT

PAGE = ROOT / "docs" / "present.md"
FORCES = {"001-drag.h5": (101.234, 0.31), "002-drag.h5": (87.5, 0.42)}
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10"><path d="M 0 0 L 10 10"/></svg>'
TABLE = Table(
    "forces",
    "Steady force",
    (Column("speed_mm_s", "mm/s", significant(2)), Column("force_mN", "force, mN", decimals(1)), Column("note", "")),
    ((0.5, FormattedNumber(101.234, "101.2 ± 0.3"), "first"), (2.0, None, ""), (10.0, float("nan"), "")),
    links=("detail", "", ""),
    brief_rows=2,
)
DOCUMENT = Document(
    title="Forces of <a> specimen",
    answer="The force grows by 20 mN.",
    lead=("Measured at 3 speeds.",),
    problem="marked bad: it slid",
    source="runs/first",
    badges=("simulated",),
    sections=(
        Section(
            "forces-section",
            "1. Forces",
            (
                Text("See `dragrig show`."),
                Text("How to read this.", TextKind.EXPLANATION),
                Text("Take care.", TextKind.CAUTION),
                TABLE,
                Figure("curve", "A rising line.", "Force against speed.", SVG),
                Items(("zero is off",), remarks=True),
                Facts({"Operator": "M. K.", "Note": ""}),
                Code("dragrig show runs/first"),
                Section("detail", "The first run", (Text("It was the first."),), collapsed=True, note="001.h5"),
            ),
        ),
        Section("empty", "Nothing to see", (Table("none", "", (Column("x", "x"),), ()), Items(()), Facts({"a": ""}))),
    ),
    data={"force_mN": [101.234, float("nan")]},
)


def example_document() -> Document:
    """Build the document that the page's module makes of two runs."""
    shown = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert shown is not None
    module: dict[str, object] = {"__name__": "forces"}
    exec(compile(shown[1], str(PAGE), "exec"), module)  # our own page
    build = module["forces_document"]
    assert callable(build)
    made = build(FORCES)
    assert isinstance(made, Document)
    return made
