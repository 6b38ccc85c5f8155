"""Functions of JAX and CasADi as dynamics: beside those of NumPy, with the packages where they are, else stand-ins."""

import pickle
import re
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from places import ROOT

import planner
from planner import FunctionDynamics, PlannerError, check_derivatives

NX, NU, DT = 3, 2, 0.05


def rates(x, u, np=np):
    """Of one state; no two sizes are equal, so no axes can be exchanged."""
    return [x[1] * u[0] - x[2], np.sin(x[0]) + u[1] ** 2, x[0] * x[1] - 0.3 * x[2] + u[0]]


def differenced(f, *at):
    """The Jacobians of f by each of its arguments."""
    found = []
    for i, one in enumerate(at):
        columns = []
        for d in 1e-6 * np.eye(len(one)):
            ends = [f(*(value + sign * d if j == i else value for j, value in enumerate(at))) for sign in (1, -1)]
            columns.append((np.asarray(ends[0]) - np.asarray(ends[1])) / 2e-6)
        found.append(np.stack(columns, axis=1))
    return tuple(found)


def stand_in_for_jax(bits=64):
    def vmap(f):
        def mapped(*arguments):
            found = [f(*row) for row in zip(*arguments, strict=True)]
            return tuple(map(np.stack, zip(*found, strict=True))) if isinstance(found[0], tuple) else np.stack(found)

        return mapped

    config, errors = SimpleNamespace(jax_enable_x64=bits == 64), SimpleNamespace(JAXTypeError=ZeroDivisionError)
    return SimpleNamespace(
        numpy=np, config=config, errors=errors, jit=lambda f: f, vmap=vmap, eval_shape=lambda f, *at: f(*at),
        jacfwd=lambda f, argnums: lambda *at: differenced(f, *at),
    )  # fmt: skip


class StandInForCasadi:
    """MX, jacobian and Function, whose maps have their outputs beside each other."""

    class MX:
        @staticmethod
        def sym(name, size):
            return name

    @staticmethod
    def jacobian(called, name):
        return lambda x, u: differenced(lambda *at: called.f(*at), x, u)["xu".index(name)]

    class Function:
        def __init__(self, name, inputs, outputs, sizes=(NX, NU, NX)):
            self.outputs, self.inputs, self.sizes = outputs, inputs, sizes

        def f(self, x, u):
            return np.asarray(self.outputs[0](x, u))

        def n_in(self):
            return len(self.inputs)

        def n_out(self):
            return len(self.outputs)

        def size_in(self, i):
            return self.sizes[i], 1

        def size1_in(self, i):
            return self.sizes[i]

        def size_out(self, i):
            return self.sizes[2], 1

        def __call__(self, x, u):
            return self

        def map(self, K):
            def mapped(x, u):
                assert (x.shape, u.shape) == ((NX, K), (NU, K))
                columns = [[one(*at) for at in zip(x.T, u.T, strict=True)] for one in self.outputs]
                beside = [np.concatenate([np.reshape(row, (NX, -1)) for row in rows], axis=1) for rows in columns]
                found = tuple(SimpleNamespace(full=lambda part=part: part) for part in beside)
                return found if len(found) > 1 else found[0]

            return mapped


def of_stand_in_for_jax(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", stand_in_for_jax())
    return FunctionDynamics.from_jax(rates, NX, NU, DT)


def of_stand_in_for_casadi(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", StandInForCasadi)
    return FunctionDynamics.from_casadi(StandInForCasadi.Function("f", ["x", "u"], [rates]), DT)


def rates_in_jax(x, u):
    return rates(x, u, sys.modules["jax"].numpy)


def of_jax(monkeypatch):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    return FunctionDynamics.from_jax(rates_in_jax, NX, NU, DT)


def of_casadi(monkeypatch):
    casadi = pytest.importorskip("casadi")
    x, u = casadi.SX.sym("x", NX), casadi.SX.sym("u", NU)
    F = casadi.Function("f", [x, u], [casadi.vertcat(*rates(x, u, casadi))])
    return FunctionDynamics.from_casadi(F, DT)


@pytest.fixture(autouse=True)
def bits_as_before():
    """JAX's 64 bits are switched on for the whole process: each test leaves them as they were."""
    jax = sys.modules.get("jax")
    before = jax.config.jax_enable_x64 if jax is not None else False
    yield
    jax = sys.modules.get("jax")
    if isinstance(jax, ModuleType):  # no stand-in
        jax.config.update("jax_enable_x64", before)


MAKERS = pytest.mark.parametrize("make", [of_stand_in_for_jax, of_stand_in_for_casadi, of_jax, of_casadi])


@MAKERS
def test_dynamics_and_derivatives_are_those_of_the_function_in_numpy(make, monkeypatch):
    dynamics = make(monkeypatch)
    assert dynamics.batched
    assert dynamics.has_own_jacobian
    rng = np.random.default_rng(0)
    for N in (1, 3, 8):
        xs, us = rng.normal(size=(N + 1, NX)), rng.normal(size=(N, NU))
        numpy = FunctionDynamics(rates, NX, NU, DT)
        np.testing.assert_allclose(dynamics.step(xs[:-1], us), numpy.step(xs[:-1], us), rtol=1e-12, atol=1e-12)
        for ours, theirs in zip(dynamics.linearize(xs, us), numpy.linearize(xs, us), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8)
    assert check_derivatives(dynamics).passed
    halved = dynamics.with_step(0.5 * DT, "euler")
    np.testing.assert_allclose(halved.step(xs[:1], us[:1])[0], xs[0] + 0.5 * DT * np.array(rates(xs[0], us[0])))


@MAKERS
def test_dynamics_can_be_sent_to_processes(make, monkeypatch):
    """Before and after what is compiled was made; it is not sent."""
    dynamics = make(monkeypatch)
    xs, us = np.ones((3, NX)), np.ones((2, NU))
    expected = dynamics.linearize(xs, us)
    sent = pickle.loads(pickle.dumps(dynamics))
    again = pickle.loads(pickle.dumps(sent))
    for one in (sent, again):
        np.testing.assert_array_equal(one.step(xs[:-1], us), dynamics.step(xs[:-1], us))
        for ours, theirs in zip(one.linearize(xs, us), expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_a_process_of_32_bits_is_told_where_to_switch_on_64(monkeypatch):
    sent = pickle.dumps(of_stand_in_for_jax(monkeypatch))
    monkeypatch.setitem(sys.modules, "jax", stand_in_for_jax(bits=32))
    with pytest.raises(PlannerError, match=r"after import jax in the file that defines f\. It holds for all of JAX"):
        pickle.loads(sent).step(np.ones((1, NX)), np.ones((1, NU)))


@pytest.mark.parametrize("name", ["jax", "casadi"])
def test_a_package_that_is_missing_is_named(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    arguments = (rates, NX, NU, DT) if name == "jax" else (rates, DT)
    with pytest.raises(PlannerError, match=rf"^{name} is not installed.*pip install slq-planner\[{name}\]\.$"):
        getattr(FunctionDynamics, f"from_{name}")(*arguments)


def test_what_jax_cannot_take_is_refused_in_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", stand_in_for_jax(bits=32))
    with pytest.raises(PlannerError, match=r"^JAX computes with 32 bits, .*jax\.config\.update"):
        FunctionDynamics.from_jax(rates, NX, NU, DT)
    monkeypatch.setitem(sys.modules, "jax", stand_in_for_jax())
    for f, words in (
        (3, "f is 3, expected a function"), (lambda x, u: x[:1], r"shape \(1,\), expected \(3,\)"),
        (lambda x, u: 1 // 0, "cannot be traced by JAX"),
        (lambda x, u: np.array(rates(x, u)).astype(np.float32), r"f\(x, u\) is of float32, expected float64"),
    ):  # fmt: skip
        with pytest.raises(PlannerError, match=words):
            FunctionDynamics.from_jax(f, NX, NU, DT)
    with pytest.raises(PlannerError, match="nx is 0"):
        FunctionDynamics.from_jax(rates, 0, NU, DT)


@pytest.mark.parametrize(
    ("F", "words"),
    [
        (rates, "expected a casadi.Function"),
        (StandInForCasadi.Function("f", ["x"], [rates]), "F has 1 inputs and 1 outputs"),
        (StandInForCasadi.Function("f", ["x", "u"], [rates], (NX, NU, 1)), "expected columns"),
    ],
)
def test_what_is_no_function_of_casadi_is_refused_in_a_sentence(F, words, monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", StandInForCasadi)
    with pytest.raises(PlannerError, match=words):
        FunctionDynamics.from_casadi(F, DT)


@pytest.mark.parametrize(("package", "page"), [("jax", "10-jax.md"), ("casadi", "11-casadi.md")])
def test_the_tutorials_run(package, page, capsys):
    """Where the package is installed; the lines that they print are those of the page, but for times."""
    pytest.importorskip(package)
    text = (ROOT / "docs" / "tutorials" / page).read_text(encoding="utf-8")
    names: dict[str, object] = {}
    for block in re.findall(r"^```py\n(.*?)^```", text, re.M | re.S):
        exec(compile(block, page, "exec"), names)
    told = capsys.readouterr().out.splitlines()
    assert told
    for line in re.findall(r"^```text\n(.*?)^```", text, re.M | re.S)[0].splitlines():
        assert line in told
    assert isinstance(names["plan"], planner.Plan)
