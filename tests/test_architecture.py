"""Rules of the tree: folders import one way, MuJoCo stays where it belongs, only the console prints, examples run."""

import ast
import importlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "planner"
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts]
FILES = {path: path.relative_to(PACKAGE) for path in sorted(PACKAGE.rglob("*.py"))}

# Data flow down this list: a folder imports only from those before it. docs/architecture.md has the same table.
FOLDERS = [
    "base", "model", "kernels", "dynamics", "problem", "solvers", "proof", "control", "cases", "sweeps", "view",
    "paper", "cli",
]  # fmt: skip


def module_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


@cache
def read(path):
    """Modules that a file imports, wherever in it but in Mechanism.from_mjcf, and whether it prints.

    The trees themselves are not kept: half a million nodes would slow down every fork and every search for garbage.
    """
    found, prints, skipped = [], False, set()
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    for node in nodes:
        if isinstance(node, ast.ClassDef) and node.name == "Mechanism":
            reading = [child for child in node.body if getattr(child, "name", "") == "from_mjcf"]
            skipped |= {id(child) for function in reading for child in ast.walk(function)}
        prints |= isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    for node in nodes:
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.append(full if full in MODULES else str(node.module))
    return tuple(found), prints


def imports(path):
    return read(path)[0]


def test_folders_import_from_those_before_them():
    upwards = []
    for path, name in FILES.items():
        here = name.parts[0]
        for module in imports(path):
            words = module.split(".")
            known = words[0] == "planner" and len(words) > 1 and here in FOLDERS and words[1] in FOLDERS
            if known and FOLDERS.index(words[1]) > FOLDERS.index(here):
                upwards.append(f"{name} imports {module}")
    assert upwards == []


def test_every_file_is_in_a_folder_of_the_table():
    outside = {name.parts[0] for name in FILES.values()} - set(FOLDERS)
    assert outside == {"__init__.py", "__main__.py", "constraints.py", "contact.py", "costs.py"}


def test_no_file_imports_itself_by_way_of_others():
    arrows = {module: {m for m in imports(path) if m in MODULES and m != module} for module, path in MODULES.items()}
    done, way = set(), []

    def follow(module):
        if module in way:
            pytest.fail(f"a circle: {' -> '.join(way[way.index(module) :])}")
        if module in done or module == "planner":
            return
        way.append(module)
        for target in sorted(arrows[module]):
            follow(target)
        done.add(way.pop())

    for module in MODULES:
        follow(module)


def test_mujoco_is_loaded_by_one_file_and_used_by_the_folders_that_read_replay_and_draw():
    for path, name in FILES.items():
        assert "mujoco" not in {module.split(".")[0] for module in imports(path)}
        text = path.read_text(encoding="utf-8")
        assert 'import_module("mujoco")' not in text or path.name == "gl.py"
        if "load_mujoco" in text:
            assert name.parts[0] in ("base", "model", "proof", "view"), name


def test_only_the_console_prints():
    printing = {path.name for path in FILES if read(path)[1]}
    assert "console.py" in printing  # the search finds it
    assert printing <= {"console.py", "video.py", "drawing.py"}  # a child that draws answers by lines on a pipe


def test_no_module_has_the_name_of_a_public_function():
    import planner

    functions = {name for name in planner.__all__ if callable(getattr(planner, name))}
    assert functions.isdisjoint(module.rsplit(".", 1)[1] for module in MODULES if "." in module)


def test_no_part_of_a_namespace_has_the_name_of_one_of_its_functions():
    """Whichever was imported last would be what the name stands for."""
    import planner

    for space in (planner.dynamics, planner.paper, planner.proof):
        parts = {module.rsplit(".", 1)[1] for module in MODULES if module.rpartition(".")[0] == space.__name__}
        assert parts.isdisjoint(space.__all__)


def test_import_is_light():
    """`import planner` must not choose an OpenGL library for the user, nor draw in matplotlib."""
    heavy = "{'mujoco', 'matplotlib', 'imageio', 'PIL', 'scipy', 'numba'}"
    code = f"import sys, planner; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_exist_and_are_documented():
    import planner

    for name in planner.__all__:
        assert getattr(planner, name).__doc__, name


def test_stubs_write_each_public_name_on_a_line_of_its_own():
    """planner/base/late_imports.py reads them line by line."""
    for stub in PACKAGE.rglob("__init__.pyi"):
        lines = [node for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
        names = [alias for line in lines for alias in line.names]
        assert len(names) == len(lines)
        assert all(alias.asname == alias.name for alias in names)
        package = ".".join(stub.relative_to(PACKAGE.parent).parent.parts)
        assert sorted(alias.name for alias in names) == importlib.import_module(package).__all__


def test_an_unknown_public_name_gets_the_nearest_one():
    import planner

    with pytest.raises(AttributeError, match=r"has no attribute 'solv'\. Did you mean 'solve'\?"):
        planner.solv  # noqa: B018


def test_public_names_are_about_forty_and_nothing_else_is_there():
    import planner

    assert len(planner.__all__) <= 49  # FixedPlanController is how a plan is applied to a machine with feet
    assert set(planner.__all__) <= set(dir(planner))
    assert not hasattr(planner, "nonsense")
    for namespace in (planner.contact, planner.costs, planner.dynamics, planner.paper, planner.proof):
        for name in namespace.__all__:
            assert getattr(namespace, name) is not None


@pytest.fixture
def run_python(tmp_path, monkeypatch):
    """Runs a program in this process and an empty folder; its proofs leave out the perturbed rollouts."""
    import planner

    prove = planner.prove
    monkeypatch.setattr(planner, "prove", lambda plan, **options: prove(plan, **options | {"rollouts": 0}))
    monkeypatch.chdir(tmp_path)

    def run(text, names=None):
        names = {} if names is None else names
        names["__name__"] = "__main__"
        exec(compile(text, "program", "exec"), names)

    return run


def test_the_example_plans_proves_and_saves(tmp_path, run_python, monkeypatch, capsys):
    script = (ROOT / "examples" / "plan_then_simulate.py").read_text(encoding="utf-8")
    assert len(script.splitlines()) <= 45
    monkeypatch.setattr(sys, "argv", ["plan_then_simulate.py", "--no-video"])
    with pytest.raises(SystemExit) as end:
        run_python(script)
    assert end.value.code == 0
    assert "PASS" in capsys.readouterr().out
    assert (tmp_path / "hopper.npz").is_file()


def python_blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)


def test_the_readmes_python_blocks_run(run_python):
    blocks = python_blocks(ROOT / "README.md")
    assert blocks
    for block in blocks:
        run_python("\n".join(line for line in block.splitlines() if "render_video" not in line))


def test_local_links_of_the_documents_exist():
    for page in [ROOT / "README.md", *PAGES, ROOT / "mjcf" / "README.md"]:
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
        for target in re.findall(r'src="([^":]+)"', page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT / "docs").as_posix())
def test_python_blocks_of_the_documents_run(page, run_python):
    """Each by itself, but for tutorials, whose blocks follow one another."""
    names = {} if page.parent.name == "tutorials" else None
    for block in python_blocks(page):
        run_python(block, names)
