"""Types numbers into the window's fields under a locale, in a process of its own, and tells what is sent.

`python typed_in_locale.py LOCALE COUNT SEED` prints an `Outcome` as JSON; `typed_in` runs it. A number differs when
another one is sent, or none; texts that are no number, as 1.234,5, are typed too, and none may be sent.
"""

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PySide6.QtWidgets import QAbstractButton, QLineEdit, QWidget

    from dragrig.window.forms import NumberField

LOCALES = ("de_DE", "fr_FR", "pt_BR", "en_US")
_MINUS, _NO_BREAK, _NARROW = "\u2212", "\u00a0", "\u202f"
_DIGITS_AT_MOST = 15
"""Decimal digits that a double holds whatever they are."""


@dataclass(kw_only=True)
class Outcome:
    """What became of the texts that were typed under a locale."""

    locale: str
    decimal_mark: str
    typed: int = 0
    differing: list[str] = field(default_factory=list)
    """Numbers for which another one was sent, or none, or that the field did not show."""
    refused: int = 0
    sent: list[str] = field(default_factory=list)
    """Texts that are no number, and were sent or not explained."""


@dataclass(frozen=True, slots=True)
class _Target:
    """A field, what is sent once its text is entered (None for nothing), and numbers that it allows."""

    name: str
    line: "QLineEdit"
    send: Callable[[], float | None]
    said: Callable[[], str]
    """What is said beside the field."""
    unit: str
    lowest: int
    highest: int
    whole: bool = False
    marks: str = ".,"


def typed_in(locale: str, count: int, seed: int = 1) -> Outcome:
    """Type numbers in a process on a desktop of this locale."""
    desktop = {**os.environ, "LC_ALL": f"{locale}.UTF-8", "LANGUAGE": "", "QT_QPA_PLATFORM": "offscreen"}
    words = [sys.executable, str(Path(__file__)), locale, str(count), str(seed)]
    done = subprocess.run(words, env=desktop, check=False, capture_output=True, text=True, encoding="utf-8")
    if done.returncode:
        raise RuntimeError(done.stderr)
    return Outcome(**json.loads(done.stdout.splitlines()[-1]))


def _digits(draw: random.Random, target: _Target) -> str:
    """Draw a number that a field allows, in digits with a point."""
    size = draw.choice((1, 10, 1000, 100_000))
    whole = draw.randint(max(target.lowest, 1 - size), max(min(target.highest, size) - 1, target.lowest))
    if target.whole:
        return str(whole)
    digits = min(draw.choice((0, 1, 2, 3, 3, 6, 9)), _DIGITS_AT_MOST - 1 - len(str(abs(whole))))
    # No zero, which is no speed.
    fraction = "".join(draw.choices("0123456789", k=digits))
    sign = "-" if target.lowest < 0 <= whole and draw.random() < 0.3 else ""
    return f"{sign}{whole}.{fraction}1" if digits else f"{sign}{whole or 1}"


def _spelt(draw: random.Random, digits: str, target: _Target) -> tuple[str, bool]:
    """Return a number as a person writes it, and whether it is pasted, as what no keyboard has."""
    text = digits.replace(".", draw.choice(target.marks))
    if draw.random() < 0.8:
        return text, False
    text = text.replace("-", _MINUS)
    return draw.choice(
        (f"{text} {target.unit}", f"{text}{_NO_BREAK}{target.unit}", f"{_NARROW}{text}", f" {text} ")
    ), True


def _no_numbers(draw: random.Random, target: _Target) -> Iterator[str]:
    """Yield texts that a field must refuse."""
    head, tail = draw.randint(1, 999), f"{draw.randint(0, 999):03d}"
    for mark in (".", ",", " ", "'", "\u2019", _NO_BREAK, _NARROW, "_"):
        yield f"{head}{mark}{tail}{',' if mark == '.' else '.'}{draw.randint(0, 9)}"
        yield f"{head}{mark}{tail}{mark}{tail}"
        if mark not in ".,":
            yield f"{head}{mark}{tail}"
    yield from (
        "nan",
        "inf",
        "-inf",
        "1e999",
        "1e-999",
        "-",
        "\u0663",
        "1,5,5",
        "0x10",
        "1.5 ft",
        "--1",
        "1.5.",
        "1e",
        "1 .5",
    )
    yield from (str(target.highest + 1), f"{target.highest}.5", f"{target.lowest - 1}")
    yield from ("1.5",) if target.whole else ("1,5",) if target.marks == "." else ()


def _targets(kept: "list[QWidget]") -> list[_Target]:
    """Return the fields of the window that take numbers, each beside what it sends; their widgets are to be kept."""
    from dragrig.engine_host.messages import HandMotion, RigSelection
    from dragrig.views import describe_rig, plan_form, within_rig
    from dragrig.window.diagnose_page import DiagnosePage
    from dragrig.window.forms import FormEditor
    from dragrig.window.look_page import TraceOverlay
    from dragrig.window.run_page import HandView
    from dragrig.window.widgets import StoredSettings

    rig = describe_rig(RigSelection())
    asked: list[HandMotion] = []
    hand = HandView(asked.append, lambda: "A. Person")
    hand.set_limits(rig)
    hand.allow(idle=True, armed=True)
    overlay, diagnose, editor = TraceOverlay(), DiagnosePage(StoredSettings()), FormEditor()
    form = within_rig(plan_form("drag"), rig)
    editor.edit(form)
    kept += hand, overlay, diagnose, editor
    for widget in kept:
        widget.show()

    def moved(name: str, box: "NumberField", button: "QAbstractButton", key: str, *limits: int) -> _Target:
        def send() -> float | None:
            asked.clear()
            button.click()
            hand.end("")
            return getattr(asked[0], key) if asked else None

        return _Target(name, box.lineEdit(), send, box.problem.text, box.unit.text(), *limits)

    def shown(name: str, box: "NumberField", unit: str, *limits: int, whole: bool = False) -> _Target:
        return _Target(name, box.lineEdit(), box.value, box.problem.text, unit, *limits, whole=whole)

    def planned(key: str, unit: str, *limits: int, whole: bool = False, marks: str = ".,") -> _Target:
        def send() -> float | None:
            if said():
                return None
            step = form.filled(editor.values()).steps[0]
            value = {**step.model_dump(mode="json"), **step.parameters}[key]
            return value if isinstance(value, int | float) else None

        def said() -> str:
            return form.misread(editor.values()).get((0, key), "")

        box = editor.editors[key]
        return _Target(f"plan, {key}", box, send, said, unit, *limits, whole=whole, marks=marks)  # type: ignore[arg-type]

    travel = round(rig.highest_mm - rig.lowest_mm)
    return [
        moved("jog by", hand.distance, hand.jog, "distance_mm", -travel, travel),
        moved("jog at", hand.speed, hand.jog, "speed_mm_s", 0, 100),
        moved("touch within", hand.most, hand.touch, "most_mm", -travel, travel),
        moved("touch at", hand.approach, hand.touch, "speed_mm_s", 0, 100),
        moved("touch until", hand.force, hand.touch, "force_mN", 0, 10**9),
        moved("touch back", hand.back, hand.touch, "back_mm", 0, 10**9),
        shown("filter window", overlay.window_ms, "ms", 1, 5000),
        shown("filter order", overlay.order, "", 0, 8, whole=True),
        shown("settle", diagnose.minutes, "min", 1, 999),
        planned("wait_s", "s", 0, 86_400),
        planned("repeats", "", 1, 1000, whole=True),
        planned("speed_mm_s", "mm/s", 1, 100, marks="."),
    ]


def _enter(target: _Target, text: str, *, pasted: bool) -> None:
    from PySide6.QtCore import Qt
    from PySide6.QtTest import QTest
    from PySide6.QtWidgets import QApplication

    target.line.setFocus()
    target.line.selectAll()
    if pasted or not text.isascii():
        QApplication.clipboard().setText(text)
        target.line.paste()
    else:
        QTest.keyClicks(target.line, text)
    QTest.keyClick(target.line, Qt.Key.Key_Return)


def _type(outcome: Outcome, count: int, draw: random.Random) -> None:
    kept: list[QWidget] = []
    targets = _targets(kept)
    limitless = {"touch until", "touch back"}
    while outcome.typed < count:
        for target in targets:
            before = target.line.text()
            digits = _digits(draw, target)
            text, pasted = _spelt(draw, digits, target)
            _enter(target, text, pasted=pasted)
            number, shown = target.send(), target.line.text().removesuffix(target.unit).strip()
            outcome.typed += 1
            if number != float(digits) or Decimal(shown.replace(",", ".").replace(_MINUS, "-")) != Decimal(digits):
                outcome.differing.append(f"{target.name}: {text!r} sends {number}, shows {shown!r}")
            if outcome.typed % 7 == 0:
                refusal = draw.choice([*_no_numbers(draw, target)])
                beyond = refusal.lstrip("-").isdecimal() or refusal.endswith(".5")
                if not (beyond and target.name in limitless):
                    _enter(target, refusal, pasted=False)
                    outcome.refused += 1
                    if target.send() is not None or not target.said():
                        outcome.sent.append(f"{target.name}: {refusal!r}")
            _enter(target, before, pasted=False)


def main() -> None:
    """Type under the locale of the arguments."""
    from PySide6.QtCore import QLocale
    from PySide6.QtWidgets import QApplication

    locale, count, seed = sys.argv[1:]
    if QLocale().name() != locale:  # a system whose locale is no variable
        QLocale.setDefault(QLocale(locale))
    application = QApplication([])
    outcome = Outcome(locale=QLocale().name(), decimal_mark=QLocale().decimalPoint())
    _type(outcome, int(count), random.Random(int(seed)))
    print(json.dumps(asdict(outcome)))
    application.quit()


if __name__ == "__main__":
    main()
