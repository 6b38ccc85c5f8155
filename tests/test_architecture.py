"""Rules of the tree: data flow one way, MuJoCo stays where it belongs, only the console prints, examples run."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "planner"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# Reading order; nothing imports from a later line. Names of one line are siblings.
ORDER = [
    ["errors", "jsonable", "versions"],
    ["figures", "stage", "pictures"],
    ["arguments", "files", "gl", "digests"],
    ["mjcf_bounds"],
    ["mjcf"],
    ["space"],
    ["contact", "joint_curves"],
    ["body_contact"],
    ["mechanism"],
    ["mechanism_refusals"],
    ["contact_shapes"],
    ["mechanism_contacts"],
    ["contact_edits", "mechanism_edits"],
    ["mechanism_reader"],
    ["twin", "archive"],
    ["driven_twin"],
    ["default_appearance"],
    ["poe"],
    ["poe_sensitivities"],
    ["kernels"],
    ["rigid_body"],
    ["momentum"],
    ["body_contact_places"],
    ["contact_forces"],
    ["statics"],
    ["dynamics"],
    ["rates"],
    ["weights"],
    ["closing"],
    ["cost"],
    ["frame_cost"],
    ["penalty_terms"],
    ["penalty_measures"],
    ["penalty_cost"],
    ["state_ranges"],
    ["limits"],
    ["energy_cost"],
    ["problem"],
    ["jerk"],
    ["drive_cost"],
    ["objective"],
    ["stored_problem"],
    ["plan"],
    ["box", "lq"],
    ["engine"],
    ["augmented"],
    ["multistart"],
    ["slq"],
    ["guess", "spline", "spline_basis", "gradient_methods"],
    ["adjoint"],
    ["continuous", "underactuated"],
    ["control_spline", "shooting"],
    ["cases"],
    ["problem_keys"],
    ["problem_file"],
    ["ranges", "touches", "curve_callback"],
    ["replay"],
    ["hold"],
    ["proof"],
    ["finer", "warm_start"],
    ["ends"],
    ["periodic"],
    ["free_time"],
    ["refine", "payload"],
    ["check", "run_folder"],
    ["camera", "film", "drawing", "overlay", "scene", "shapes", "encode", "render"],
    ["plots"],
    ["report"],
    ["paper_studies"],
    ["console"],
    ["commands"],
    ["__main__", "__init__"],
]
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}


def module_of(path):
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path):
    """(imported module, inside a function or under TYPE_CHECKING) for every import of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    lazy = set()
    for node in ast.walk(tree):
        guarded = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if guarded or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            lazy |= {id(child) for child in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) in lazy
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            module = node.module or ""
            names = [f"planner.{alias.name}" for alias in node.names] if module == "planner" else [module]
            for name in names:
                yield name, id(node) in lazy


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_nothing_imports_upwards(path):
    here = RANK[module_of(path)]
    for name, lazy in imports(path):
        if name.startswith("planner.") and not lazy and module_of(path) != "__init__":
            assert RANK[name.split(".")[1]] <= here, f"{path.name} imports {name}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_mujoco_is_imported_by_gl_alone(path):
    """And gl's load_mujoco is used where models are read, replayed and drawn, never where plans are made."""
    names = [name.split(".")[0] for name, _ in imports(path)]
    assert "mujoco" not in names
    assert 'import_module("mujoco")' not in path.read_text(encoding="utf-8") or path.name == "gl.py"
    users = {"gl", "mechanism_reader", "mechanism_refusals", "mechanism_contacts", "replay", "proof", "render", "scene"}
    users |= {"camera", "ranges", "touches", "hold", "drawing", "refine", "shapes", "driven_twin", "contact_shapes"}
    users |= {"curve_callback"}
    if "load_mujoco" in path.read_text(encoding="utf-8"):
        assert module_of(path) in users


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_the_console_prints(path):
    calls = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)]
    printing = [n for n in calls if isinstance(n.func, ast.Name) and n.func.id == "print"]
    # render's child process answers its parent by lines on a pipe
    assert not printing or path.name in ("console.py", "render.py")


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


def test_public_names_are_the_ones_that_type_checkers_see():
    """What is imported when it is asked for, `__all__` and the imports for type checkers name the same things."""
    import planner

    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == planner._HOME | {"cases": "planner"}
    assert sorted(seen) == sorted(planner.__all__)
    assert set(planner.__all__) <= set(dir(planner))


def test_functions_go_before_modules_of_the_same_name():
    code = """
import planner.check, planner.refine, planner.rigid_body
from planner import *
from planner import refine as imported
assert callable(planner.check) and callable(planner.replay)
assert callable(planner.refine) and imported is refine is planner.refine
assert planner.dynamics.algorithms.rnea is planner.rnea and planner.view.plots.plot_plan and planner.cases is cases
assert not hasattr(planner, "nonsense") and not hasattr(planner, "_nonsense")
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_example_runs(tmp_path):
    script = ROOT / "examples" / "plan_then_simulate.py"
    assert len(script.read_text().splitlines()) <= 45
    done = subprocess.run(
        [sys.executable, str(script), "--no-video"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "PASS" in done.stdout
    assert (tmp_path / "hopper.npz").is_file()


def test_readme_python_block_runs(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    assert blocks
    for block in blocks:
        code = "\n".join(line for line in block.splitlines() if "render_video" not in line)
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr


def test_local_links_of_the_documents_exist():
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "mjcf" / "README.md"]:
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
        for target in re.findall(r'src="([^":]+)"', page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda p: p.name)
def test_python_blocks_of_the_documents_run(page, tmp_path):
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S):
        done = subprocess.run([sys.executable, "-c", block], cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
