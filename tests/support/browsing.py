"""What the tests that open a page in a real Chromium share."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as ET

import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
PHONE_PX, DESK_PX = 390, 1200
Scheme = Literal["light", "dark"]


@contextmanager
def chromium() -> Iterator[Browser]:
    result = next((path for path in map(shutil.which, NAMES) if path), None)
    if result is None:
        answer = "no Chromium here: apt-get install chromium"
        if os.environ.get("CI") == "true":
            pytest.fail(answer)
        pytest.skip(answer)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=result, args=["--no-sandbox"], timeout=600_000)
        yield browser
        browser.close()


@dataclass
class Heard:
    """Console messages and requested addresses of a page."""

    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


@contextmanager
def opened(browser: Browser, url: str, width: int = DESK_PX, scheme: Scheme = "light") -> Iterator[tuple[Page, Heard]]:
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    context.set_default_timeout(600_000)
    page, heard = context.new_page(), Heard()
    page.on("console", lambda message: heard.messages.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: heard.messages.append(f"error: {error}"))
    page.on("request", lambda request: heard.requests.append(request.url))
    page.goto(url)
    yield page, heard
    context.close()


def must_be_presentable(browser: Browser, file: Path) -> None:
    """Look at a page on a phone, at a desk, in the dark and on paper for what a customer would not like."""
    with opened(browser, file.as_uri(), PHONE_PX) as (page, heard):
        _unfold(page)
        for width, scheme in ((PHONE_PX, "light"), (DESK_PX, "light"), (DESK_PX, "dark")):
            page.set_viewport_size({"width": width, "height": 900})
            page.emulate_media(media="screen", color_scheme=scheme)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, f"wider than {width} px"
            assert _contrast(page) > 7.0
            assert _figures(page) == []
            page.emulate_media(media="print")
            assert _contrast(page) > 15.0, "prints on a dark ground"
        assert heard.messages == []
        assert heard.requests == [file.as_uri()]


def must_sort(browser: Browser, file: Path, table: str, column: int) -> None:
    """Sort a table's column of numbers from the keyboard: up, down, and as it was, missing ones always last."""
    with opened(browser, file.as_uri()) as (page, heard):
        head = page.locator(f"{table} thead th").nth(column)
        as_was = _numbers(page, table, column)
        there = sorted(entry for entry in as_was if entry is not None)
        lost = [None] * (len(as_was) - len(there))
        assert as_was not in (there + lost, there[::-1] + lost)
        head.locator("button").focus()
        for key, order, wanted in (
            ("Enter", "ascending", there + lost),
            ("Space", "descending", there[::-1] + lost),
            ("Enter", "none", as_was),
        ):
            page.keyboard.press(key)
            assert head.get_attribute("aria-sort") == order
            assert _numbers(page, table, column) == wanted
        assert heard.messages == []


def must_save_its_figure(browser: Browser, file: Path) -> None:
    """Save the first figure from the page: 180 mm wide, as an SVG with all its letters, and as a PNG of 600 dpi."""
    with opened(browser, file.as_uri()) as (page, heard):
        buttons = page.locator("figure .save").first.locator("button")
        for place, width in ((0, "180mm"), (1, 4252)):
            with page.expect_download() as download:
                buttons.nth(place).click()
            saved = Path(download.value.path()).read_bytes()
            if place == 0:
                svg = ET.fromstring(saved)
                ids = {element.get("id") for element in svg.iter()}
                letters = {element.get("href", "")[1:] for element in svg.iter() if element.tag.endswith("}use")}
                assert svg.get("width") == width
                assert letters
                assert letters <= ids, "letters are missing"
            else:
                with Image.open(BytesIO(saved)) as picture:
                    assert picture.width == width
                    assert picture.info["dpi"] == pytest.approx((600, 600), abs=0.1)
                    assert len(picture.convert("L").getcolors(256) or ()) > 2, "nothing is drawn"
        assert heard.messages == []


def _numbers(page: Page, table: str, column: int) -> list[float | None]:
    cells = page.locator(f"{table} tbody tr td:nth-child({column + 1})").all_inner_texts()
    return [None if cell == "–" else float(cell.replace("−", "-")) for cell in cells]


def _unfold(page: Page) -> None:
    page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")


def _figures(page: Page) -> list[str]:
    """Say which figures are not drawn, say nothing to those who cannot see, or refer to letters that are not there."""
    return list(
        page.evaluate("""() => [...document.querySelectorAll("figure svg")].flatMap((svg, place) => [
            svg.getBoundingClientRect().height < 100 ? `figure ${place} is not drawn` : "",
            (svg.getAttribute("aria-label") ?? "").length < 20 ? `figure ${place} says nothing` : "",
            ...[...svg.querySelectorAll("use")].map((use) =>
                document.getElementById(use.getAttribute("href").slice(1)) ? "" : `no ${use.getAttribute("href")}`),
            ...[...svg.querySelectorAll("[clip-path]")].map((one) =>
                document.getElementById(one.getAttribute("clip-path").slice(5, -1)) ? "" : "a clip is lost"),
        ]).filter(Boolean)""")
    )


def _contrast(page: Page) -> float:
    """Contrast of text on the page, as the Web Content Accessibility Guidelines count it."""
    text, ground = page.evaluate(
        "(() => { const own = getComputedStyle(document.body);"
        " return [own.color, own.backgroundColor].map((one) => one.match(/[\\d.]+/g).slice(0, 3).map(Number)); })()"
    )
    bright, dim = sorted((_luminance(text), _luminance(ground)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def _luminance(rgb: list[float]) -> float:
    red, green, blue = (
        entry / 12.92 if entry <= 0.03928 else ((entry + 0.055) / 1.055) ** 2.4
        for entry in (part / 255 for part in rgb)
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
