"""The contract of a plant, and the physics of every plant in the catalogue."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import PLANTS, TwoMasses

from excite.description import names_of
from excite.excitation import Random
from excite.plant import Aero2, CartPole, DCMotor, Sensor, draw_params, params_from
from excite.plant.catalogue import plant_named
from excite.simulation import response, run_episode, step

plants = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)


@jax.jit
def free_motion(plant, params, start):
    """States from a start without input, 300 samples."""

    def advance(state, _):
        return (state := step(plant, state, jnp.zeros(len(plant.definition.inputs)), params)), state

    return jax.lax.scan(advance, start, None, length=300)[1]


# ------------------------------------------------------------------------- contract


@plants
def test_arrays_follow_the_order_of_the_description(plant):
    definition = plant.definition
    assert plant.Params._fields == names_of(definition.parameters)
    assert plant.constants._fields == names_of(definition.constants)
    np.testing.assert_array_equal(plant.nominal, [p.nominal for p in definition.parameters])
    np.testing.assert_array_equal(plant.initial_state, [s.initial for s in definition.states])
    state = jnp.arange(1.0, 1 + len(definition.states))
    low, high = plant.input_limits
    assert low.shape == high.shape == (len(definition.inputs),)
    assert plant.derivative(state, low, plant.nominal).shape == state.shape
    assert plant.output(state, plant.nominal).shape == (len(definition.outputs),)


@plants
def test_integration_is_never_coarser_than_in_the_definition(plant):
    finest = plant.definition.dt / plant.definition.substeps
    for factor in (0.01, 0.5, 0.9, 1.0, 1.1, 7.0):
        other = plant.changed(dt=factor * plant.definition.dt)
        assert float(other.dt) / other.substeps <= finest * (1 + 1e-5)
        assert other.substeps == 1 or float(other.dt) / (other.substeps - 1) > finest


def test_numbers_given_replace_those_of_the_definition():
    sensor = Sensor(jnp.array([0.01]), jnp.array([0.002]))
    plant = Aero2(m=2.0, sensor=sensor, initial_state=jnp.array([0.1, 0.2]), dt=0.2)
    description = plant.changed(g=1.6).description
    assert {c.name: c.value for c in description.constants} == {
        "m": 2.0,
        "g": 1.6,
        "d_S": 0.0019435,
    }
    assert [s.initial for s in description.states] == [0.1, 0.2]
    assert (description.outputs[0].noise_sd, description.outputs[0].resolution) == (0.01, 0.002)
    assert (description.dt, description.substeps) == (0.2, 4)
    assert description.hash != Aero2.definition.hash
    assert plant.changed().description == plant.description


@plants
@pytest.mark.parametrize("factor", [0.1, 3.0, 1000.0])
def test_description_stays_valid_for_any_sampling_time(plant, factor):
    description = plant.changed(dt=factor * plant.definition.dt).description
    assert 0 < description.band[0] < description.band[1] <= 0.5 / description.dt


def test_an_unknown_constant_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match="'aero2' has no constant 'mass'; it has m, g, d_S"):
        Aero2(mass=1.0)
    with pytest.raises(ValueError, match="'dc_motor' has no constant 'g'; it has none"):
        DCMotor(g=1.0)


def test_sensor_sd_counts_rounding_as_uniform_noise():
    sensor = Sensor(jnp.array([0.3, 0.0]), jnp.array([0.0, 1.2]))
    np.testing.assert_allclose(sensor.sd, [0.3, 1.2 / np.sqrt(12)])


def test_a_plant_of_a_user_fits_in_forty_lines():
    assert len(inspect.getsource(TwoMasses).splitlines()) <= 40


def test_other_numbers_do_not_compile_again():
    traces = []

    class Traced(Aero2):
        def derivative(self, state, input, params):
            traces.append(1)
            return super().derivative(state, input, params)

    def use(plant, params):
        response(plant, params, jnp.ones((5, 1)))
        run_episode(plant, params, Random(), 5, jax.random.key(0))

    first = Traced()
    use(first, first.nominal)
    once = len(traces)
    assert once > 0
    sensor = Sensor(jnp.array([0.1]), jnp.array([0.05]))
    for plant in (
        Traced(),
        Traced(m=2.0),
        Traced(g=1),
        Traced(sensor=sensor, initial_state=jnp.array([0.1, 0.0])),
        first.changed(d_S=0.01, dt=0.09),
    ):
        use(plant, plant.Params(*jnp.array([1.0, 2.0, 3.0])))
    assert len(traces) == once


def test_vmap_over_plants_equals_a_loop():
    plants = [Aero2(m=m, initial_state=jnp.array([0.1 * m, 0.0])) for m in (0.5, 1.0, 2.0)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *plants)
    inputs = jnp.sin(jnp.arange(30.0))[:, None]
    nominal = plants[0].nominal
    together = jax.vmap(response, in_axes=(0, None, None))(stacked, nominal, inputs)
    for plant, outputs in zip(plants, together, strict=True):
        np.testing.assert_allclose(outputs, response(plant, nominal, inputs), rtol=0, atol=1e-13)


def test_a_plant_can_be_changed_by_traced_numbers():
    plant, inputs = Aero2().changed(dt=0.15), jnp.sin(jnp.arange(20.0))[:, None]

    def with_mass(m):
        return response(plant.changed(m=m), plant.nominal, inputs)

    together = jax.vmap(with_mass)(jnp.array([0.5, 2.0]))
    for m, outputs in zip((0.5, 2.0), together, strict=True):
        alone = response(Aero2(m=m, dt=0.15), plant.nominal, inputs)
        np.testing.assert_allclose(outputs, alone, rtol=0, atol=1e-13)


def test_parameters_by_name_replace_the_nominal_ones():
    params = params_from(Aero2(), {"D_p": 0.002, "J_p": 0.03})
    np.testing.assert_array_equal(params, [0.03, 0.0125, 0.002])
    assert params_from(PLANTS["emps"], {"offset": -7.0}).offset == -7.0


@pytest.mark.parametrize(("values", "sentence"), [
    ({"mass": 1.0}, "'aero2' has no parameter 'mass'; it has J_p, K_pu, D_p"),
    ({"J_p": -1.0}, "J_p = -1 kg m² is not allowed; it must be finite, above 0 and below infinity"),
    ({"J_p": 0.0}, "J_p = 0 kg m² is not allowed"),
    ({"K_pu": np.nan}, "K_pu = nan rad/s²/V is not allowed"),
])  # fmt: skip
def test_parameters_that_make_no_sense_are_refused_in_a_sentence(values, sentence):
    with pytest.raises(ValueError, match=sentence):
        params_from(Aero2(), values)


@plants
def test_drawn_parameters_fill_their_spread_evenly(plant):
    keys = jax.random.split(jax.random.key(2), 400)
    drawn = np.stack(jax.vmap(lambda key: draw_params(plant, key, 0.3))(keys), axis=1)
    scale = np.array([p.scale for p in plant.definition.parameters])
    unit = (drawn - np.stack(plant.nominal)) / (0.3 * scale)
    assert np.all(np.abs(unit) <= 1 + 1e-12)
    # Five standard errors of the mean, and of the mean square, of a uniform number.
    assert np.all(np.abs(unit.mean(axis=0)) < 5 / np.sqrt(3 * 400))
    assert np.all(np.abs(np.mean(unit**2, axis=0) - 1 / 3) < 5 * np.sqrt(4 / 45 / 400))
    correlation = np.corrcoef(unit.T) - np.eye(len(scale))
    assert np.abs(correlation).max() < 5 / np.sqrt(400)


# -------------------------------------------------------------------------- physics


def aero2_motion(c, p, x, u):
    torque = p.D_p * x[1] + c.m * c.g * c.d_S * np.sin(x[0])
    return [x[1], 2 * p.K_pu * u[0] - torque / p.J_p]


def aero2_lag_motion(c, p, x, u):
    rate, acceleration = aero2_motion(c, p, x, [x[2]])
    return [rate, acceleration, (u[0] - x[2]) / p.tau]


def aero2_detailed_motion(c, p, x, u):
    speed = x[2] / np.hypot(x[2], 0.1)
    over = np.hypot(x[2], 0.1) - c.dead_zone
    over = (over + np.hypot(over, 0.1)) / 2
    curve = 7.2 * speed * over**2 / (7.2 - c.dead_zone) ** 2
    thrust = (c.curvature * curve + (1 - c.curvature) * x[2]) * (1 + c.asymmetry * speed / 2)
    rate, acceleration = aero2_motion(c, p, x, [thrust])
    if abs(x[0]) > c.stop:
        depth = abs(x[0]) - c.stop
        acceleration -= 1000 * np.sign(x[0]) * depth + 20 * x[1] * min(100 * depth, 1)
    return [rate, acceleration, (u[0] - x[2]) / c.tau]


def cart_pole_motion(c, p, x, u):
    # Both equations of motion, solved for the accelerations as a linear system.
    _, a, v, w = x
    mass = [[p.M + p.m_p, p.m_p * p.l * np.cos(a)], [p.m_p * p.l * np.cos(a), p.m_p * p.l**2]]
    cart = u[0] - p.B_c * v + p.m_p * p.l * w**2 * np.sin(a)
    pendulum = -p.B_p * w - p.m_p * p.l * c.g * np.sin(a)
    return [v, w, *np.linalg.solve(mass, [cart, pendulum])]


def dc_motor_motion(c, p, x, u):
    return [(p.K * x[1] - p.b * x[0]) / p.J, (u[0] - p.R * x[1] - p.K * x[0]) / p.L]


def emps_motion(c, p, x, u):
    friction = p.F_v * x[1] + p.F_c * np.tanh(x[1] / c.v_s)
    return [x[1], (u[0] - friction - p.offset) / p.M]


def two_masses_motion(c, p, x, u):
    joint = p.k * (x[0] - x[1])
    first = (u[0] - c.k_0 * x[0] - joint - p.c * x[2]) / p.m_1
    return [x[2], x[3], first, (u[1] - c.k_0 * x[1] + joint - p.c * x[3]) / p.m_2]


MOTION = {
    "aero2": aero2_motion,
    "aero2_lag": aero2_lag_motion,
    "aero2_detailed": aero2_detailed_motion,
    "cart_pole": cart_pole_motion,
    "dc_motor": dc_motor_motion,
    "emps": emps_motion,
    "two_masses": two_masses_motion,
}


@plants
def test_derivative_obeys_the_equations_of_motion(plant):
    rng = np.random.default_rng(1)
    for _ in range(5):
        x = 2 * rng.normal(size=len(plant.definition.states))
        u = 5 * rng.normal(size=len(plant.definition.inputs))
        params = plant.Params(*(v * rng.uniform(0.5, 2.0) for v in plant.nominal))
        expected = MOTION[plant.definition.name](plant.constants, params, x, u)
        actual = plant.derivative(jnp.asarray(x), jnp.asarray(u), params)
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10)


def aero2_energy(c, p, x):
    return 0.5 * p.J_p * x[:, 1] ** 2 + c.m * c.g * c.d_S * (1 - np.cos(x[:, 0]))


def cart_pole_energy(c, p, x):
    _, a, v, w = x.T
    bob = (v + p.l * w * np.cos(a)) ** 2 + (p.l * w * np.sin(a)) ** 2
    return 0.5 * p.M * v**2 + 0.5 * p.m_p * bob + p.m_p * c.g * p.l * (1 - np.cos(a))


def dc_motor_energy(c, p, x):
    return 0.5 * p.J * x[:, 0] ** 2 + 0.5 * p.L * x[:, 1] ** 2


def emps_energy(c, p, x):
    return 0.5 * p.M * x[:, 1] ** 2


def two_masses_energy(c, p, x):
    kinetic = p.m_1 * x[:, 2] ** 2 + p.m_2 * x[:, 3] ** 2
    springs = c.k_0 * (x[:, 0] ** 2 + x[:, 1] ** 2) + p.k * (x[:, 0] - x[:, 1]) ** 2
    return 0.5 * (kinetic + springs)


# Energy, and a start far from rest.
ENERGY = {
    "aero2": (aero2_energy, [1.2, 0.5]),
    "aero2_lag": (aero2_energy, [1.2, 0.5, 0.0]),
    "aero2_detailed": (aero2_energy, [0.8, 0.1, 0.0]),
    "cart_pole": (cart_pole_energy, [0.0, 1.0, 0.5, -2.0]),
    "dc_motor": (dc_motor_energy, [150.0, -3.0]),
    "emps": (emps_energy, [0.0, 0.3]),
    "two_masses": (two_masses_energy, [0.1, -0.1, 0.5, 0.2]),
}


@plants
def test_energy_never_rises_without_input(plant):
    energy, start = ENERGY[plant.definition.name]
    params = plant.nominal
    if "offset" in params._fields:
        params = params._replace(offset=0.0)  # a constant force is an input
    start = jnp.array(start)
    states = np.vstack([start, free_motion(plant, params, start)])
    levels = energy(plant.constants, params, states)
    assert levels[0] > 0
    assert levels[-1] < 0.9 * levels[0]
    assert np.diff(levels).max() <= 1e-9 * levels[0]


@pytest.mark.parametrize(("plant", "friction"), [
    (Aero2(), {"D_p": 0.0}), (CartPole(), {"B_c": 0.0, "B_p": 0.0}), (TwoMasses(), {"c": 0.0}),
], ids=["aero2", "cart_pole", "two_masses"])  # fmt: skip
def test_energy_is_kept_without_friction(plant, friction):
    energy, start = ENERGY[plant.definition.name]
    params, start = plant.nominal._replace(**friction), jnp.array(start)
    states = np.vstack([start, free_motion(plant, params, start)])
    levels = energy(plant.constants, params, states)
    # Runge-Kutta of order 4 loses about (omega h)^6 / 72 of the energy in a step.
    np.testing.assert_allclose(levels, levels[0], rtol=1e-3)


@pytest.mark.parametrize("plant", [Aero2(), CartPole(), DCMotor()], ids=lambda p: p.definition.name)
def test_the_mirrored_input_gives_the_mirrored_output(plant):
    inputs = 2 * jax.random.normal(jax.random.key(3), (200, 1))
    ahead, mirrored = (response(plant, plant.nominal, s * inputs) for s in (1.0, -1.0))
    assert jnp.abs(ahead).max() > 0
    np.testing.assert_allclose(mirrored, -ahead, rtol=0, atol=1e-12)


def test_emps_is_mirrored_together_with_its_offset():
    plant = PLANTS["emps"]
    inputs = 60 * jax.random.normal(jax.random.key(3), (200, 1))
    params = plant.nominal
    ahead = response(plant, params, inputs)
    mirrored = response(plant, params._replace(offset=-params.offset), -inputs)
    np.testing.assert_allclose(mirrored, -ahead, rtol=0, atol=1e-12)


def test_plants_other_than_emps_start_in_equilibrium():
    for name, plant in PLANTS.items():
        zero = jnp.zeros(len(plant.definition.inputs))
        at_start = plant.derivative(plant.initial_state, zero, plant.nominal)
        assert bool(jnp.all(at_start == 0)) == (name != "emps")


def test_aero2_has_the_resonance_and_damping_of_its_laboratory():
    # Quanser's pitch laboratory: 0.938 rad/s and a damping ratio of 0.024.
    plant = Aero2()
    at = plant.initial_state, jnp.zeros(1), plant.nominal
    A = jax.jacfwd(plant.derivative)(*at)
    poles = np.linalg.eigvals(A)
    np.testing.assert_allclose(np.abs(poles), 0.938, atol=0.0005)
    np.testing.assert_allclose(-poles.real / np.abs(poles), 0.024, atol=0.0005)


def test_aero2_recovers_its_parameters_from_the_linearised_equation():
    plant = Aero2(m=0.9, d_S=0.003)
    params = plant.Params(J_p=0.03, K_pu=0.01, D_p=0.002)
    at_rest = jnp.zeros(2), jnp.zeros(1), params
    A = jax.jacfwd(plant.derivative)(*at_rest)
    B = jax.jacfwd(plant.derivative, argnums=1)(*at_rest)
    back = plant.from_transfer_function(-A[1, 0], -A[1, 1], B[1, 0])
    np.testing.assert_allclose(back, params, rtol=1e-12)


def test_a_plant_file_is_run_again_only_when_it_has_changed(tmp_path):
    path, other = tmp_path / "own.py", tmp_path / "more" / "own.py"
    other.parent.mkdir()
    text = "from excite.plant import DCMotor\n\n\nclass Own(DCMotor):\n    pass\n"
    for file in (path, other):
        file.write_text(text)
    first, second = (type(plant_named(f"{path}:Own")) for _ in range(2))
    assert first is second  # what was compiled for it serves again
    assert type(plant_named(f"{other}:Own")) is not first
    path.write_text(text.replace("pass", "speed = 1"))
    assert type(plant_named(f"{path}:Own")).speed == 1
    path.write_text("raise SystemExit")
    for _ in range(2):  # what cannot be imported is not kept
        with pytest.raises(ValueError, match="cannot be imported"):
            plant_named(f"{path}:Own")
