"""The public names: one sorted list, documented, lazy, light to import, and found by type checkers too."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import jaxpomdp

PACKAGE = Path(jaxpomdp.__file__).parent
HEAVY = ("chex", "gymnasium", "matplotlib", "optax", "tqdm", "tyro")
EXTRAS = ("PIL", "equinox", "ray", "tensorboardX")
BRIDGES = ("jaxpomdp.cli", "jaxpomdp.envs.gym")
"""Modules whose whole purpose is a library that need not be there."""


def modules() -> list[str]:
    found = pkgutil.walk_packages([str(PACKAGE)], prefix="jaxpomdp.")
    return ["jaxpomdp", *sorted(module.name for module in found)]


def public_members(module: ModuleType) -> Iterator[tuple[str, object]]:
    """Give the classes and functions that a module defines under a public name."""
    for name, value in vars(module).items():
        home = getattr(value, "__module__", None)
        if not name.startswith("_") and home == module.__name__ and callable(value):
            yield f"{home}.{name}", value
            if inspect.isclass(value):
                yield from public_methods(f"{home}.{name}", value)


def public_methods(owner: str, cls: type) -> Iterator[tuple[str, object]]:
    for name, value in vars(cls).items():
        plain = (
            value.fget if isinstance(value, property) else inspect.unwrap(getattr(value, "__func__", value))
        )
        if not name.startswith("_") and inspect.isfunction(plain) and not inherited(cls, name):
            yield f"{owner}.{name}", plain


def inherited(cls: type, name: str) -> bool:
    """Say whether a base class already documents the method (a tuple's, an environment's, a protocol's)."""
    return any(inspect.getdoc(getattr(base, name, None)) for base in cls.__mro__[1:])


def run_fresh(code: str) -> str:
    """Run code in a new interpreter and give what it printed."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_public_names_are_sorted_and_unique() -> None:
    assert list(jaxpomdp.__all__) == sorted(set(jaxpomdp.__all__))
    assert set(jaxpomdp.__all__) <= set(dir(jaxpomdp))


@pytest.mark.parametrize("name", jaxpomdp.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    value = getattr(jaxpomdp, name)
    if callable(value):
        doc = (inspect.getdoc(value) or "").strip()
        assert len(doc) > 20, f"jaxpomdp.{name} needs a docstring that explains it"
        assert not doc.startswith(f"{name}("), f"jaxpomdp.{name} shows only its signature"


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    branch = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname: node.module
        for node in branch.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == jaxpomdp._HOMES


def test_an_unknown_name_is_refused_by_name() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        jaxpomdp.no_such_name  # noqa: B018


def test_rooms_are_reached_as_attributes() -> None:
    found = run_fresh("import jaxpomdp; print(jaxpomdp.kernels.__name__, jaxpomdp.numerics.NEG)")
    assert found.split() == ["jaxpomdp.kernels", "-1e+30"]


def test_the_import_is_light() -> None:
    loaded = run_fresh("import sys, jaxpomdp; print(*sys.modules)").split()
    assert not set(HEAVY) & set(loaded)


def test_every_room_but_the_bridges_loads_without_the_extras() -> None:
    """On a bare accelerator box neither Gymnasium nor the command line's libraries are installed."""
    bare = [name for name in modules() if not name.startswith(BRIDGES)]
    block = f"import sys; sys.modules.update(dict.fromkeys({(*HEAVY, *EXTRAS)!r}))"
    run_fresh(f"{block}\nimport importlib\nfor name in {bare!r}: importlib.import_module(name)")


def test_the_import_takes_hardly_longer_than_that_of_jax() -> None:
    code = (
        "import time; from importlib import import_module as load; a = time.perf_counter(); load('jax');"
        "load('jax.numpy'); b = time.perf_counter(); load('jaxpomdp'); print(time.perf_counter() - b)"
    )
    assert min(float(run_fresh(code)) for _ in range(2)) < 0.3


def test_every_folder_of_code_is_a_package() -> None:
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    assert [folder.name for folder in folders if not (folder / "__init__.py").exists()] == []


@pytest.mark.parametrize("name", modules())
def test_everything_public_is_documented(name: str) -> None:
    module = importlib.import_module(name)
    assert inspect.getdoc(module), f"{name} needs a docstring"
    bare = [label for label, value in public_members(module) if not inspect.getdoc(value)]
    assert bare == [], f"no docstring: {bare}"
