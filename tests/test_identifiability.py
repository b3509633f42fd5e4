"""Structural identifiability against exact ranks, its words against simulations, its thresholds."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from catalogue import FEW_AND_ALL, PLANTS
from documented import documented_words
from kinetics import Conversion, Product

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.files import json_ready
from excite.information import experiment_information
from excite.information.identifiability import (
    IDENTIFIABLE,
    PRACTICALLY_NOT,
    STRUCTURALLY_NOT,
    UNDETERMINED,
    Structure,
    structure,
)
from excite.plant import AbstractPlant
from excite.plant.extension import extended
from excite.simulation import response

Equation = Callable[[Any, Any, Any], list]


def mass(
    equation: Equation,
    values: dict[str, float],
    measured: Equation = lambda x, u, p: [x[0]],
    dt: float = 0.05,
) -> AbstractPlant:
    """A mass that starts at rest in 0; equations in plain arithmetic, for SymPy as well."""

    class Mass(AbstractPlant):
        definition = PlantDescription(
            name="mass",
            states=(State("x", "m", scale=0.1), State("v", "m/s", scale=0.3)),
            inputs=(Input("F", "N", -5.0, 5.0, amplitude=2.0),),
            outputs=(Output("y", "m", 0.2, noise_sd=1e-3),),
            parameters=tuple(Parameter(name, "", value) for name, value in values.items()),
            dt=dt, substeps=2,
        )  # fmt: skip
        plain = staticmethod(equation), staticmethod(measured)

        def derivative(self, state, input, params):
            return jnp.stack(equation(state, input[0], params))

        def output(self, state, params):
            return jnp.stack(measured(state, None, params))

    return Mass()


def gain(x, u, p):
    return [p.g * x[0]]


CASES: dict[str, tuple[AbstractPlant, tuple[str, ...], dict[str, float]]] = {
    "all seen": (
        mass(lambda x, u, p: [x[1], p.b * u - p.c * x[1] - p.k * x[0]], {"b": 3, "c": 0.7, "k": 9}),
        (), {},
    ),
    "ratio": (
        mass(lambda x, u, p: [x[1], 3 * u - p.c / p.J * x[1] - p.k * x[0]],
             {"J": 2, "c": 0.7, "k": 9}),
        ("J and c cannot be told apart, only the ratio J/c",), {"J": 1.3, "c": 1.3},
    ),
    "product": (
        mass(lambda x, u, p: [x[1], p.a * p.b * u - x[1] - p.k * x[0]], {"a": 2, "b": 0.7, "k": 9}),
        ("a and b cannot be told apart, only the product a b",), {"a": 1.3, "b": 1 / 1.3},
    ),
    "power": (
        mass(lambda x, u, p: [x[1], p.a * p.b * p.b / p.h * u - x[1] - p.k * x[0]],
             {"a": 2, "b": 0.7, "h": 3, "k": 9}),
        ("a, b and h cannot be told apart, only a b^2/h",), {"a": 1.5, "b": 1.3, "h": 2.535},
    ),
    "sum": (
        mass(lambda x, u, p: [x[1], u - (p.a + p.b) * x[1] - p.k * x[0]],
             {"a": 2, "b": 0.7, "k": 9}),
        ("a and b cannot be told apart, only the sum a + b",), {"a": 2.35 / 2, "b": 0.35 / 0.7},
    ),
    "common factor": (
        mass(lambda x, u, p: [x[1], (p.b * u - p.c * x[1] - p.k * x[0]) / p.m],
             {"m": 2, "b": 3, "c": 0.7, "k": 9}),
        ("m, b, c and k cannot be told apart, only their ratios",),
        {"m": 1.3, "b": 1.3, "c": 1.3, "k": 1.3},
    ),
    "scaling": (
        mass(lambda x, u, p: [x[1], p.a * p.b * u - p.h * p.b * p.b * x[1]
                              - p.k * p.h / p.a / p.a * x[0]],
             {"a": 2, "b": 0.7, "h": 3, "k": 9}),
        ("a, b and h cannot be told apart: a s, b s^-1 and h s^2 give the same outputs "
         "for every s",), {"a": 1.3, "b": 1 / 1.3, "h": 1.69},
    ),
    "idle": (
        mass(lambda x, u, p: [x[1], u - p.c * x[1] - p.k * x[0] + 0 * p.z],
             {"c": 0.7, "z": 2, "k": 9}),
        ("z acts on no output",), {"z": 1.9},
    ),
    "three groups": (
        mass(lambda x, u, p: [x[1], p.a * p.b * u - p.c / p.J * x[1] - 9 * x[0] + 0 * p.z],
             {"a": 2, "J": 2, "z": 1, "b": 0.7, "c": 3}),
        ("a and b cannot be told apart, only the product a b",
         "J and c cannot be told apart, only the ratio J/c", "z acts on no output"),
        {"a": 1.3, "b": 1 / 1.3, "J": 1.6, "c": 1.6, "z": 1.9},
    ),
    "gain": (
        mass(lambda x, u, p: [x[1], p.b * u - x[1] - p.k * x[0] - x[0] * x[0]],
             {"g": 2, "b": 0.7, "k": 9}, gain),
        (), {},
    ),
    "linear gain": (
        mass(lambda x, u, p: [x[1], p.b * u - x[1] - p.k * x[0]], {"g": 2, "b": 0.7, "k": 9}, gain),
        ("g and b cannot be told apart, only the product g b",), {"g": 1.3, "b": 1 / 1.3},
    ),
}  # fmt: skip
UNSEEN = [name for name, (_, sentences, _) in CASES.items() if sentences]
cases = pytest.mark.parametrize("name", CASES)
unseen = pytest.mark.parametrize("name", UNSEEN)


@functools.cache
def found(name: str, known: bool = True) -> Structure:
    plant = CASES[name][0]
    result = structure(plant, plant.nominal, initial_state_known=known)
    assert result is not None
    return result


def exact_rank(plant: AbstractPlant, known: bool) -> int:
    """Rank of the output's time derivatives by the unknowns, by SymPy in rational numbers."""
    (equation, measured), names = type(plant).plain, list(plant.nominal._fields)  # pyright: ignore[reportAttributeAccessIssue]
    p = plant.Params(*sympy.symbols(names))
    unknowns = [*p, *([] if known else sympy.symbols("x v"))]
    x, count = sympy.symbols("x v"), len(unknowns) + 4
    u = sympy.symbols(f"u:{count + 1}")  # the input and its derivatives
    slope, y = equation(x, u[0], p), [measured(x, u[0], p)[0]]
    for _ in range(count):
        last = y[-1]
        by_state = sum(sympy.diff(last, s) * f for s, f in zip(x, slope, strict=True))
        by_input = sum(sympy.diff(last, u[i]) * u[i + 1] for i in range(count))
        y.append(by_state + by_input)
    primes = [sympy.prime(i + 5) for i in range(len(p) + len(u) + 2)]
    point = dict(zip([*p, *u], (sympy.Rational(n, 7) for n in primes), strict=False))
    point |= dict.fromkeys(x, 0) if known else {x[0]: sympy.Rational(2, 5), x[1]: sympy.Rational(3)}
    return sympy.Matrix(y).jacobian(unknowns).subs(point).rank()


# ------------------------------------------------------------------------------ rank


@cases
@pytest.mark.parametrize("known", [True, False], ids=["known", "free"])
def test_the_rank_is_that_of_exact_derivatives(name, known):
    result = found(name, known)
    assert result.rank == exact_rank(CASES[name][0], known)
    assert result.num_unknowns == len(CASES[name][0].nominal) + (0 if known else 2)
    lost = result.num_unknowns - result.rank
    groups = result.not_identifiable
    assert lost == sum(len(g.parameters + g.initial_states) - g.num_combinations for g in groups)


@cases
def test_a_gap_of_many_digits_separates_what_is_seen_from_what_is_not(name):
    for known in (True, False):
        result = found(name, known)
        values = np.array(result.singular_values)
        assert np.all(values[: result.rank] > 1e4 * UNDETERMINED)
        assert np.all(values[result.rank :] < 1e-4 * UNDETERMINED)


@pytest.mark.parametrize("name", FEW_AND_ALL)
@pytest.mark.parametrize("known", [True, False], ids=["known", "free"])
def test_every_shipped_plant_is_identifiable(name, known):
    plant = PLANTS[name]
    result = structure(plant, plant.nominal, initial_state_known=known)
    assert result is not None
    assert (result.rank, result.not_identifiable) == (result.num_unknowns, ())
    assert result.singular_values[-1] > 1e-4


@pytest.mark.parametrize(("extension", "known", "sentence"), [
    ("offset_force", True,
     "offset and offset_force cannot be told apart, only the difference offset - offset_force"),
    ("bias_position", False,
     "bias_position and the initial value of position cannot be told apart, only 1 combination "
     "of them"),
])  # fmt: skip
def test_an_extension_that_does_what_the_plant_does_is_named(extension, known, sentence):
    plant = extended(PLANTS["emps"], [extension])
    result = structure(plant, plant.nominal, initial_state_known=known)
    assert result is not None
    assert [g.sentence for g in result.not_identifiable] == [sentence]


def weak(size: float) -> AbstractPlant:
    """A plant in which a and b differ by a small effect alone."""
    return mass(
        lambda x, u, p: [x[1], u - (p.a + p.b) * x[1] - 9 * x[0] - size * p.b * x[1] ** 3],
        {"a": 2, "b": 0.7},
    )


def small(size: float) -> AbstractPlant:
    """A plant in which b hardly acts."""
    return mass(
        lambda x, u, p: [x[1], u - p.a * x[1] - 9 * x[0] - size * p.b * x[1] ** 3],
        {"a": 2, "b": 0.7},
    )


@pytest.mark.parametrize("size", [1e-3, 1e-6, 1e-8])
def test_what_is_hard_to_tell_apart_is_still_told_apart(size):
    plant = weak(size)
    result = structure(plant, plant.nominal, initial_state_known=True)
    assert result is not None
    assert result.not_identifiable == ()
    assert result.singular_values[-1] == pytest.approx(0.6 * size, rel=0.5)


@pytest.mark.parametrize("size", [1e-6, 1e-9])
def test_a_small_effect_counts_as_much_as_a_large_one(size):
    plant = small(size)
    result = structure(plant, plant.nominal, initial_state_known=True)
    assert result is not None
    assert result.not_identifiable == ()
    assert result.singular_values[-1] > 0.1


def test_units_change_nothing():
    ours = found("ratio", True)
    scaled = mass(
        lambda x, u, p: [x[1], 3 * u - 1e15 * p.c / p.J * x[1] - 1e-12 * p.k * x[0]],
        {"J": 2, "c": 0.7e-15, "k": 9e12},
    )
    theirs = structure(scaled, scaled.nominal, initial_state_known=True)
    assert theirs is not None
    np.testing.assert_allclose(theirs.singular_values[:2], ours.singular_values[:2], rtol=1e-6)
    assert theirs.not_identifiable == ours.not_identifiable


@pytest.mark.parametrize("linked", [False, True])
def test_an_unstable_plant_is_judged_by_what_comes_before_it_runs_away(linked):
    """Outputs grow by a factor of e^150, and the sensitivities become parallel."""

    def equation(x, u, p):
        damping = p.c / p.m if linked else p.c
        return [x[1], p.b * u - damping * x[1] + (9 if linked else p.m) * x[0]]

    plant = mass(equation, {"m": 9, "c": 0.7, "b": 1}, dt=0.1)
    result = structure(plant, plant.nominal, initial_state_known=True)
    assert result is not None
    assert [g.parameters for g in result.not_identifiable] == ([("m", "c")] if linked else [])


def test_responses_that_are_not_finite_are_not_judged():
    plant = mass(lambda x, u, p: [1 + p.a * p.b * x[0] ** 2, u], {"a": 5, "b": 5}, dt=0.1)
    assert structure(plant, plant.nominal, initial_state_known=True) is None
    held = mass(lambda x, u, p: [1 + p.a * x[0] ** 2, u], {"a": 5}, dt=0.1)
    seen = structure(held, held.nominal, initial_state_known=True)
    assert seen is not None  # what comes before shows that it is identifiable
    assert seen.rank == 1


# ----------------------------------------------------------------------------- words


@cases
def test_a_sentence_names_what_cannot_be_told_apart_and_what_can(name):
    assert tuple(g.sentence for g in found(name).not_identifiable) == CASES[name][1]


@unseen
def test_what_the_sentence_says_leaves_the_outputs_as_they_are(name):
    plant, _, factors = CASES[name]
    moved = plant.nominal._replace(**{n: f * getattr(plant.nominal, n) for n, f in factors.items()})
    inputs = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (200, 1)))
    ours, theirs = (np.asarray(response(plant, p, inputs)) for p in (plant.nominal, moved))
    np.testing.assert_allclose(theirs, ours, atol=1e-10 * np.abs(ours).max())
    named = {n for g in found(name).not_identifiable for n in g.parameters}
    assert named == factors.keys()


@unseen
def test_the_others_are_identifiable_once_some_are_known(name):
    plant, _, _ = CASES[name]
    held = [n for g in found(name).not_identifiable for n in g.held]
    assert len(held) == len(plant.nominal) - found(name).rank
    inputs = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (200, 1)))
    information = np.asarray(experiment_information(plant, plant.nominal, inputs))
    free = [n not in held for n in plant.nominal._fields]
    block = information[np.ix_(free, free)]
    size = np.sqrt(np.diag(block))
    assert np.linalg.eigvalsh(block / np.outer(size, size))[0] > 1e-4


def test_an_unknown_initial_state_is_an_unknown():
    (group,) = found("linear gain", False).not_identifiable
    assert (group.parameters, group.initial_states) == (("g", "b"), ("x", "v"))
    assert group.sentence == (
        "g, b and the initial values of x and v cannot be told apart, of the parameters only "
        "the product g b"
    )
    plant = Product()  # of A, which is not measured, only k1 times it is determined
    assert not structure(plant, plant.nominal, initial_state_known=True).not_identifiable  # pyright: ignore[reportOptionalMemberAccess]
    (group,) = structure(plant, plant.nominal, initial_state_known=False).not_identifiable  # pyright: ignore[reportOptionalMemberAccess]
    assert group.sentence == (
        "k1, k2 and the initial value of A cannot be told apart, of the parameters only the "
        "sum k1 + k2"
    )


# ------------------------------------------------------------------- before any data


def test_a_plant_is_judged_before_an_experiment():
    result = ex.information(CASES["three groups"][0])
    assert result.identifiability == STRUCTURALLY_NOT
    assert result.verdict[:3] == tuple(
        f"structurally not identifiable: {s}" for s in CASES["three groups"][1]
    )
    assert result.verdict[3].startswith("with a and J known: b, c identifiable; least certain")
    assert [b.cramer_rao_bound for b in result.params.values()] == [None] * 5
    line = "structurally not identifiable (structural test: rank 2 of 5; 5 random parameter values"
    assert line in str(result)
    assert line in result._repr_html_()


def test_an_excitation_that_shows_nothing_is_not_the_plants_fault():
    plant = CASES["all seen"][0]
    idle = ex.information(plant, np.zeros((100, 1)), steps=100)
    assert idle.identifiability == PRACTICALLY_NOT
    assert idle.verdict == tuple(
        f"{n} is practically not identifiable with this excitation" for n in ("b", "c", "k")
    )
    rich = ex.information(plant, "prbs")
    assert rich.identifiability == IDENTIFIABLE
    assert rich.verdict[0].startswith("all parameters identifiable; least certain direction")
    assert rich.structure == found("all seen")


def test_a_weak_excitation_does_not_separate():
    plant = weak(1e-3)
    result = ex.information(plant, "prbs")
    assert result.identifiability == PRACTICALLY_NOT
    assert "practically not identifiable with this excitation" in result.verdict[0]


def test_a_plant_without_inputs_has_a_structure_too():
    result = ex.information(Conversion, steps=20)
    assert result.identifiability == IDENTIFIABLE
    assert result.structure is not None
    assert result.structure.tried == "5 random parameter values, 500 samples"


def test_every_key_is_documented():
    data = json_ready(ex.information(CASES["ratio"][0]).to_dict())
    words = documented_words("information")
    assert {*data, *data["structure"], *data["structure"]["not_identifiable"][0]} <= words
    assert data["structure"]["not_identifiable"][0]["parameters"] == ["J", "c"]


# ----------------------------------------------------------------------- with data


@functools.cache
def identified(name: str, **hold: float) -> ex.Identification:
    plant = CASES[name][0]
    truth = {n: 1.2 * float(v) for n, v in plant.nominal._asdict().items()}
    record = ex.simulate(plant, "prbs", steps=300, params=truth, noise={"y": 1e-5})
    return ex.identify(record, plant, hold=hold)


@pytest.mark.science
@pytest.mark.parametrize("name", ["sum", "scaling"])
def test_a_held_parameter_moves_the_others_as_told(name):
    """Against another fit with the held parameter 1 % larger."""
    result = identified(name)
    (held,) = result.held
    told = next(s for s in result.verdict if s.startswith(f"{held} is structurally not"))
    assert CASES[name][1][0] in told
    more = identified(name, **{held: 1.01 * result.params[held]})
    for other in result.params.keys() - {held}:
        slope = (more.params[other] / result.params[other] - 1) / 0.01
        words = f"{other} {abs(10 * slope):.2g} % {'larger' if slope > 0 else 'smaller'}"
        expected = 10 * slope
        if abs(expected) < 0.5:
            assert f"{other} " not in told.split("makes ")[1]
        else:
            number = float(told.split(f"{other} ")[-1].split(" %")[0])
            assert number == pytest.approx(abs(expected), rel=0.1), words
            assert told.split(f"{other} ")[-1].split(" % ")[1].startswith(words.split()[-1])


@pytest.mark.science
def test_a_parameter_that_only_the_data_hide_is_said_to_be():
    plant = CASES["all seen"][0].changed(initial_state=jnp.array([0.3, 0.0]))
    record = ex.simulate(plant, np.zeros((300, 1)), steps=300)
    result = ex.identify(record, plant, start={"b": 5.0})
    assert result.held == ("b",)
    assert result.verdict[1] == (
        "b is structurally identifiable, but practically not with these data; "
        "10 % more of it changes the other parameters by less than 0.5 %"
    )


def test_a_record_may_show_what_random_inputs_do_not():
    plant = mass(  # an effect far beyond the input's limits
        lambda x, u, p: [x[1], u + p.b * jnp.maximum(u - 50.0, 0.0) - p.c * x[1] - 9 * x[0]],
        {"b": 3, "c": 0.7},
    )
    assert structure(plant, plant.nominal, initial_state_known=True).of("b") is not None  # pyright: ignore[reportOptionalMemberAccess]
    inputs = np.full((1, 40, 1), 60.0)
    seen = structure(plant, plant.nominal, initial_state_known=True, inputs=inputs)
    assert seen is not None
    assert seen.not_identifiable == ()
    assert seen.tried.endswith("and the given inputs, 500 samples")


@pytest.mark.science
def test_a_parameter_held_at_its_bound_or_known_needs_no_explanation():
    assert not [s for s in identified("ratio", J=2.0).verdict if "structurally" in s]
    plant = CASES["all seen"][0]
    d = plant.definition
    bounded = tuple(
        dataclasses.replace(p, upper=10.0) if p.name == "k" else p for p in d.parameters
    )

    class Bounded(type(plant)):
        definition = dataclasses.replace(d, parameters=bounded)

    record = ex.simulate(plant, "prbs", steps=300, params={"k": 14.0})
    result = ex.identify(record, Bounded())
    assert result.held == ("k",)
    assert not [s for s in result.verdict if "structurally" in s]


@pytest.mark.science
def test_data_in_which_nothing_can_be_seen_name_the_structure():
    plant = mass(lambda x, u, p: [x[1], u - x[1] - 9 * x[0] + 0 * p.z], {"z": 2})
    with pytest.raises(
        ValueError, match=r"^structurally not identifiable: z acts on no output; no"
    ):
        ex.identify(ex.simulate(plant, "prbs", steps=100), plant)
