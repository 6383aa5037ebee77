"""Size and structure of the product: lines, import circles, settings and code that nothing reaches.

    python benchmarks/structure.py [REVISION] [--json FILE] [--list FIGURE]

The working tree is measured unless a git revision is given. `--list` prints the places behind a figure of the table. Names are compared, not
resolved: a method counts as used if an attribute of its name is used anywhere. The figures are therefore lower bounds.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import subprocess
import tarfile
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("gsplat_core", "operators", "services")
NATIVE = {".cpp", ".h", ".hpp", ".cu", ".cuh"}
MAX_FLAT_FILES = 15
MAX_COLUMNS = 120
DIALECT = ("What", "How", "Of", "Whether", "Which", "As", "By")
SETTINGS = re.compile(r"(Settings|Config|Options|Limits|Rates|Budget)$")
PATH = re.compile(r"[\w.:\[\]| ,;()]+")
IDENTIFIER = re.compile(r"[A-Za-z_]\w*")

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
Places = dict[str, list[tuple[str, int]]]
"""Name to the places (file, line) that use it."""


def parsed(root: Path, folders: Iterable[str]) -> dict[str, ast.Module]:
    """Return the syntax trees of all Python files below the folders, by path relative to the root."""
    files = (path for folder in folders for path in sorted((root / folder).rglob("*.py")))
    return {str(path.relative_to(root)): ast.parse(path.read_text(encoding="utf-8")) for path in files}


@cache
def nodes(tree: ast.AST) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree))


def dotted(node: ast.AST) -> str:
    """Return the last name of an expression such as `module.name(...)`."""
    while isinstance(node, ast.Call | ast.Subscript):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of strings that stand alone: docstrings of modules, classes, functions, fields and constants."""
    for node in nodes(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value


def code_lines(tree: ast.Module, lines: list[str]) -> int:
    """Return the number of lines of code: without strings that stand alone, comments and blank lines."""
    prose = {
        number
        for node in nodes(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for number in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    return sum(
        number not in prose and line.strip() != "" and not line.lstrip().startswith("#")
        for number, line in enumerate(lines, 1)
    )


class Uses:
    """Places (file, line) where names and attributes are used, other than by imports. Strings that only contain names count as both."""

    def __init__(self, trees: dict[str, ast.Module]) -> None:
        self.names: Places = defaultdict(list)
        self.attributes: Places = defaultdict(list)
        for file, tree in trees.items():
            prose = {id(each.value) for each in nodes(tree) if isinstance(each, ast.Expr)}
            imports = [each for each in nodes(tree) if isinstance(each, ast.Import | ast.ImportFrom)]
            imported = {(alias.asname or alias.name).split(".")[0] for each in imports for alias in each.names}
            for node in nodes(tree):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                    self.names[node.id].append((file, node.lineno))
                elif isinstance(node, ast.Attribute):
                    self.attributes[node.attr].append((file, node.lineno))
                    if isinstance(node.value, ast.Attribute) or dotted(node.value) in imported:
                        self.names[node.attr].append((file, node.lineno))
                elif isinstance(node, ast.Call) and dotted(node) == "getattr":
                    parts = [each.values[0] for each in node.args if isinstance(each, ast.JoinedStr)]
                    prefixes = tuple(str(each.value) for each in parts if isinstance(each, ast.Constant))
                    computed = [each.name for each in nodes(tree) if isinstance(each, Definition)]
                    for name in filter(lambda each: each.startswith(prefixes), computed):
                        self.attributes[name].append((file, node.lineno))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
                    for name in IDENTIFIER.findall(node.value) if PATH.fullmatch(node.value) else ():
                        self.names[name].append((file, node.lineno))
                        self.attributes[name].append((file, node.lineno))


def documented(root: Path) -> str:
    """Return the text of the examples and of the Python blocks of the documents."""
    texts = [path.read_text(encoding="utf-8") for path in (root / "examples").rglob("*.py")]
    for path in [root / "README.md", *(root / "docs").rglob("*.md")]:
        texts += (
            re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL) if path.exists() else []
        )
    return "\n".join(texts)


def definitions(tree: ast.Module, classes: set[str]) -> Iterator[tuple[str, Definition]]:
    """Yield classes, functions and methods with their qualified names.

    Functions that a decorator registers are left out, and methods of a class that derives from another library's.
    """

    def walk(node: ast.AST, prefix: str) -> Iterator[tuple[str, Definition]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, Definition):
                registered = any(isinstance(each, ast.Call | ast.Attribute) for each in child.decorator_list)
                if isinstance(child, ast.ClassDef) or not (registered or child.name.startswith("__")):
                    yield prefix + child.name, child
                if isinstance(child, ast.ClassDef) and all(dotted(each) in classes for each in child.bases):
                    yield from walk(child, f"{prefix}{child.name}.")
            elif isinstance(child, ast.If | ast.Try):
                yield from walk(child, prefix)

    yield from walk(tree, "")


def unreached(product: dict[str, ast.Module], others: Uses, documents: set[str]) -> tuple[list[str], list[str]]:
    """Return what only tests, benchmarks or the oracles use, and what nothing uses. Uses inside of such code do not count."""
    reachable = {file: tree for file, tree in product.items() if not re.search("/(reference|migrations)/", file)}
    found = Uses(reachable)
    oracles = Uses({file: tree for file, tree in product.items() if "/reference/" in file})
    classes = {each.name for tree in product.values() for each in nodes(tree) if isinstance(each, ast.ClassDef)}
    classes |= {"Protocol", "Generic", "ABC", "Exception", "ValueError", "RuntimeError"}
    left = [(file, name, node) for file, tree in reachable.items() for name, node in definitions(tree, classes)]
    dead: set[tuple[str, int]] = set()
    only_tests, nothing = [], []
    while True:
        before = len(left)
        for entry in list(left):
            file, name, node = entry
            own = {(file, line) for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)}
            places = (found.attributes if "." in name else found.names).get(node.name, ())
            if node.name in documents or any(place not in own and place not in dead for place in places):
                continue
            left.remove(entry)
            tested = any(node.name in uses.names or node.name in uses.attributes for uses in (others, oracles))
            (only_tests if tested else nothing).append(f"{file}:{node.lineno} {name}")
            dead |= own
        if len(left) == before:
            return sorted(only_tests), sorted(nothing)


def settings_fields(product: dict[str, ast.Module]) -> Iterator[tuple[str, str, str]]:
    """Yield (place, class, field) of settings dataclasses, without those of the command line."""
    for file, tree in product.items():
        if file.startswith("services/cli"):
            continue
        for node in nodes(tree):
            if not isinstance(node, ast.ClassDef) or not SETTINGS.search(node.name):
                continue
            if not any(dotted(each) == "dataclass" for each in node.decorator_list):
                continue  # models of pydantic, whose fields are the input of a user
            for each in node.body:
                if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name):
                    kind = ast.unparse(each.annotation)
                    if each.value is not None and not ("Option(" in kind or kind.startswith("ClassVar")):
                        yield f"{file}:{each.lineno}", node.name, each.target.id


def assigned(trees: dict[str, ast.Module], fields: dict[str, list[str]]) -> set[tuple[str, str]]:
    """Return (class, field) that a call passes: to the class, or by the field's name to `replace`, `cls` or `dict`."""
    found = set()
    for tree in trees.values():
        for node in nodes(tree):
            if not isinstance(node, ast.Call):
                continue
            callee = dotted(node.func)
            names = [each.arg for each in node.keywords if each.arg]
            if callee in fields:
                names += fields[callee][: len(node.args)]
            for name in names:
                kinds = [callee] if callee in fields else [kind for kind in fields if name in fields[kind]]
                if callee in fields or callee in ("replace", "cls", "dict"):
                    found |= {(kind, name) for kind in kinds}
    return found


def unset_settings(
    product: dict[str, ast.Module], others: dict[str, ast.Module], documents: str
) -> tuple[list[str], list[str]]:
    """Return settings fields that nothing sets, and those that only tests and benchmarks set. Options and documents count as setters."""
    places = list(settings_fields(product))
    fields: dict[str, list[str]] = defaultdict(list)
    for _place, kind, name in places:
        fields[kind].append(name)
    text = "\n".join(ast.unparse(tree) for file, tree in product.items() if file.endswith("operators/settings.py"))
    users = {*re.findall(r"^ +(\w+): ", text, re.MULTILINE), *re.findall(r"\b(\w+)=", documents)}
    by_product, by_others = assigned(product, fields), assigned(others, fields)
    nothing, only_tests = [], []
    for place, kind, name in places:
        if (kind, name) not in by_product and name not in users:
            (only_tests if (kind, name) in by_others else nothing).append(f"{place} {kind}.{name}")
    return nothing, only_tests


def imports(product: dict[str, ast.Module], everything: bool) -> dict[str, set[str]]:
    """Return the modules that each module imports: when it is loaded, or also inside of functions and for type checkers only."""
    names = {file.removesuffix(".py").removesuffix("/__init__").replace("/", "."): file for file in product}

    def targets(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in names else node.module

    def loaded(node: ast.AST) -> Iterator[ast.AST]:
        for child in ast.iter_child_nodes(node):
            typed = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
            if not typed and not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                yield child
                yield from loaded(child)

    return {
        name: {each for node in (nodes if everything else loaded)(product[file]) for each in targets(node)}
        & (set(names) - {name})
        for name, file in names.items()
    }


def circles(graph: dict[str, set[str]]) -> list[str]:
    """Return the strongly connected components of more than one module."""

    def reach(edges: dict[str, set[str]], start: str) -> set[str]:
        seen, stack = {start}, [start]
        while stack:
            for each in edges[stack.pop()] - seen:
                seen.add(each)
                stack.append(each)
        return seen

    backwards: dict[str, set[str]] = {name: set() for name in graph}
    for name, targets in graph.items():
        for each in targets:
            backwards[each].add(name)
    left, found = set(graph), []
    while left:
        start = min(left)
        component = reach(graph, start) & reach(backwards, start)
        left -= component
        if len(component) > 1:
            found.append(" ".join(sorted(component)))
    return found


def protocols(product: dict[str, ast.Module]) -> list[str]:
    """Return protocols with their implementers, where there are fewer than two: subclasses, or classes with all members by name."""
    classes = [(file, each) for file, tree in product.items() for each in nodes(tree) if isinstance(each, ast.ClassDef)]
    by_name = {node.name: node for _, node in classes}

    def bases(node: ast.ClassDef) -> list[str]:
        return [dotted(each) for each in node.bases]

    def members(node: ast.ClassDef) -> set[str]:
        own = {each.name for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)}
        own |= {
            each.target.id
            for each in node.body
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
        }
        own |= {
            each.attr for each in nodes(node) if isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store)
        }
        inherited = [members(by_name[each]) for each in bases(node) if each in by_name and by_name[each] is not node]
        return own.union(*inherited)

    found = []
    for file, node in classes:
        if "Protocol" in bases(node):
            wanted = members(node)
            who = {
                each.name
                for _, each in classes
                if each is not node
                and "Protocol" not in bases(each)
                and (node.name in bases(each) or wanted <= members(each))
            }
            if len(who) < 2 and wanted != {"__call__"}:
                found.append(f"{file}:{node.lineno} {node.name} {sorted(who)}")
    return found


def numeric_constants(product: dict[str, ast.Module]) -> list[str]:
    """Return module constants whose value is a number or an expression of numbers."""
    numeric = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop)
    found = []
    for file, tree in product.items():
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                parts = list(ast.walk(node.value))
                numbers = [each for each in parts if isinstance(each, ast.Constant)]
                if all(isinstance(each, numeric) for each in parts) and all(
                    type(each.value) in (int, float) for each in numbers
                ):
                    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                    found.append(f"{file}:{node.lineno} {ast.unparse(target)}")
    return found


def measure(root: Path) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Return the figures of a tree, and for those that count places the places."""
    product, others = parsed(root, PACKAGES), parsed(root, ("tests", "benchmarks"))
    documents = documented(root)
    figures: dict[str, int] = {}
    lines = {file: (root / file).read_text(encoding="utf-8").splitlines() for file in product}
    for package in PACKAGES:
        own = [file for file in product if file.startswith(package)]
        figures[f"{package}: Python lines"] = sum(len(lines[file]) for file in own)
        figures[f"{package}: modules"] = len(own)
    figures["Python lines"] = sum(len(each) for each in lines.values())
    figures["Python lines without docstrings, comments and blank lines"] = sum(
        code_lines(product[file], lines[file]) for file in product
    )
    figures["modules"] = len(product)
    native = [path for package in PACKAGES for path in (root / package).rglob("*") if path.suffix in NATIVE]
    figures["C++ and CUDA lines"] = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in native)
    flat = Counter(str(Path(file).parent) for file in product if not file.endswith("__init__.py"))
    places: dict[str, list[str]] = {
        "import circles": circles(imports(product, everything=False)),
        "import circles with imports in functions and for types": circles(imports(product, everything=True)),
    }
    places["settings fields that nothing sets"], places["settings fields that only tests set"] = unset_settings(
        product, others, documents
    )
    places["definitions that only tests use"], places["definitions that nothing uses"] = unreached(
        product, Uses(others), set(IDENTIFIER.findall(documents))
    )
    places["protocols with fewer than two implementers"] = protocols(product)
    places["numeric module constants"] = numeric_constants(product)
    places[f"folders of more than {MAX_FLAT_FILES} files"] = [
        f"{n} {folder}" for folder, n in flat.items() if n > MAX_FLAT_FILES
    ]
    places[f"lines over {MAX_COLUMNS} columns"] = [
        f"{file}:{number}"
        for file, each in lines.items()
        for number, line in enumerate(each, 1)
        if len(line) > MAX_COLUMNS
    ]
    places[f"docstrings that begin with {'/'.join(DIALECT)}"] = [
        f"{file}:{line} {text.splitlines()[0]}"
        for file, tree in product.items()
        for line, text in docstrings(tree)
        if text.split(" ")[0] in DIALECT
    ]
    return figures | {name: len(each) for name, each in places.items()}, places


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("revision", nargs="?", help="git revision instead of the working tree")
    parser.add_argument("--json", type=Path, help="write figures and places to this file")
    parser.add_argument("--list", help="print the places behind the figures whose name contains this text")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = ROOT
        if arguments.revision:
            archive = subprocess.run(
                ["git", "archive", arguments.revision], cwd=ROOT, check=True, capture_output=True
            ).stdout
            with tarfile.open(fileobj=io.BytesIO(archive)) as files:
                files.extractall(folder, filter="data")
            root = Path(folder)
        figures, places = measure(root)
    if arguments.json:
        arguments.json.write_text(json.dumps({"figures": figures, "places": places}, indent=2) + "\n")
    for name, value in figures.items():
        print(f"{name:<60} {value:>7}")
        if arguments.list and arguments.list in name:
            print("\n".join(f"    {each}" for each in places.get(name, [])))


if __name__ == "__main__":
    main()
