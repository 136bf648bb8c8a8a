"""Change the product's code in one place after another, and count the changes that its tests notice.

`python bench/mutants.py [MODULE …] [--sample N] [--seed S] [--folder F]`: mutmut makes the mutants of each module and
runs the tests that belong to it, on a copy that lies as it is imported. It prints the killed of the tested by module,
and the difference that each survivor makes. `--sample` tests that many mutants of each module, drawn with the seed;
`--folder` keeps the copies and results there, and tests only what survived in them before.
"""

import argparse
import contextlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from pathlib import Path

import tomli_w

ROOT = Path(__file__).resolve().parents[1]
TESTS: dict[str, tuple[str, ...]] = {
    "rig/profile.py": ("rig/test_profile.py",),
    "analysis/linear_gaussian.py": ("analysis/test_linear_gaussian.py",),
    "rig/guard.py": ("rig/test_guard.py",),
    "analysis/gap/budget.py": ("analysis/gap/test_budget.py",),
    "analysis/gap/evaluation.py": ("analysis/gap/test_effect_sizes.py",),
    "analysis/identification/population.py": ("analysis/identification/test_population.py",),
    "analysis/gap/pooled_evidence.py": ("analysis/gap/test_pooled_evidence.py",),
    "analysis/importing/readers.py": (
        "analysis/importing/test_readers.py",
        "analysis/importing/test_containers.py",
        "analysis/importing/test_text.py",
    ),
    "rig/runfile/reader.py": ("rig/runfile/test_reader.py",),
    "rig/runfile/recorder.py": ("rig/runfile/test_recorder.py",),
    "rig/engine.py": ("rig/test_engine.py",),
}
"""The fast tests of each module."""
SLOW = (
    "analysis/identification/test_population.py::test_the_command_tells_a_population_and_counts_a_copied_campaign_once",
    "rig/runfile/test_reader.py::test_damaged_bytes_are_read_or_refused_but_never_worse",
    "rig/runfile/test_reader.py::test_a_cut_file_is_refused",
    "rig/runfile/test_reader.py::test_the_package_loads_h5py_only_when_needed",
    "rig/runfile/test_recorder.py::test_a_full_disk_is_reported_and_what_was_recorded_is_kept",
    "rig/runfile/test_recorder.py::test_a_session_ends_though_the_disk_makes_no_progress_and_says_what_is_left",
    "rig/runfile/test_recorder.py::test_any_viewer_follows_a_recording",
    "rig/runfile/test_recorder.py::test_the_arrays_do_not_depend_on_the_blocks",
)
"""Tests among these that take seconds, as every survivor would."""
NOTICED = frozenset({"killed", "timeout", "segfault"})
"""What mutmut calls a mutant with which a test failed, did not end, or ended the interpreter."""
UNSEEN = (r"\bcast\(", r"__slots__", r"TypeVar\(")
"""Lines that mean something to a type checker alone."""
PLUGIN = '''"""Examples that are the same for every mutant, failures as they were found, and nothing computed before."""

import functools
import gc

from hypothesis import Phase, settings


def pytest_configure() -> None:
    """Override the profile that the tests load, and forget what another process had computed with the code as it is."""
    phases = (Phase.explicit, Phase.generate)
    settings.register_profile("mutants", deadline=None, derandomize=True, database=None, phases=phases)
    settings.load_profile("mutants")
    gc.unfreeze()
    for cached in gc.get_objects():
        if isinstance(cached, functools._lru_cache_wrapper):
            cached.cache_clear()
'''


def lay_out(folder: Path, module: str) -> Path:
    """Copy product and tests as they are imported, with the settings of mutmut and pytest.

    Returns
    -------
    Path
        The module, relative to the folder.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    mutated = Path()
    places = project["tool"]["setuptools"]["package-dir"]
    copies = {package.replace(".", "/"): Path(place) for package, place in sorted(places.items())}
    for target, source in {**copies, "tests": Path("tests")}.items():
        no_caches = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / source, folder / target, ignore=no_caches, dirs_exist_ok=True)
        if Path(module).is_relative_to(source):
            mutated = target / Path(module).relative_to(source)
    (folder / "plugins").mkdir(exist_ok=True)
    (folder / "plugins" / "same_examples.py").write_text(PLUGIN, "utf-8")
    pytest = project["tool"]["pytest"]["ini_options"]
    own = ["-p", "no:pytest-qt", "-p", "no:xdist", "-p", "no:cacheprovider", "-p", "same_examples"]
    pytest["addopts"] = [*own, "--import-mode=importlib", "--strict-markers"]
    mutmut = {
        "source_paths": ["dragrig"],
        "only_mutate": [mutated.as_posix()],
        "do_not_mutate_patterns": list(UNSEEN),
        "pytest_add_cli_args_test_selection": [
            *(f"tests/{test}" for test in TESTS[module]),
            *(f"--deselect=tests/{test}" for test in SLOW),
        ],
        "use_git_change_detection": False,
        "track_dependencies": False,
        "timeout_constant": 2.0,
        "timeout_multiplier": 5.0,
    }
    settings = {"tool": {"pytest": {"ini_options": pytest}, "mutmut": mutmut}}
    (folder / "pyproject.toml").write_text(tomli_w.dumps(settings), "utf-8")
    return mutated


def run(folder: Path, module: str, sample: int | None, seed: int) -> tuple[int, int]:
    """Test a module's mutants, print the survivors' differences, and return how many were killed and how many tested.

    Where the folder has results already, only the survivors among them are tested.
    """
    mutated = lay_out(folder, module)
    # Which test reaches what is found out anew: it may have changed with the tests.
    (folder / "mutants" / "mutmut-stats.json").unlink(missing_ok=True)
    with contextlib.chdir(folder):
        from mutmut.configuration import reset_config
        from mutmut.mutation.data import SourceFileMutationData
        from mutmut.mutation.diff_apply import get_diff_for_mutant
        from mutmut.mutation.file_mutation import mutate_file_contents
        from mutmut.stats import status_by_exit_code
        from mutmut.utils.format_utils import get_mutant_name

        def results() -> dict[str, str]:
            data = SourceFileMutationData(path=mutated)
            data.load()
            return {name: status_by_exit_code[code] for name, code in data.exit_code_by_key.items() if code is not None}

        reset_config()
        made = mutate_file_contents(str(mutated), mutated.read_text("utf-8")).mutant_names
        chosen = [get_mutant_name(mutated, name) for name in made]
        if sample and sample < len(chosen):
            chosen = sorted(random.Random(seed).sample(chosen, sample))
        before = results()
        tested = [name for name in chosen if before.get(name) not in NOTICED]
        # One thread of linear algebra, as the tests have it: mutmut forks, and counts the processor's time.
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(folder / "plugins")}
        command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *tested]
        ended = subprocess.run(command, env=environment, text=True, capture_output=True, check=False)
        if ended.returncode:
            raise SystemExit(f"{module}: mutmut ended with {ended.returncode}\n{ended.stdout[-6000:]}{ended.stderr}")
        became = {name: status for name, status in results().items() if name in chosen}
        for name in (name for name, status in became.items() if status not in NOTICED):
            print(f"# {name}: {became[name]}")
            print("\n".join(get_diff_for_mutant(name, path=mutated).splitlines()[2:]), flush=True)
    counts = Counter(became.values())
    killed = sum(counts[status] for status in NOTICED)
    print(f"{module}: {killed} of {len(became)} killed, of {len(made)} made {dict(counts)}", flush=True)
    return killed, len(became)


def main() -> None:
    """Test the mutants of the modules that were named, or of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=", ".join(TESTS))
    parser.add_argument("--sample", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="keep copies and results there; then only survivors are tested")
    options = parser.parse_args()
    unknown = set(options.modules) - set(TESTS)
    if unknown:
        parser.error(f"no tests are known of {', '.join(sorted(unknown))}; there are {', '.join(TESTS)}")
    results: dict[str, tuple[int, int]] = {}
    with tempfile.TemporaryDirectory(prefix="mutants-") as temporary:
        for module in options.modules or TESTS:
            folder = (options.folder or Path(temporary)).resolve() / module
            results[module] = run(folder, module, options.sample, options.seed)
    for module, (killed, tested) in results.items():
        print(f"{module:40} {killed:5} of {tested:5} {killed / tested:6.1%}")


if __name__ == "__main__":
    main()
