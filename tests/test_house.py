"""The house itself: packaging, style, types, layers."""

import gc
import importlib.util
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import grimp
import pytest

from places import ROOT

ROOMS = {"app": "dragrig", "analysis": "dragrig.analysis", "sim_backend": "dragrig.sim_backend",
         "rig": "dragrig.rig", "config": "dragrig.config"}  # fmt: skip
IMPORTS_CACHE = str(ROOT / ".import_linter_cache")


@pytest.fixture(scope="module")
def measured() -> Iterator[dict[str, Any]]:
    """The measures of `bench/house.py`, and the house as `house`.

    Of its million parts none is garbage, and to look through them again and again would take most of the time.
    """
    gc.disable()
    try:
        bench = runpy.run_path(str(ROOT / "bench" / "house.py"))
        yield {**bench, "house": bench["House"](ROOT)}
    finally:
        gc.enable()


def tool(*command: str) -> None:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_ruff_finds_nothing() -> None:
    tool(sys.executable, "-m", "ruff", "check", ".")
    tool(sys.executable, "-m", "ruff", "format", "--check", ".")


def test_types_hold_strictly() -> None:
    tool(sys.executable, "-m", "mypy", "-p", "dragrig")


def test_imports_go_one_way() -> None:
    linter = "import sys; from importlinter.cli import lint_imports_command as lint; sys.exit(lint())"
    tool(sys.executable, "-c", linter, "--cache-dir", IMPORTS_CACHE)


def test_imports_go_one_way_through_public_faces_too(measured: dict[str, Any]) -> None:
    """import-linter ends at a face, which imports nothing until a name is taken from it."""
    graph = grimp.build_graph("dragrig", include_external_packages=True, cache_dir=IMPORTS_CACHE)
    for module, imported in measured["house"].graph(in_functions=True, for_types=True).items():
        for defining in imported:
            graph.add_import(importer=module, imported=defining)
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    for rule in rules:
        if rule["type"] == "layers":
            layers = [set(layer.split(" | ")) for layer in rule["layers"]]
            assert not graph.find_illegal_dependencies_for_layers(layers), rule["name"]
            continue
        for source, forbidden in product(rule["source_modules"], set(rule["forbidden_modules"]) & graph.modules):
            chains = graph.find_shortest_chains(source, forbidden)
            direct = {chain for chain in chains if len(chain) == 2}
            assert not (direct if rule.get("allow_indirect_imports") else chains), rule["name"]


def test_the_house_does_not_grow(measured: dict[str, Any]) -> None:
    """A bar in `bench/house.py` only falls: whoever adds something takes something else away."""
    reached, bars = measured["figures"](measured["house"]), measured["BARS"]
    assert reached.keys() == bars.keys()
    assert {name: value for name, value in reached.items() if value > bars[name]} == {}


def test_every_package_is_installed() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"])
    result = set()
    for folder, name in ROOMS.items():
        for init in (ROOT / folder).rglob("__init__.py"):
            inner = init.parent.relative_to(ROOT / folder).parts
            result.add(".".join((name, *inner)))
    assert listed == result


def test_a_users_own_modules_do_not_shadow_ours(tmp_path: Path) -> None:
    for name in ("config", "analysis", "rig"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('shadowed')\n", "utf-8")
    script = tmp_path / "mine.py"
    script.write_text("import dragrig.rig.devices, dragrig.config.rig, dragrig.analysis\n", "utf-8")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_top_level_name_but_ours_is_installed() -> None:
    assert importlib.util.find_spec("dragrig") is not None
    outside = {"sim_backend", "rig", "config"}
    done = subprocess.run(
        [sys.executable, "-c", f"import importlib.util as u; print([n for n in {sorted(outside)} if u.find_spec(n)])"],
        cwd=Path(sys.prefix),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"
