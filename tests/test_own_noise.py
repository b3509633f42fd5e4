"""Static tasks with another noise than a normal one: questions with two answers, a slider."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import log_ndtr
from scipy.stats import norm

import excite as ex
from excite.excitation import Replay
from excite.plant import AbstractStaticTask, static_description
from excite.plant.catalogue import plant_named
from excite.plant.extension import extended
from excite.plant.static import has_own_noise

EXAMPLE = Path(__file__).parent.parent / "examples" / "constant_elasticity.py"
PRIOR = {"at": "normal:0:1"}


def described(**noise):
    """Of a question, whose sensor may have noise."""
    return static_description(
        "question",
        designs=(ex.Input("place", "m", -3.0, 3.0),),
        outcomes=(ex.Output("answer", "", scale=1.0, **noise),),
        parameters=(ex.Parameter("at", "m", 0.0, scale=1.0, positive=False),),
    )


class Question(AbstractStaticTask):
    """Whether something lies above a place: the answer is 1 or -1, and wrong near the place."""

    definition = described()

    def outcome(self, design, params):
        return 4 * (params.at - design)

    def measured(self, design, params, noise):
        return jnp.sign(self.outcome(design, params) + noise)

    def log_likelihood(self, measured, design, params):
        return jnp.sum(log_ndtr(measured * self.outcome(design, params)))


def entropy(p):
    return -p * np.log(p) - (1 - p) * np.log(1 - p)


@pytest.mark.slow
@pytest.mark.parametrize("from_prior", [True, False])
def test_a_question_tells_what_the_entropies_of_its_answers_say(from_prior):
    places, width = np.linspace(-6, 6, 2001, retstep=True)
    yes, density = norm.cdf(4 * (places - 0.5)).clip(1e-12, 1 - 1e-12), norm.pdf(places) * width
    # The second question is far outside, and its answer is known before.
    design = Replay(jnp.array([[0.5], [3.0]]))
    far = norm.cdf(4 * (places - 3.0)).clip(1e-12, 1 - 1e-12)
    joint = [density @ (a * b) for a in (yes, 1 - yes) for b in (far, 1 - far)]
    exact = -sum(p * np.log(p) for p in joint) - density @ (entropy(yes) + entropy(far))
    found = ex.information_gain(
        Question, design, steps=2, prior=PRIOR, plants=512, samples=200, from_prior=from_prior
    )
    assert found.lower.value - 4 * found.lower.std_error < exact
    assert exact < found.upper.value + 4 * found.upper.std_error
    assert found.upper.value - found.lower.value < 0.05


def test_the_first_question_is_asked_in_the_middle():
    chosen = replace(ex.Myopic.of(Question, PRIOR), num_outcomes=128)  # each tells little
    state, place = chosen(chosen.init(Question(), 5, jax.random.key(0)), jnp.zeros(1))
    assert abs(float(place[0])) < 0.5
    state, place = chosen(state, jnp.ones(1))
    assert 0.2 < float(place[0]) < 1.5  # about the middle of what is left
    assert float(jnp.mean(state.particles > 0)) > 0.8


def test_what_is_measured_is_the_tasks_own():
    record = ex.simulate(Question, "random", options={"hold": 1}, steps=50, seed=1)
    assert set(np.unique(record.outputs[1:])) <= {-1.0, 1.0}
    right = np.sign(-record.inputs[:-1]) == record.outputs[1:]
    assert 0.7 < right.mean() < 1


class Loud(Question):
    """With a sensor's noise, which it does not use."""

    definition = described(noise_sd=0.1)


@pytest.mark.parametrize("task", [Question, Loud])
def test_what_needs_the_noise_of_a_sensor_is_refused(task, tmp_path):
    record = ex.simulate(task, "random", steps=50)
    for verb in (
        lambda: ex.identify(record, task),
        lambda: ex.train(task, prior=PRIOR),
        lambda: ex.information(task, "random"),
        lambda: ex.design(task, steps=5),
        lambda: ex.run("simulated", plant=task, excitation="random", out=tmp_path / "a.csv"),
        lambda: ex.simulate(task, "random", steps=5, noise={"answer": 2.0}),
        lambda: ex.information_gain(task, noise={"answer": 2.0}),
        lambda: extended(task(), ["bias_answer"]),
    ):
        with pytest.raises(ValueError, match="'question' has its own log_likelihood"):
            verb()


def test_the_slider_of_the_example_is_drawn_as_it_is_likely():
    task = plant_named(f"{EXAMPLE}:Elasticity")
    assert has_own_noise(task)
    params = task.Params(*jnp.array([0.4, 0.3, 0.6, 2.0]))
    design = jnp.array([3.0, 1.0, 2.0, 1.0, 2.5, 2.2])
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(2000, 1)))
    seen = jax.vmap(lambda own: task.measured(design, params, own))(noise)[:, 0]
    first = 1 - np.sqrt(1 - 0.3)
    shares = np.array([first, (1 - first) * 0.6, (1 - first) * 0.4])
    utility = [(shares @ np.asarray(b) ** 0.4) ** (1 / 0.4) for b in (design[:3], design[3:])]
    mean = 2 * (utility[0] - utility[1])
    sd = 2 * 0.005 * (1 + np.linalg.norm(design[:3] - design[3:]))
    assert float(jnp.mean(seen)) == pytest.approx(mean, abs=5 * sd / np.sqrt(2000))
    assert float(jnp.std(seen)) == pytest.approx(sd, rel=0.1)
    likely = task.log_likelihood(seen[:1], design, params)
    assert float(likely) == pytest.approx(norm.logpdf(float(seen[0]), mean, sd), abs=1e-9)


def test_a_slider_at_its_limit_is_as_likely_as_all_beyond():
    task = plant_named(f"{EXAMPLE}:Elasticity")
    params = task.Params(*jnp.array([0.4, 0.3, 0.6, 1.0]))
    design = jnp.array([30.0, 30.0, 30.0, 14.8, 14.8, 14.8])
    limit = np.log(2**22 - 1)
    mean = 30.0 - 14.8  # of equal goods, the utility is their amount
    sd = 0.005 * (1 + 15.2 * np.sqrt(3))
    found = task.log_likelihood(jnp.array([limit]), design, params)
    assert float(found) == pytest.approx(norm.logsf(limit, mean, sd), rel=1e-6)


def made(**functions):
    """A question with other functions."""
    return type("Other", (Question,), functions)


class Plain(AbstractStaticTask):
    """With a sensor's noise."""

    definition = described(noise_sd=0.1)

    def outcome(self, design, params):
        return params.at - design


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (
            type("Half", (Plain,), {"measured": Question.measured}),
            "Half defines measured, and needs log_likelihood too",
        ),
        (
            type("Half", (Plain,), {"log_likelihood": Question.log_likelihood}),
            "Half defines log_likelihood, and needs measured too",
        ),
        (
            made(measured=lambda self, design, params, noise: jnp.zeros(3)),
            r"measured of .*Other returns shape \(3,\); one array of shape \(1,\) is needed",
        ),
        (
            made(log_likelihood=lambda self, measured, design, params: measured),
            r"log_likelihood of .*Other returns shape \(1,\); one number is needed",
        ),
        (
            made(log_likelihood=lambda self, m, d, p: jnp.sum(m) * jnp.nan),
            "log_likelihood of .*Other is not finite",
        ),
    ],
)
def test_functions_that_do_not_fit_are_one_sentence(task, sentence):
    for verb in (ex.Myopic.of, ex.information_gain):
        with pytest.raises(ValueError, match=sentence):
            verb(task, prior=PRIOR)


def test_what_a_laboratory_cannot_have_made_is_refused():
    chosen = ex.Myopic.of(Question, PRIOR)
    state = chosen.init(Question(), 2, jax.random.key(0))
    for outcome in ([np.nan], [1.0, 1.0]):
        with pytest.raises(ValueError, match="an outcome has one finite number for each of answer"):
            chosen(state, jnp.array(outcome))
    state, _ = chosen(state, jnp.zeros(1))
    with pytest.raises(ValueError, match=r"a design lies from \[-3.0\] to \[3.0\]: got \[99.0\]"):
        chosen.applied(state, jnp.array([99.0]))
    with pytest.raises(ValueError, match="num_steps"):
        chosen.init(Question(), 0, jax.random.key(0))
    state = chosen.learnt(chosen.applied(state, jnp.array([1.0])), jnp.ones(1))
    assert float(jnp.median(chosen.posterior(state).at)) > 0.9
