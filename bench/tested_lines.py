"""Print the share of lines that the tests run, by room: `python bench/tested_lines.py [PYTEST OPTION]...`.

Both tiers are run, or what the options say (`-m "not thorough" tests/rig`). Lines count in every process that a test
starts, but in those that it kills. Needs the `bench` dependency group (`python3 -m uv run --group bench …`).
"""

import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from coverage import Coverage

REPOSITORY = Path(__file__).resolve().parents[1]
TIERS = (["-m", "not thorough"], ["-m", "thorough"])
CONFIGURATION = """
[run]
parallel = true
patch = subprocess
concurrency = multiprocessing,thread
source_pkgs = dragrig
sigterm = true
data_file = {folder}/lines
disable_warnings = couldnt-parse, module-not-imported, no-data-collected, module-not-measured
"""


def measure(configuration: Path, options: list[str]) -> int:
    """Run pytest with its processes measured, and return its exit code."""
    command = [sys.executable, "-m", "coverage", "run", f"--rcfile={configuration}", "-m", "pytest", *options]
    return subprocess.run(command, cwd=REPOSITORY, env=dict(os.environ), check=False).returncode


def room_of(path: Path) -> str:
    """Return the folder of a module, two deep."""
    return "/".join(path.relative_to(REPOSITORY).parent.parts[:2])


def table(coverage: Coverage) -> list[tuple[str, int, int]]:
    """Return each room with its statements and those of them that ran."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for file in coverage.get_data().measured_files():
        path = Path(file).resolve()
        if path.is_relative_to(REPOSITORY) and path.is_file():
            _, statements, _, missing, _ = coverage.analysis2(file)
            count = counts[room_of(path)]
            count[0] += len(statements)
            count[1] += len(statements) - len(missing)
    return [(room, *counts[room]) for room in sorted(counts)]


def main() -> int:
    """Run the tests and print the table."""
    with tempfile.TemporaryDirectory() as folder:
        configuration = Path(folder) / "coveragerc"
        configuration.write_text(CONFIGURATION.format(folder=folder), "utf-8")
        tiers = [sys.argv[1:]] if sys.argv[1:] else TIERS
        codes = [measure(configuration, options) for options in tiers]
        coverage = Coverage(config_file=str(configuration))
        coverage.combine()
        rows = table(coverage)
    rows.append(("all", sum(row[1] for row in rows), sum(row[2] for row in rows)))
    for room, statements, ran in rows:
        print(f"{room:32s}{statements:8d} statements {ran / max(1, statements):7.1%}")
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
