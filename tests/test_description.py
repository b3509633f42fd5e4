"""Plain data with a hash that follows the numbers and nothing else."""

import dataclasses
import hashlib
import json
import math
import subprocess
import sys

import pytest
from catalogue import PLANTS

from excite.description import (
    Constant,
    Input,
    Output,
    Parameter,
    PlantDescription,
    Spread,
    State,
    names_of,
    told,
    with_unit,
)

PARTS = ("states", "inputs", "outputs", "parameters", "constants")


def simple(**changes) -> PlantDescription:
    """A small valid description, with some fields changed."""
    fields = {
        "name": "spring",
        "states": (State("x", "m", scale=0.1), State("v", "m/s")),
        "inputs": (Input("force", "N", -2.0, 6.0),),
        "outputs": (Output("position", "m", 0.1, 0.001, 0.0, 0.5, 1.0),),
        "parameters": (Parameter("k", "N/m", 30.0), Parameter("offset", "N", -1.0, positive=False)),
        "constants": (Constant("m", "kg", 2.0),),
        "dt": 0.1,
        "band": (0.1, 2.0),
        "substeps": 3,
    }
    return PlantDescription(**{**fields, **changes})


def test_what_has_no_unit_is_shown_without_brackets():
    assert (with_unit("pitch", "deg"), with_unit("answer", "")) == ("pitch [deg]", "answer")
    shown = repr(
        simple(inputs=(Input("price", "", 0.0, 2.0),), outputs=(Output("answer", "", scale=1.0),))
    )
    assert shown.splitlines()[1:3] == ["  input price: 0 to 2", "  output answer"]


def test_hash_is_the_sha256_of_the_canonical_json():
    description = simple()
    data = {"format": 1, **dataclasses.asdict(description)}
    assert data.pop("integrator") == "runge_kutta"  # what is not used is left out
    assert [state.pop("noise_sd") for state in data["states"]] == [0.0, 0.0]
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    assert description.hash == hashlib.sha256(text.encode()).hexdigest()
    noisy = simple(states=(State("x", "m", noise_sd=0.1), State("v", "m/s")), integrator="euler")
    assert noisy.hash != simple(integrator="euler").hash != description.hash


def test_hash_of_a_known_description_never_changes():
    # Policies and records carry hashes: a new format must raise FORMAT, not slip in.
    assert simple().hash.startswith("3bb2036d17cac01f867889c2d703d3f7")


def test_integers_and_floats_give_the_same_hash():
    whole = simple(
        states=(State("x", "m", 0, 0.1), State("v", "m/s", 0, 1)),
        inputs=(Input("force", "N", -2, 6, 4),),
        outputs=(Output("position", "m", 0.1, 0.001, 0, 0.5, 1),),
        parameters=(Parameter("k", "N/m", 30), Parameter("offset", "N", -1, positive=False)),
        constants=(Constant("m", "kg", 2),),
        band=(0.1, 2),
    )
    assert whole == simple()
    assert whole.hash == simple().hash


def test_zero_and_minus_zero_give_the_same_hash():
    signed = simple(states=(State("x", "m", -0.0, 0.1), State("v", "m/s")))
    assert signed == simple()
    assert signed.hash == simple().hash


def numbers_in(value, path=()):
    """Paths to all numbers in nested data."""
    if isinstance(value, dict | list | tuple):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [p for key, child in items for p in numbers_in(child, (*path, key))]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return [path] if is_number and path != ("format",) else []


@pytest.mark.parametrize("name", PLANTS)
def test_every_number_of_a_plant_enters_its_hash(name):
    description = PLANTS[name].definition
    paths = numbers_in(description.to_dict())
    hashes = {description.hash}
    for path in paths:
        data = json.loads(json.dumps(description.to_dict()))
        target = data
        for key in path[:-1]:
            target = target[key]
        old = target[path[-1]]
        target[path[-1]] = (
            old + 1 if path == ("substeps",) else old * (1 + 1e-9) + 1e-12 * (not old)
        )
        hashes.add(PlantDescription.from_dict(data).hash)
    assert len(hashes) == 1 + len(paths)


def test_names_units_and_flags_enter_the_hash():
    renamed = simple(name="spring_2")
    other_unit = simple(constants=(Constant("m", "g", 2.0),))
    k, offset = simple().parameters
    no_target = simple(parameters=(dataclasses.replace(k, target=False), offset))
    assert len({d.hash for d in (simple(), renamed, other_unit, no_target)}) == 4


@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_as_built_describes_itself_by_its_definition(name):
    assert PLANTS[name].description.hash == PLANTS[name].definition.hash


@pytest.mark.parametrize("name", PLANTS)
def test_json_there_and_back_gives_the_same_description(name):
    description = PLANTS[name].definition
    back = PlantDescription.from_dict(json.loads(json.dumps(description.to_dict())))
    assert back == description
    assert back.hash == description.hash


def test_description_needs_neither_jax_nor_numpy():
    code = "import sys, excite.description; print(*{'jax', 'numpy', 'equinox'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_defaults_that_follow_from_other_fields():
    description = simple()
    assert description.inputs[0].amplitude == 4.0  # half the width of the limits
    assert description.parameters[0].symbol == "k"
    assert [p.scale for p in description.parameters] == [30.0, 1.0]
    assert description.columns == ("time", "force", "position")
    assert names_of(description.states) == ("x", "v")


@pytest.mark.parametrize(("build", "sentence"), [
    (lambda: State("2x", "m"), "state name '2x' is not allowed"),
    (lambda: State("_x", "m"), "state name '_x' is not allowed"),
    (lambda: Constant("two words", "m", 1.0), "constant name 'two words' is not allowed"),
    (lambda: Constant("c", "m", math.nan), "value of 'c' is nan; a finite number"),
    (lambda: Input("u", "V", -math.inf, 1.0), "lower of 'u' is -inf; a finite number"),
    (lambda: State("x", "m", scale=0.0), "scale of state 'x' must be positive"),
    (lambda: Input("u", "V", 1.0, 1.0), "limits of input 'u' must increase: got 1.0 to 1.0"),
    (lambda: Input("u", "V", -1.0, 1.0, 2.0), r"must lie in \(0, 1.0\]: got 2.0"),
    (lambda: Input("u", "V", -1.0, 1.0, -0.5), r"must lie in \(0, 1.0\]: got -0.5"),
    (lambda: Output("y", "m", -1.0), "scale of output 'y' must be positive"),
    (lambda: Output("y", "m", 1.0, noise_sd=-1.0), "noise_sd and resolution of output 'y'"),
    (lambda: Output("y", "m", 1.0, resolution=-1.0), "noise_sd and resolution of output 'y'"),
    (lambda: Output("y", "m", 1.0, warning_level=-1.0), "are magnitudes and must be positive"),
    (lambda: Output("y", "m", 1.0, critical_level=-1.0), "are magnitudes and must be positive"),
    (lambda: Output("y", "m", 1.0, warning_level=0.0), "are magnitudes and must be positive"),
    (lambda: Output("y", "m", 1.0, critical_level=0.0), "are magnitudes and must be positive"),
    (lambda: Output("y", "m", 1.0, warning_level=2.0, critical_level=2.0),
     "warning level of output 'y' must be below its critical level"),
    (lambda: Parameter("k", "", 0.0, positive=False), "scale of parameter 'k' must be positive"),
    (lambda: Parameter("k", "", 1.0, scale=-1.0), "scale of parameter 'k' must be positive"),
    (lambda: Parameter("k", "", -1.0), "parameter 'k' is positive, its nominal value -1.0 is not"),
    (lambda: Parameter("k", "", 1.0, lower=1.0), "inside its bounds: got 1.0 for 1.0 to inf"),
    (lambda: Parameter("k", "", 3.0, upper=2.0), "inside its bounds: got 3.0 for 0.0 to 2.0"),
    (lambda: Input("u", "V", -1.0, 1.0, 10**400), "amplitude of 'u' is inf; a finite number"),
    (lambda: Parameter("k", "", 1.0, lower=-1.0), "lower bound of the positive parameter 'k'"),
])  # fmt: skip
def test_a_part_that_makes_no_sense_is_refused_in_a_sentence(build, sentence):
    with pytest.raises(ValueError, match=sentence):
        build()


class SilentError(Exception):
    def __str__(self) -> str:
        raise KeyboardInterrupt


def test_what_an_error_says_is_one_short_line():
    assert told(ValueError("a\n  b")) == "ValueError: a b"
    assert told(SystemExit()) == "SystemExit"
    assert told(SilentError()) == "SilentError"
    assert len(told(ValueError("x " * 10**5))) < 600
    assert len(told(ValueError("x" * 10**5))) < 600


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"dt": 0.0}, "dt must be positive: got 0.0"),
    ({"dt": math.inf}, "dt must be positive: got inf"),
    ({"dt": 10**400}, "dt must be positive: got 1000"),
    ({"dt": 1e-320}, "dt must be positive: got 1e-320"),
    ({"substeps": 0}, "substeps must be a whole number from 1 to 10000: got 0"),
    ({"substeps": True}, "substeps must be a whole number .*: got True"),
    ({"substeps": 10**9}, "substeps must be a whole number .*: got 1000000000"),
    ({"band": (math.nan, 1.0)}, "band must be two frequencies in Hz, .*: got"),
    ({"band": (0.0, 1.0)}, "band must increase and end at or below 5 Hz"),
    ({"band": (1.0, 0.5)}, "got 1 to 0.5 Hz"),
    ({"band": (0.1, 5.1)}, "got 0.1 to 5.1 Hz"),
    ({"states": ()}, "plant 'spring' has no states"),
    ({"outputs": ()}, "plant 'spring' has no outputs"),
    ({"parameters": ()}, "plant 'spring' has no parameters"),
    ({"states": (State("x", "m"), State("x", "m"))}, "states of 'spring' repeat the name 'x'"),
    ({"constants": (Constant("m", "", 1.0),) * 2}, "constants of 'spring' repeat the name 'm'"),
    ({"outputs": (Output("force", "N", 1.0),)}, "all their names must differ"),
    ({"outputs": (Output("time", "s", 1.0),)}, "all their names must differ"),
    ({"inputs": (Input("time", "s", 0.0, 1.0),)}, "all their names must differ"),
])  # fmt: skip
def test_a_plant_that_makes_no_sense_is_refused_in_a_sentence(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        simple(**changes)


def test_the_band_may_reach_half_the_sampling_rate():
    assert simple(band=(0.1, 5.0)).band == (0.1, 5.0)


@pytest.mark.parametrize(("change", "sentence"), [
    (lambda d: d.update(format=2), "has format 2; this version reads 1"),
    (lambda d: d.pop("format"), "has format None"),
    (lambda d: d.pop("states"), "incomplete or malformed"),
    (lambda d: d.pop("dt"), "incomplete or malformed"),
    (lambda d: d.update(colour="red"), "incomplete or malformed: .*colour"),
    (lambda d: d["inputs"][0].update(gain=1.0), "incomplete or malformed: .*gain"),
    (lambda d: d["inputs"][0].pop("upper"), "incomplete or malformed: .*upper"),
    (lambda d: d.update(states=None), "incomplete or malformed"),
    (lambda d: d.update(band=[0.1]), "incomplete or malformed"),
])  # fmt: skip
def test_data_that_is_no_description_is_refused_in_a_sentence(change, sentence):
    data = json.loads(json.dumps(simple().to_dict()))
    change(data)
    with pytest.raises(ValueError, match=sentence):
        PlantDescription.from_dict(data)


INERTIA = Parameter("J_p", "kg m²", 0.02)
OFFSET = Parameter("offset", "N", -3.0, scale=2.0, positive=False)


@pytest.mark.parametrize(
    ("given", "parameter", "lower", "upper"),
    [
        (0.3, INERTIA, 0.014, 0.026),
        (0.3, OFFSET, -3.6, -2.4),
        ("factor:2", INERTIA, 0.01, 0.04),
        ("factor:2", OFFSET, -3 - 2 * math.log(2), -3 + 2 * math.log(2)),
        ("factor:1", INERTIA, 0.02, 0.02),
    ],
)
def test_a_spread_reaches_from_its_lower_to_its_upper_end(given, parameter, lower, upper):
    spread = Spread.of(given)
    ends = [spread.value(parameter, parameter.nominal, unit) for unit in (-1, 1)]
    assert ends == pytest.approx([lower, upper], rel=1e-12)
    assert Spread.of(spread.setting) == spread
    assert Spread.of(spread) is spread


@pytest.mark.parametrize(
    "given",
    [1.0, -0.1, math.nan, math.inf, True, None, [0.3], "0.3", "factor", "factor:", "factor:0.5",
     "factor:nan", "factor:1001", "factor:1e400", "Factor:3"],
)  # fmt: skip
def test_a_spread_that_is_not_allowed_is_one_sentence(given):
    with pytest.raises(ValueError, match=r"^spread must lie in \[0, 1\), or be a factor from 1 to"):
        Spread.of(given)
