"""The rules of `docs/explanation/architecture.md`, kept by a walk over the syntax trees.

Packages stand in one order, and a module imports only what stands above its own package.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import excite

ROOT = Path(excite.__file__).parent
MODULES = sorted(
    path.relative_to(ROOT).with_suffix("").as_posix()
    for path in ROOT.rglob("*.py")
    if not path.is_symlink()  # plants of the examples, beside the studies of them
)
modules = pytest.mark.parametrize("module", MODULES)

ORDER = (
    "__init__",
    "progress",
    "description",
    "files",
    "record",
    "policy",
    "report",
    "plant",
    "safety",
    "excitation",
    "simulation",
    "information",
    "estimation",
    "environment",
    "training",
    "rig",
    "study",
    "web",
    "cli",
    "__main__",
)
PLACE = {room: i for i, room in enumerate(ORDER)}
PURE = ("policy", *ORDER[PLACE["plant"] : PLACE["training"] + 1])

DOORS = {
    "gymnasium": ["environment/gymnasium"],
    "stable_baselines3": ["training/ppo"],
    "torch": ["training/ppo"],
    "optax": ["training/gradient"],
    "optuna": ["training/tuning"],
    "safetensors": ["files"],
    "scipy.io": ["record/record"],
    "pandas": ["record/table"],
    "h5py": ["record/formats"],
    "pyarrow": ["record/formats"],
    "mcap": ["record/bags"],
    "rosbags": ["record/bags"],
    "zstandard": ["record/bags"],
    "lz4": ["record/bags"],
    "pydantic": ["study", "report/rows", "report/study_table"],
    "tomlkit": ["study"],
    "dask": ["study/cluster"],
    "distributed": ["study/cluster"],
    "onnx": ["policy/onnx"],
    "blackjax": ["estimation/posterior"],
    "xarray": ["estimation/posterior"],
    "arviz_stats": ["estimation/posterior"],
    "fmpy": ["rig/fmu"],
    "quanser": ["rig/quanser"],
    "matplotlib": ["record/figure", "report"],
    "fastapi": ["web"],
    "starlette": ["web"],
    "uvicorn": ["web"],
    "flask": ["web"],
    "click": ["cli"],
    "rich": ["cli"],
}
WITHOUT_JAX = (
    "progress",
    "description",
    "files",
    "policy",
    "record",
    "safety",
    "rig/contract",
    "rig/player",
    "rig/recorder",
    "rig/loop",
    "rig/quanser",
    "report",
    "web",
)
WORKERS = ("web/jobs", "web/first")
"""What runs in a worker of the page, or writes what a worker would say, and may load JAX there."""

BY_NAME = {
    "study/tasks": ["training/gradient", "training/ppo"],
    "web/workers": ["web/jobs"],
}
"""Modules that are named in a string, for a worker to import them: edges all the same."""

INHERITED = {"derivative", "output", "from_transfer_function"}  # documented by the contract


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse((ROOT / f"{module}.py").read_text(encoding="utf-8"))


def room_of(module: str) -> str:
    return module.split("/")[0]


def belongs(module: str, places: list[str] | tuple[str, ...]) -> bool:
    return any(module == place or module.startswith(f"{place}/") for place in places)


def resolved(name: str) -> str | None:
    """The module behind a path inside the package, a folder by its `__init__`."""
    for module in (name, f"{name}/__init__" if name else "__init__"):
        if module in MODULES:
            return module
    return None


SHOWING = (
    "plot",
    "require_pandas",
    "require_matlab",
    "_require_hdf5",
    "_require_parquet",
    "_require_libraries",
    "_require_least_squares",
    "posterior",
)
"""Functions that import Matplotlib's figures, a package that not every computer has, or one that
takes long to load, when they are called."""


@cache
def _shown(module: str) -> frozenset[ast.AST]:
    """Imports inside these functions."""
    functions = [n for n in ast.walk(tree_of(module)) if isinstance(n, ast.FunctionDef)]
    return frozenset(n for f in functions if f.name in SHOWING for n in ast.walk(f))


@cache
def inner_imports(module: str) -> frozenset[str]:
    """Modules of the package that a module imports, also those it imports when called.

    `excite` itself names every module for type checkers, and imports none.
    """
    found = set()
    if module == "__init__":
        return frozenset()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.ImportFrom) and node.level:
            parents = [".", *module.split("/")][: -node.level]
            base = "/".join([*parents[1:], *(node.module or "").split(".")]).strip("/")
            for alias in node.names:
                target = resolved(f"{base}/{alias.name}".strip("/")) or resolved(base)
                assert target is not None, f"{module}: nothing behind {base}"
                found.add(target)
    return frozenset(found)


def edges(module: str) -> set[str]:
    """Modules that a module imports, or names for a worker to import."""
    return {*inner_imports(module), *BY_NAME.get(module, [])}


def outer_imports(module: str) -> Iterator[str]:
    """Dotted names of what a module imports from outside the package when it runs."""
    for_checkers = [
        node
        for branch in ast.walk(tree_of(module))
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == "TYPE_CHECKING"
        for node in branch.body
    ]
    for node in ast.walk(tree_of(module)):
        if node in for_checkers:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_outer(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def behind(module: str) -> set[str]:
    """Everything that an import of this module loads of the package, itself included."""
    seen, waiting = set(), [module]
    while waiting:
        current = waiting.pop()
        if current not in seen:
            seen.add(current)
            folders = current.split("/")[:-1]
            packages = (resolved("/".join(folders[:i])) for i in range(len(folders) + 1))
            waiting.extend([*inner_imports(current), *(p for p in packages if p)])
    return seen


# ---------------------------------------------------------------------- directions


def test_the_walk_finds_the_imports_it_is_to_judge():
    assert "plant/contract" in inner_imports("plant/aero2")
    assert "description" in inner_imports("plant/aero2")
    assert "estimation/contract" in behind("estimation/arx")
    assert "jax" in set(outer_imports("simulation"))


def test_every_room_has_its_place_in_the_order():
    assert {room_of(module) for module in MODULES} <= PLACE.keys()


@modules
def test_a_module_imports_only_rooms_left_of_its_own(module):
    own = room_of(module)
    for target in edges(module):
        if room_of(target) == own:
            assert "/" in module, f"{module} imports {target} of its own cell"
        else:
            assert PLACE[room_of(target)] < PLACE[own], f"{module} imports {target}"


@modules
def test_no_module_imports_itself_in_a_circle(module):
    seen, waiting = set(), list(edges(module))
    while waiting:
        current = waiting.pop()
        if current not in seen:
            seen.add(current)
            waiting.extend(edges(current))
    assert module not in seen


@modules
def test_modules_in_strings_are_known(module):
    """A name that is imported while the program runs hides an edge from the other tests."""
    strings = [n.value for n in ast.walk(tree_of(module)) if isinstance(n, ast.Constant)]
    words = [w for w in strings if isinstance(w, str) and re.fullmatch(r"excite(\.\w+)+[.:]?", w)]
    named = {word.rstrip(".:").removeprefix("excite.").replace(".", "/") for word in words}
    places = BY_NAME.get(module, [])
    assert [n for n in named if resolved(n) and not any(belongs(p, (n,)) for p in places)] == []


@modules
def test_the_package_is_imported_relatively_inside_itself(module):
    assert not [name for name in outer_imports(module) if is_outer(name, "excite")]


@modules
def test_imports_stand_at_the_top_but_for_the_command_line(module):
    if room_of(module) != "cli":
        imports = (ast.Import, ast.ImportFrom)
        functions = [n for n in ast.walk(tree_of(module)) if isinstance(n, ast.FunctionDef)]
        found = [n for f in functions for n in ast.walk(f) if isinstance(n, imports)]
        # Figures load Matplotlib, which only those who draw one wait for.
        figures = ("from ..report.figure", "from ..record.figure", "from .figure")
        hidden = [n for n in found if not ast.unparse(n).startswith(figures)]
        assert not [node.lineno for node in hidden if node not in _shown(module)]


@modules
def test_third_parties_have_one_door_each(module):
    for name in outer_imports(module):
        for package, doors in DOORS.items():
            if is_outer(name, package):
                assert belongs(module, doors), f"{module} imports {name}"


@pytest.mark.parametrize(
    "module", [m for m in MODULES if belongs(m, WITHOUT_JAX) and m not in WORKERS]
)
def test_what_shows_and_runs_needs_no_jax(module):
    for loaded in behind(module):
        for name in outer_imports(loaded):
            assert not is_outer(name, "jax"), f"{module} loads jax through {loaded}"
            assert not is_outer(name, "equinox"), f"{module} loads equinox through {loaded}"


def test_jax_is_not_loaded_through_third_parties_either():
    rooms = [m for m in MODULES if belongs(m, WITHOUT_JAX) and m not in ("rig/quanser", *WORKERS)]
    names = ", ".join("excite." + m.replace("/", ".").removesuffix(".__init__") for m in rooms)
    code = f"import sys, {names}; print(*sorted({{'jax', 'jaxlib', 'equinox'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_rig_of_a_laboratory_computer_uses_only_what_needs_no_jax():
    allowed = {"__init__", "description", "files", "record", "policy", "safety", "rig"}
    for module in MODULES:
        if belongs(
            module, ("rig/contract", "rig/player", "rig/recorder", "rig/loop", "rig/quanser")
        ):
            assert {room_of(m) for m in behind(module)} <= allowed, module


# ------------------------------------------------------------------ silent and pure


@modules
def test_only_the_command_line_prints(module):
    if room_of(module) != "cli":
        calls = [n.func for n in ast.walk(tree_of(module)) if isinstance(n, ast.Call)]
        assert not [f.lineno for f in calls if isinstance(f, ast.Name) and f.id == "print"]


@modules
def test_there_is_no_assert_outside_tests(module):
    assert not [n.lineno for n in ast.walk(tree_of(module)) if isinstance(n, ast.Assert)]


READS = (
    "policy",
    "plant/catalogue",
    "excitation/catalogue",
    "estimation/identify",
    "estimation/prior_knowledge",
    "estimation/result",
    "training/design",
)
"""Modules of the pure packages that take a file's name from their caller."""


@pytest.mark.parametrize("module", [m for m in MODULES if room_of(m) in PURE])
def test_from_plant_to_training_there_is_no_file_clock_log_or_global_state(module):
    forbidden = ("logging", "time", "datetime", "random", "os", "io", "pathlib", "numpy.random")
    for name in outer_imports(module):
        if name == "pathlib.Path" and belongs(module, READS):
            continue
        assert not any(is_outer(name, package) for package in forbidden), name
    for node in ast.walk(tree_of(module)):
        text = ast.unparse(node) if isinstance(node, ast.Attribute | ast.Call) else ""
        # Stable-Baselines3 shuffles with NumPy's global state, which checkpoints must keep.
        if module == "training/ppo" and text.startswith(("np.random.get", "np.random.set")):
            continue
        if module == "plant/contract" and text.startswith("jax.config.update"):
            continue  # double precision, switched in this one place
        assert not text.startswith(("np.random.", "open(", "jax.config.update"))


# -------------------------------------------------------------------- names, words


@modules
def test_no_room_is_named_after_no_subject(module):
    assert not {"utils", "helpers", "common", "core", "misc", "types", "base"} & set(
        module.split("/")
    )


Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions(module: str) -> list[Function]:
    return [n for n in ast.walk(tree_of(module)) if isinstance(n, Function)]


def arguments(function: Function) -> list[ast.arg]:
    a = function.args
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
    return [arg for arg in every if arg.arg not in ("self", "cls")]


def public(module: str) -> Iterator[ast.ClassDef | Function]:
    """Public classes and functions of a module, and public methods of public classes."""
    waiting: list[ast.stmt] = list(tree_of(module).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node
            waiting.extend(node.body)
        elif isinstance(node, Function):
            inherited = room_of(module) == "plant" and module != "plant/contract"
            special = node.name.startswith("__") and node.name != "__call__"
            private = node.name.startswith("_") and not node.name.startswith("__")
            if not (private or special or (inherited and node.name in INHERITED)):
                yield node


@modules
def test_everything_public_is_documented(module):
    assert ast.get_docstring(tree_of(module)), f"{module} has no docstring"
    missing = [node.name for node in public(module) if not ast.get_docstring(node)]
    assert not missing


@modules
def test_everything_public_is_annotated(module):
    for node in public(module):
        if isinstance(node, Function):
            assert node.returns is not None, f"{module}.{node.name} has no return annotation"
            bare = [arg.arg for arg in arguments(node) if arg.annotation is None]
            assert not bare, f"{module}.{node.name}: {bare}"
