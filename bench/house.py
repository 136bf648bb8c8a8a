"""Print the measures of the house from the code itself: `python bench/house.py [--repository FOLDER] [--list]`.

A line counts, whatever is on it, those of a stub with its module; a module is a file. A module imports what it names in
an import statement, anywhere in it but under TYPE_CHECKING; packages that Python loads on the way are not counted.
Where a name comes from the public face of a package (a stub, `__init__.pyi`, whose names are loaded on first use), the
module names the face, and that is what "imports per module" counts. A face loads nothing itself: for depth and circles
each name is followed to the module that defines it, and a line of its own counts imports per module in this way. A
private function is a function or method whose name begins with an underscore; its uses are the places in its own module
that name it, so that one that a decorator registers is never used. A free clause is a sentence of a docstring with the
word "what", for which the field mostly has a noun.
"""

import argparse
import ast
import re
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean, median

ROOT = "dragrig"
BARS: dict[str, float] = {
    "lines": 93_541, "modules": 297, "fan-out": 3.8654, "depth": 18, "circles": 0, "used once": 0.5692,
    "free clauses": 0.0160,
}  # fmt: skip
"""What the house is at most; a test holds it, and a bar is only ever lowered."""
PEER = "ophyd-async's core: 26 modules, median 235 lines, fan-out 2.7"
Graph = Mapping[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Import:
    """An imported name: where it stands decides when it is loaded."""

    module: str
    name: str | None
    in_function: bool
    for_types: bool


@dataclass(frozen=True, slots=True)
class Module:
    """A product file with its parsed code."""

    name: str
    path: Path
    lines: int
    tree: ast.Module
    face: Mapping[str, str]
    """Public names that are loaded on first use, by the stub beside the file, with the module that each comes from."""

    @property
    def is_package(self) -> bool:
        """Whether this is the `__init__` of a package."""
        return self.path.name == "__init__.py"


class House:
    """The product modules of a repository.

    Parameters
    ----------
    repository
        Folder with `pyproject.toml`, whose package-dir mapping says which folder is which package.
    """

    def __init__(self, repository: Path) -> None:
        project = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))
        folders: Mapping[str, str] = project["tool"]["setuptools"]["package-dir"]
        self.rooms = {package: repository / folder for package, folder in folders.items()}
        result = (module for package, folder in self.rooms.items() for module in _modules(package, folder))
        self.modules = {module.name: module for module in result}

    @cached_property
    def imports(self) -> Mapping[str, Sequence[Import]]:
        """What each module imports of the product."""
        return {name: _imports(module, self.modules) for name, module in self.modules.items()}

    def graph(self, *, in_functions: bool, for_types: bool, through_faces: bool = True) -> Graph:
        """Return the distinct modules that each module imports, or names, where names of faces are not followed."""
        return {
            name: frozenset(
                self.defining_module(target) if through_faces else target.module
                for target in imported
                if (in_functions or not target.in_function) and (for_types or not target.for_types)
            )
            - {name}
            for name, imported in self.imports.items()
        }

    def defining_module(self, target: Import) -> str:
        """Follow an imported name from face to face to the module that defines it."""
        module, name = target.module, target.name
        while name is not None and name in self.modules[module].face:
            module = self.modules[module].face[name]
        return module

    @property
    def files(self) -> Sequence[Module]:
        """Modules that are not the mere `__init__` of a package."""
        return [module for module in self.modules.values() if not module.is_package]


def _modules(package: str, folder: Path) -> Iterator[Module]:
    for path in sorted(folder.rglob("*.py")):
        inner = path.relative_to(folder).with_suffix("").parts
        name = ".".join((package, *(part for part in inner if part != "__init__")))
        text, stub = path.read_text("utf-8"), path.with_suffix(".pyi")
        public = stub.read_text("utf-8") if stub.exists() else ""
        base = name if path.name == "__init__.py" else name.rpartition(".")[0]
        statements = [node for node in ast.parse(public).body if isinstance(node, ast.ImportFrom)]
        face = {alias.name: f"{base}.{node.module}" for node in statements for alias in node.names}
        yield Module(name, path, text.count("\n") + public.count("\n"), ast.parse(text), face)


def _imports(module: Module, known: Mapping[str, Module]) -> Sequence[Import]:
    result: list[Import] = []
    faces: dict[str, str] = {}
    """Faces imported as a whole, whose names are then attributes, by the name that they have here."""

    def visit(node: ast.AST, *, in_function: bool, for_types: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                targets: list[tuple[str, str | None]] = [(alias.name, None) for alias in child.names]
                faces.update((alias.asname or alias.name, alias.name) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                targets = list(_named(child, known))
                faces.update((alias.asname or alias.name, f"{child.module}.{alias.name}") for alias in child.names)
            elif isinstance(child, ast.Attribute) and (face := known.get(faces.get(_dotted(child.value), ""))):
                targets = [(face.name, child.attr)] if child.attr in face.face else []
            else:
                inside = in_function or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                typed = for_types or (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test))
                visit(child, in_function=inside, for_types=typed)
                continue
            result.extend(Import(target, name, in_function, for_types) for target, name in targets if target in known)

    visit(module.tree, in_function=False, for_types=False)
    return result


def _dotted(node: ast.expr) -> str:
    """Return the name of a module as code has it; empty for any other expression."""
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _named(statement: ast.ImportFrom, known: Mapping[str, Module]) -> Iterator[tuple[str, str | None]]:
    """Return the module that each name of `from module import name` is, or is in."""
    base = statement.module or ""
    for alias in statement.names:
        full = f"{base}.{alias.name}"
        yield (full, None) if full in known else (base, alias.name)


def circles(graph: Graph) -> list[tuple[str, ...]]:
    """Return the groups of modules that import each other in a circle (Tarjan's strongly connected components)."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    result: list[tuple[str, ...]] = []

    def visit(name: str) -> None:
        order[name] = lowest[name] = len(order)
        stack.append(name)
        for target in sorted(graph[name]):
            if target not in order:
                visit(target)
                lowest[name] = min(lowest[name], lowest[target])
            elif target in stack:
                lowest[name] = min(lowest[name], order[target])
        if lowest[name] == order[name]:
            first = stack.index(name)
            group = tuple(sorted(stack[first:]))
            del stack[first:]
            if len(group) > 1:
                result.append(group)

    for name in sorted(graph):
        if name not in order:
            visit(name)
    return result


def longest_chain(graph: Graph) -> tuple[str, ...]:
    """Return the longest chain of imports; a circle is entered once."""
    best: dict[str, tuple[str, ...]] = {}

    def visit(name: str, above: frozenset[str]) -> tuple[str, ...]:
        if name not in best:
            below = [visit(target, above | {name}) for target in sorted(graph[name]) if target not in above]
            best[name] = (name, *max(below, key=len, default=()))
        return best[name]

    return max((visit(name, frozenset({name})) for name in sorted(graph)), key=len, default=())


def private_functions(house: House) -> Mapping[str, int]:
    """Return how often each private function or method is named in its own module, but for its definition."""
    result = {}
    for module in house.modules.values():
        nodes = list(ast.walk(module.tree))
        uses = Counter(_names(nodes))
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and _is_private(node.name):
                result[f"{module.name}.{node.name}:{node.lineno}"] = uses[node.name]
    return result


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name != "_"


def _names(nodes: Iterable[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr


def free_clauses(house: House) -> float:
    """Return the share of free clauses among the sentences of all docstrings."""
    nodes = (node for module in house.modules.values() for node in ast.walk(module.tree))
    documented = (node for node in nodes if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef))
    sentences = [
        sentence
        for node in documented
        for sentence in re.split(r"(?<=[.:;])\s+", ast.get_docstring(node) or "")
        if len(sentence.split()) > 1
    ]
    return sum(bool(re.search(r"\bwhat\b", sentence, re.IGNORECASE)) for sentence in sentences) / len(sentences)


def repeated(names: Sequence[str]) -> Mapping[str, int]:
    """Return names that exist more than once, the most frequent first."""
    return {name: count for name, count in Counter(names).most_common() if count > 1}


def class_names(house: House) -> Sequence[str]:
    """Return the names of all classes at module level."""
    return [
        node.name for module in house.modules.values() for node in module.tree.body if isinstance(node, ast.ClassDef)
    ]


def importers(graph: Graph) -> Mapping[str, frozenset[str]]:
    """Return which modules import each module."""
    result: dict[str, set[str]] = defaultdict(set)
    for name, targets in graph.items():
        for target in targets:
            result[target].add(name)
    return {name: frozenset(names) for name, names in result.items()}


def figures(house: House) -> Mapping[str, float]:
    """Return the measures that have a bar."""
    named = house.graph(in_functions=True, for_types=False, through_faces=False)
    loaded = house.graph(in_functions=False, for_types=False)
    uses = private_functions(house)
    return {
        "lines": sum(module.lines for module in house.modules.values()),
        "modules": len(house.modules),
        "fan-out": fmean(map(len, named.values())),
        "depth": len(longest_chain(loaded)),
        "circles": len(circles(loaded)),
        "used once": sum(count == 1 for count in uses.values()) / len(uses),
        "free clauses": free_clauses(house),
    }


def measures(house: House) -> Iterator[tuple[str, str, str]]:
    """Return rows of what is measured, its value, and the bar or the peer beside it."""
    barred = figures(house)
    used = house.graph(in_functions=True, for_types=False)
    everything = house.graph(in_functions=True, for_types=True)
    loaded = house.graph(in_functions=False, for_types=False)
    for package, folder in house.rooms.items():
        room = [module.lines for module in house.modules.values() if module.path.is_relative_to(folder)]
        yield f"{package} ({folder.name}/)", f"{sum(room):,} lines, {len(room)} modules", ""
    yield "lines", f"{barred['lines']:,}", f"bar {BARS['lines']:,}"
    yield "modules", f"{barred['modules']}", f"bar {BARS['modules']}; peer 26"
    yield "  of them __init__ files", f"{len(house.modules) - len(house.files)}", ""
    yield "median lines of a module", f"{median(module.lines for module in house.modules.values()):g}", "peer 235"
    yield "  without __init__ files", f"{median(module.lines for module in house.files):g}", ""
    yield "imports per module, mean", f"{barred['fan-out']:.2f}", f"bar {BARS['fan-out']}; peer 2.7"
    yield "  faces followed to modules", f"{fmean(map(len, used.values())):.2f}", ""
    yield "    without those in functions", f"{fmean(map(len, loaded.values())):.2f}", ""
    yield "    with those for types alone", f"{fmean(map(len, everything.values())):.2f}", ""
    yield "import depth, modules", f"{barred['depth']}", f"bar {BARS['depth']}"
    yield "circles when loaded", f"{barred['circles']}", f"bar {BARS['circles']}"
    yield "circles, all imports", f"{len(circles(everything))}", ""
    uses = private_functions(house)
    yield "private functions", f"{len(uses)}", ""
    yield "  used once", f"{barred['used once']:.1%}", f"bar {BARS['used once']:.1%}"
    yield "  never used", f"{sum(not count for count in uses.values())}", ""
    yield "docstring sentences with a free clause", f"{barred['free clauses']:.1%}", f"bar {BARS['free clauses']:.1%}"
    lonely = sum(len(names) == 1 for names in importers(used).values())
    yield "modules that one module imports", f"{lonely}", ""
    yield "class names that exist more than once", f"{len(repeated(class_names(house)))}", ""
    yield "file names that exist more than once", f"{len(repeated([module.path.name for module in house.files]))}", ""


def details(house: House) -> Iterator[str]:
    """Return what a measure consists of, where somebody wants to mend it."""
    loaded, everything = (house.graph(in_functions=choice, for_types=choice) for choice in (False, True))
    yield "longest chain: " + " > ".join(longest_chain(loaded))
    yield from (f"circle when loaded: {', '.join(group)}" for group in circles(loaded))
    yield from (f"circle, all imports: {', '.join(group)}" for group in circles(everything))
    yield "classes: " + ", ".join(f"{name} {count}" for name, count in repeated(class_names(house)).items())
    files = repeated([module.path.name for module in house.files])
    yield "files: " + ", ".join(f"{name} {count}" for name, count in files.items())
    maximum = sorted(everything.items(), key=lambda entry: -len(entry[1]))[:15]
    yield "most imports: " + ", ".join(f"{name} {len(targets)}" for name, targets in maximum)
    longest = sorted(house.modules.values(), key=lambda module: -module.lines)[:15]
    yield "longest modules: " + ", ".join(f"{module.name} {module.lines}" for module in longest)
    unused = [name for name, count in private_functions(house).items() if not count]
    yield "private functions never used: " + ", ".join(unused)


def main() -> None:
    """Print the measures beside the bars and the peer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repository", type=Path, default=Path(__file__).resolve().parents[1])
    parser.add_argument("--list", action="store_true", help="say which modules and names they are")
    options = parser.parse_args()
    house = House(options.repository)
    for subject, value, beside in measures(house):
        print(f"{subject:40} {value:>24}   {beside}".rstrip())
    print(f"\npeer: {PEER}")
    if options.list:
        print("\n".join(("", *details(house))))


if __name__ == "__main__":
    main()
