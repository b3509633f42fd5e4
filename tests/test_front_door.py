"""`import excite as ex`: instant, complete, every example runs, and every object fits a screen."""

import doctest
import inspect
import json
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import click
import numpy as np
import pytest
from catalogue import LONG, SLOW

import excite as ex
from excite.cli import cli
from excite.study.catalogue import shipped_studies

NAMES = [name for name in ex.__all__ if name != "__version__"]
LONGEST = {"train", "campaign", "design", "run_study", "compare_plants"}
SLOWER = {"next_experiment", "information_gain", "discriminate", "falsify", "evaluate"}
SLOWER |= {"choose_experiments"}
MARKED = [LONG(n) if n in LONGEST else SLOW(n) if n in SLOWER else n for n in NAMES]


@pytest.mark.parametrize("name", MARKED)
def test_every_name_has_an_example_that_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some examples write a file
    found = inspect.unwrap(getattr(ex, name))
    tests = doctest.DocTestFinder(recurse=False).find(found, name, globs={})
    examples = [test for test in tests if test.examples]
    assert examples, f"{name} has no example"
    for test in examples:
        assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed == 0


def test_the_package_lists_what_it_has():
    assert dir(ex) == sorted(ex.__all__)
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        ex.simulat  # noqa: B018


def test_importing_the_package_loads_nothing():
    code = "import sys, excite; print(*{'jax', 'numpy', 'equinox'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_verb_with_the_name_of_a_module_is_a_verb_whatever_was_imported(record, result):
    import excite.information
    import excite.report

    assert excite.information.cramer_rao_bound  # pyright: ignore[reportFunctionMemberAccess]
    assert ex.information("aero2", steps=100).plant.name == "aero2"
    with pytest.raises(ValueError, match="html"):
        ex.report([], "page.txt")


@pytest.mark.parametrize("name", [n for n in ex.__all__ if n.replace("_", "-") in cli.commands])
def test_an_option_is_an_argument_or_listed_as_an_exception(name):
    page = Path(__file__).parent.parent / "docs" / "reference" / "python" / "index.md"
    _, _, section = page.read_text(encoding="utf-8").partition("## Where the command line differs")
    listed = set(re.findall(r"--([a-z-]+)", section.partition("\n## ")[0]))
    parameters = inspect.signature(getattr(ex, name)).parameters
    if "options" in parameters and parameters["options"].kind is inspect.Parameter.VAR_KEYWORD:
        parameters = {**parameters, **inspect.signature(ex.identify).parameters}
    options = [
        p for p in cli.commands[name.replace("_", "-")].params if isinstance(p, click.Option)
    ]
    words = {word.removeprefix("--") for p in options for word in p.opts if word.startswith("--")}
    assert {w for w in words if w.replace("-", "_") not in parameters} <= listed


def test_a_report_replaces_a_file_only_if_it_may(tmp_path):
    ex.simulate("aero2", steps=20).save(tmp_path / "record.csv")
    told = []
    page = ex.report(
        tmp_path / "record.csv", tmp_path / "r.html", progress=lambda *n: told.append(n)
    )
    assert told == [("record.csv", 0, 1), ("done", 1, 1)]
    (tmp_path / "r.html").write_text("mine")
    with pytest.raises(ValueError, match=r"r\.html exists"):
        ex.report(tmp_path / "record.csv", tmp_path / "r.html")
    assert (tmp_path / "r.html").read_text() == "mine"
    ex.report(tmp_path / "record.csv", tmp_path / "r.html", overwrite=True)
    assert (tmp_path / "r.html").read_text() == page


@pytest.fixture(scope="module")
def record():
    return ex.simulate("aero2", "chirp", steps=200)


@pytest.fixture(scope="module")
def result(record):
    return ex.identify(record)


def test_every_object_fits_a_screen(record, result):
    listings = [ex.plants(), ex.excitations(), ex.policies(), ex.estimators()]
    objects = [record, result, ex.information("aero2", steps=200), ex.read_policy("aero2")]
    plant = record.description
    for shown in map(repr, [*listings, *objects, plant]):
        lines = shown.splitlines()
        assert len(lines) <= 24
        assert max(map(len, lines)) <= 80


def test_a_result_shows_itself(result):
    assert result.params.D_p == result.params["D_p"]
    assert "K_pu" in result._repr_html_()
    assert "<table>" in ex.information("aero2", steps=200)._repr_html_()
    assert result.plot().axes
    for word in ("Dp", "d_p"):
        with pytest.raises(AttributeError, match="did you mean 'D_p'"):
            getattr(result.params, word)


def test_a_verb_shows_its_documentation_and_a_wrong_name_has_a_hint():
    assert (ex.information.__doc__ or "").startswith("Smallest possible standard deviation")
    assert list(inspect.signature(ex.information).parameters)[:2] == ["plant", "excitation"]
    assert repr(ex.information).startswith("<function information")
    with pytest.raises(AttributeError) as missing:
        ex.simulat  # noqa: B018
    assert (missing.value.name, missing.value.obj) == ("simulat", ex)


def test_names_are_listed_with_what_tells_them_apart():
    assert set(ex.studies()) == set(shipped_studies())
    for listing in (ex.estimators(), ex.studies()):
        assert len(set(listing.values())) == len(listing)
    assert ex.estimators()["arx-rls-wide"].endswith("With start_covariance = 1e+08.")


def test_a_record_shows_the_same_as_text_and_as_html(record):
    text = re.sub(r"<[^>]*>", " ", record._repr_html_()).split()
    for word in repr(record).replace(" to ", " ").split():
        assert word.strip(":,") in [t.strip(":,") for t in text]


def test_a_record_is_replayed_and_its_inputs_are_a_signal(record):
    again = ex.simulate("aero2", record)
    np.testing.assert_array_equal(again.inputs, record.inputs)
    np.testing.assert_array_equal(ex.simulate("aero2", record.inputs).inputs[:-1], record.inputs)


MISTAKES = {
    "ex.Campaign('aero2', 'D_p=1%')": (
        "target must be a dict by parameter, function or prediction: got str 'D_p=1%'"
    ),
    "ex.Campaign('aero2', {'D_p': None})": "target of D_p must be a number: got NoneType None",
    "ex.Campaign('aero2', {'D_p': True})": "target of D_p must be a number: got bool True",
    "ex.Campaign('aero2', {'D_p': '1%'}, spread='3')": "such as factor:3: got '3'",
    "ex.Campaign('aero2', {'D_p': '1%'}, rounds=2.5)": "rounds must be a whole number from 1",
    "ex.Campaign('aero2', {'D_p': '1%'}).tell(3)": "a record, a path or a DataFrame: got int 3",
    "ex.campaign('aero2', {'D_p': '1%'}, 3, out='x')": "rig must be a name, a file, path",
    "ex.campaign('aero2', {'D_p': '1%'}, out=3)": "out must be a path: got int 3",
    "ex.campaign('aero2', {'D_p': '1%'}, out='x', pause='5')": "pause must be a number: got str",
    "ex.campaign('aero2', {'D_p': '1%'}, out='x', pause=-1)": "pause must be a number of seconds",
    "ex.campaign('aero2', {'D_p': '1%'}, 'simulatd', out='x')": "did you mean 'simulated'",
    "ex.simulate('aero2', coast=-1)": "coast must be a whole number from 0",
    "ex.train('aero2', spread='factor:0')": "such as factor:3: got 'factor:0'",
    "ex.simulate('aero')": "unknown plant 'aero'; did you mean 'aero2'",
    "ex.simulate(3)": "plant must be a name, path/to/file.py:ClassName, a plant or its class: "
    "got int 3",
    "ex.simulate(dict)": "got the class dict",
    "ex.simulate('aero2', 'chrip')": "did you mean 'chirp'",
    "ex.simulate('aero2', 7)": "excitation must be a name, an excitation or its class",
    "ex.simulate('aero2', [1.0, 2.0])": "an array of inputs by sample and input: got list",
    "ex.simulate('aero2', seed='0')": "seed must be a whole number or a key of jax.random.key: "
    "got str '0'",
    "ex.simulate('aero2', seed=True)": "seed must be a whole number",
    "ex.simulate('aero2', seed=-1)": "seed must be 0 or more",
    "ex.simulate('aero2', steps=2.5)": "steps must be a whole number: got float 2.5",
    "ex.simulate('aero2', steps=1)": "steps must be at least 2: got 1",
    "ex.simulate('aero2', params=[1, 2, 3])": "params must be a dict by name or the plant's named",
    "ex.simulate('aero2', params={'J_p': 'x'})": "J_p must be a number: got str 'x'",
    "ex.simulate('aero2', params={'J': 1})": "no parameter 'J'",
    "ex.simulate('aero2', noise=0.1)": "noise must be a dict by output: got float 0.1",
    "ex.simulate('aero2', noise={'pitch': [1]})": "noise of 'pitch' must be a number",
    "ex.simulate('aero2', options=3)": "options must be a dict by name: got int 3",
    "ex.information('aero2', initial_state='no')": "initial state 'no' is not one of",
    "ex.identify(3)": "the path of an experiment file or a DataFrame, or several: got int 3",
    "ex.identify([3])": "records must be a record",
    "ex.identify([])": "no record is given",
    "ex.identify('missing.csv', 'aero2')": "missing.csv: no such file",
    "ex.identify('missing.csv')": "missing.csv: no such file",
    "ex.identify('.')": ".: is a folder; only files can be read, and ROS 2 bags",
    "ex.identify(record, 'emps')": "is of plant 'aero2' and has voltage, pitch; plant 'emps' has",
    "ex.read_record(3)": "record must be a path or a DataFrame: got int 3",
    "ex.read_study({'a': 1})": "study must be a name or a path: got dict {'a': 1}",
    "ex.run_study(3)": "study must be a name or a path: got int 3",
    "ex.run(out=3)": "out must be a path: got int 3",
    "ex.read_policy(3)": "policy must be a name or a path: got int 3",
    "ex.evaluate(2)": "policy must be a name, a path or a policy: got int 2",
    "ex.evaluate('aero2', estimators=3)": "estimators must be a name or several names: got int 3",
    "ex.design('aero2', kind=3)": "kind must be the name of a kind of design: got int 3",
    "ex.train('aero2', objective=3)": "objective must be a name, several names, or a dict",
    "ex.report(3)": "runs must be a run folder, a record's file, or several: got int 3",
    "ex.Parameter('a', 'kg', 'x')": "nominal of 'a' must be a number: got str 'x'",
    "ex.Parameter('a', 5, 1.0)": "unit of 'a' must be a text: got int 5",
    "ex.Input('u', 'V', -1.0, 1.0, None)": "amplitude of 'u' must be a number: got NoneType",
    "ex.Input('u', 'V', -1.0, 1.0, (1, 2))": "amplitude of 'u' must be a number: got tuple (1, 2)",
    "changed(states=('x',))": "states of 'aero2' must be a tuple of ex.State: got tuple ('x',)",
    "changed(outputs=None)": "outputs of 'aero2' must be a tuple of ex.Output: got NoneType",
    "changed(dt='0.1')": "dt must be positive: got '0.1'",
    "changed(substeps=1.5)": "substeps must be a whole number from 1 to 10000: got 1.5",
    "changed(substeps=np.inf)": "substeps must be a whole number from 1 to 10000: got inf",
    "changed(substeps='2')": "substeps must be a whole number from 1 to 10000: got '2'",
    "changed(band=(1, 2, 3))": "band must be two frequencies in Hz, the lowest and the highest: "
    "got (1, 2, 3)",
    "changed(band=(1.0,))": "got (1.0,)",
    "changed(band=1.0)": "band must be two frequencies in Hz",
    "changed(band=None)": "band must be two frequencies in Hz",
    "changed(band=('a', 1.0))": "band must be two frequencies in Hz",
    "changed(band=jnp.ones(3))": "band must be two frequencies in Hz",
    "ex.simulate('aero2', np.full((9, 1), np.nan))": "inputs must be finite: got [nan] at sample 0",
    "ex.simulate('aero2', np.ones(9))": "inputs need a row for each sample: got shape (9,)",
    "ex.simulate('aero2', np.ones((0, 1)))": "a row for each sample: got shape (0, 1)",
    "ex.simulate('aero2', np.full((9, 1), 30.0))": (
        "inputs: 'voltage' runs from 30 to 30 V; the plant's limits are -24 to 24 V"
    ),
    "ex.identify(record, 'cart_pole')": "has 1 input and 1 output; plant 'cart_pole'",
    "ex.identify(record, estimator='nsl')": "did you mean 'nls'",
    "ex.identify(record, estimator=3)": "estimator must be a name, an estimator or its class",
    "ex.identify(record, start=[1])": "start must be a dict by name",
    "ex.identify(record, hold='D_p')": "hold must be a dict by name or the plant's named tuple",
    "ex.identify(record, rows='0:50')": "rows is for files, and the records are given as objects",
    "ex.identify('x.csv', 'aero2', columns=3)": "columns must be a dict by name: got int 3",
    "ex.identify('x.csv', 'aero2', set_inputs=5)": "set_inputs must be a dict by name: got int 5",
    "ex.identify('x.csv', 'aero2', dt='x')": "dt must be a number: got str 'x'",
    "ex.identify('x.csv', 'aero2', scales={'pitch': 'deg'})": "scale of 'pitch' must be a number",
    "ex.identify(record, prior='wide')": "prior 'wide' is no run folder and no file; it may be a "
    "dict by parameter (normal:MEAN:SD,",
    "ex.read_record('x.csv', 'aero2')": "description must be that of a plant (plant.description): "
    "got str 'aero2'",
    "record.save(3)": "path must be a path: got int 3",
    "ex.compare_plants(record, None)": "a comparison needs at least two plants: got None",
    "ex.train('aero2', goal=0.1)": "goal must be a dict by parameter: got float 0.1",
    "ex.train('aero2', target=3)": "target must be the name of a parameter, or several",
    "ex.train('aero2', clock='fast')": "clock must be a frequency in Hz, or several",
    "ex.train('aero2', training=3)": "training must be a dict by name: got int 3",
    "ex.train('aero2', uncertainty=3)": "uncertainty must be a dict of ranges by name: got int 3",
    "ex.train('aero2', output_scale=3)": "output_scale must be a dict by output: got int 3",
    "ex.train('aero2', out=3)": "out must be a path: got int 3",
    "ex.train('aero2', workers='two')": "workers must be a whole number from 1 to",
    "ex.evaluate('aero2', uncertainty=3)": "uncertainty must be a dict of ranges by name",
    "ex.simulate('aero2+dealy')": "extension of plant 'aero2': 'dealy'; did you mean 'delay'",
    "Aero2(sensor=3)": "sensor must be an excite.plant.Sensor: got int 3",
    "Aero2(initial_state=[1.0])": "initial_state must be 2 numbers (pitch, pitch_rate): got list",
    "Aero2(initial_state='a')": "expected a number or several: got str 'a'",
    "Aero2(dt='fast')": "expected a number or several: got str 'fast'",
    "ex.identify(record, estimator='arx-rls', hold={'J_p': 1})": "takes no hold",
    "ex.Record([0, 1], [[0], [1]], [[0]])": "outputs of a record needs one row for each of 2",
    "ex.Record([0, 1], 'no', [[0]])": "inputs must be an array of numbers: got str 'no'",
    "ex.simulate(Deciding)": "derivative of Deciding branches on the value of a state, an input, "
    "a parameter or a constant (if, while, and, or): use jnp.where(condition, value, otherwise)",
    "ex.simulate(Numpy())": "derivative of Numpy uses NumPy: use jax.numpy",
    "ex.simulate(ex.AbstractPlant)": "AbstractPlant is not a complete plant",
}

WORKS = [
    "changed(substeps=2.0).hash == changed(substeps=2).hash or 1 / 0",
    "changed(band=[0.1, 1]).band == (0.1, 1.0) or 1 / 0",
    "ex.simulate(Aero2, ex.simulate('aero2', steps=20))",
    "ex.simulate(Aero2(), Chirp, steps=20)",
    "ex.simulate(Aero2(), Chirp(amplitude=2.0), steps=20, seed=jax.random.key(0))",
    "ex.simulate('aero2', params=Aero2().nominal, steps=20, seed=np.int64(3))",
    "ex.simulate(single, steps=20)",
    "ex.simulate('aero2', ex.read_policy('aero2'), steps=20)",
    "ex.Record([0, 0.1, 0.2], [0, 1, 0], [0, 0, 0])",
]

SCRIPT = """
import dataclasses, functools
import json, sys, warnings
import excite as ex
import jax, jax.numpy as jnp, numpy as np
from excite.excitation import Chirp
from excite.plant import Aero2

class Deciding(Aero2):
    def derivative(self, state, input, params):
        if state[0] > 0:
            return -state
        return state

class Numpy(Aero2):
    def derivative(self, state, input, params):
        return np.sin(state)

jax.config.update("jax_enable_x64", False)
single = Aero2()
jax.config.update("jax_enable_x64", True)
record = ex.simulate("aero2", steps=60)
changed = functools.partial(dataclasses.replace, Aero2.definition)
said = {}
for line in json.load(sys.stdin):
    try:
        eval(line)
        said[line] = "works"
    except Exception as error:
        said[line] = f"{type(error).__name__}: {error}"
said["single"] = float(single.dt), float(ex.simulate(single, steps=20).time[1])
print(json.dumps(said))
"""


@pytest.mark.slow
def test_a_mistake_is_one_sentence_and_what_can_be_meant_works():
    """In a process without the tests' run-time check of types, which would speak first."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(SCRIPT)],
        input=json.dumps([*MISTAKES, *WORKS]),
        capture_output=True,
        text=True,
        check=True,
    )
    said = json.loads(done.stdout)
    assert said.pop("single")[1] == 0.1  # not single precision's 0.10000000149
    for line, sentence in MISTAKES.items():
        kind, _, text = said[line].partition(": ")
        assert kind in ("ValueError", "TypeError"), f"{line}: {said[line]}"
        assert sentence in text, f"{line}: {text}"
        assert "\n" not in text, line
    assert {line: said[line] for line in WORKS} == dict.fromkeys(WORKS, "works")


def test_a_data_frame_is_a_record(record, result):
    frame = record.to_pandas()
    again = ex.identify(frame, "aero2", initial_state="known")
    assert again.params == result.params
    with pytest.raises(ValueError, match="a DataFrame does not tell its plant: name the plant"):
        ex.identify(frame)
    with pytest.raises(ValueError, match="name the plant"):
        ex.next_experiment(frame, target={"D_p": "1%"})
    with pytest.raises(ValueError, match="a record or a result is given twice: give"):
        ex.next_experiment([frame, frame], "aero2", target={"D_p": "1%"})
    with pytest.raises(TypeError, match="or several: got the class DataFrame"):
        ex.identify(type(frame), "aero2")  # pyright: ignore[reportArgumentType]
    told = ex.Campaign("aero2", {"D_p": "50%"}).tell(frame)
    assert told.num_samples == len(frame) - 1
