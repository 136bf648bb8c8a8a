"""The documentation: the site builds without a warning and asks for nothing, and what it shows works."""

import os
import re
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import click
import pytest
from playwright.sync_api import Browser

from browsing import opened
from dragrig.cli import main
from dragrig.cli.commands import dragrig_group, gap_command
from dragrig.rig.protocols import protocol_kinds
from dragrig.rig.runfile import schema
from places import ROOT

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stderr
    return folder


class Assets(HTMLParser):
    """Gathers what a page has a browser fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        result = dict(attrs)
        if tag in {"script", "img", "iframe"} or (
            tag == "link" and result.get("rel") not in {"canonical", "prev", "next"}
        ):
            self.fetched += [value for key in ("src", "href") if (value := result.get(key))]


@pytest.mark.thorough
def test_the_site_builds_without_a_warning_and_fetches_nothing(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        read = Assets()
        read.feed(page.read_text("utf-8"))
        assert read.fetched
        assert not [entry for entry in read.fetched if "//" in entry], page
    styles = "".join(path.read_text("utf-8") for path in site.rglob("*.css"))
    assert not re.findall(r"url\([\"']?(?:https?:)?//", styles)
    assert not (site / "hooks").exists()


@pytest.mark.thorough
def test_no_code_of_the_site_is_clipped(site: Path, browser: Browser) -> None:
    clipped = {}
    with opened(browser, (site / "index.html").as_uri(), 1280) as (page, _):
        for path in sorted(site.rglob("*.html")):
            page.goto(path.as_uri())
            if found := page.evaluate(
                "[...document.querySelectorAll('.md-content pre, .md-content pre code')]"
                ".filter((code) => code.scrollWidth > code.clientWidth + 1).map((code) => code.textContent)"
            ):
                clipped[path.name] = found
    assert not clipped


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").split("\nnav:\n")[1]
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert not [page for page in pages if page not in navigation]


@pytest.mark.thorough
def test_the_reference_is_that_of_the_code(site: Path) -> None:
    commands = (site / "reference" / "commands.html").read_text("utf-8")
    for name in dragrig_group.list_commands(click.Context(dragrig_group)):
        assert f'id="{name}"' in commands or f'id="{name}-' in commands
    settings = (site / "reference" / "settings.html").read_text("utf-8")
    assert all(f'id="{kind}"' in settings for kind in protocol_kinds())
    assert "<code>[sampling]</code>" in settings
    assert "Standstill before the motion." in settings
    run_file = (site / "reference" / "run-file.html").read_text("utf-8")
    assert schema.FORMAT in run_file
    assert all(entry in run_file for entry in ("contact_angle_deg", "SHA-256", "decelerate"))


@pytest.mark.thorough
def test_every_command_of_the_tutorial_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (DOCS / "tutorial.md").read_text("utf-8")
    for name, plan in zip(("first", "fresh"), re.findall(r"```toml\n(.*?)```", text, re.DOTALL), strict=True):
        Path(f"{name}.toml").write_text(plan, "utf-8")
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.strip().splitlines()]
    assert len(lines) > 7
    answer = {}
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == "dragrig"
        assert main(arguments) == 0, line
        answer[line] = capsys.readouterr().out
    diagnosis = next(text for line, text in answer.items() if "gap diagnose" in line)
    assert "stribeck" in diagnosis.lower()
    evaluation = next(text for line, text in answer.items() if "gap evaluate" in line)
    assert "The promise is KEPT" in evaluation
    [closed] = re.search(r"([\d.]+) % of the gap closes", evaluation).groups()
    assert float(closed) > 75, "the gap does not visibly close"
    assert Path("gap.html").stat().st_size > 10_000
    assert Path("first.html").stat().st_size > 10_000


PAGES = (ROOT / "README.md", *sorted(path for path in DOCS.rglob("*.md") if "decisions" not in path.parts))


def shown_commands(page: Path) -> list[list[str]]:
    """The command lines in the blocks of a page, without `dragrig` itself."""
    blocks = re.findall(r"```(?:sh|powershell)\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    plain = [re.sub(r"\$\(.*?\)|\$\w+", "1", re.sub(r"\S+ -m uv run (--no-dev )?", "", line)) for line in lines]
    parts = [part for line in plain for part in re.split(r"&&|;|[{}]", line)]
    return [words[1:] for part in parts if (words := shlex.split(part, comments=True))[:1] == ["dragrig"]]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_a_page_shows_is_one(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of commands, options and choices; what the files in it hold is nobody's concern here."""
    monkeypatch.chdir(tmp_path)
    for words in shown_commands(page):
        command: click.Command = dragrig_group
        context, rest = click.Context(command), list(words)
        while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
            _, found, rest = command.resolve_command(context, rest)
            assert found is not None, words
            command = found
        command.make_context("dragrig", rest)


def test_the_readme_lists_every_command_once() -> None:
    rows = re.findall(r"^\| [a-z ]+ \| (`.*`) \|$", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE)
    listed = re.findall(r"`([^`]+)`", " ".join(rows))
    gap = [f"gap {name}" for name in gap_command.list_commands(click.Context(gap_command))]
    every = [name for name in dragrig_group.list_commands(click.Context(dragrig_group)) if name != "gap"]
    assert sorted(listed) == sorted([*every, *gap])


def test_the_worked_protocol_is_a_kind_of_run_once_its_file_is_there_and_runs_as_it_stands(tmp_path: Path) -> None:
    [code] = re.findall(r"```python\n(.*?)```", (DOCS / "new-protocol.md").read_text("utf-8"), re.DOTALL)
    kinds, script = tmp_path / "kinds", tmp_path / "script.py"
    kinds.mkdir()
    (kinds / "staircase.py").write_text(code.split("\n\nif __name__")[0], "utf-8")
    script.write_text(code, "utf-8")
    plan = tmp_path / "plan.toml"
    plan.write_text(
        "name = 'stairs'\n[[steps]]\nkind = 'staircase'\nfirst_mm_s = [2, 5]\nstroke_mm = 5\nwait_s = 0\n", "utf-8"
    )
    program = (
        "import runpy, sys, dragrig; from dragrig.rig import protocols; protocols.__path__.append(sys.argv[1])\n"
        "runs = dragrig.simulate(sys.argv[2], assignments=['rig.sampling.rate_hz=200'])\n"
        "print([run.info.kind for run in runs], runs[0].info.header.protocol['stroke_mm'])\n"
        "runpy.run_path(sys.argv[3], run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(kinds), str(plan), str(script)], capture_output=True, text=True, check=False
    )
    assert done.stdout == "['staircase', 'return', 'staircase', 'return'] 5.0\nstaircase 30.0 mm\n", done.stderr
