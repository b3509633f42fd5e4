"""Plants with extensions: input delay, lag, offset, friction, and so on."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import excite as ex
from excite.environment import Env
from excite.plant import Aero2, DCMotor
from excite.plant.catalogue import plant_from
from excite.plant.extension import extended, extensions_of
from excite.simulation import delayed, response, simulate

PLANT = Aero2()
CHANNELS = {"voltage": 0, "speed": 0, "pitch_rate": 1, "pitch": 0, "current": 1}


def solved(inputs: np.ndarray, dt: np.ndarray, delay: float, linear: bool = False) -> np.ndarray:
    """Pitch of the ideal plant after the delayed input by SciPy, from switch to switch."""
    times = np.concatenate([[0.0], np.cumsum(dt)])
    edges = np.unique(np.concatenate([times, times + delay]))
    edges = edges[(edges > -1e-12) & (edges <= times[-1] + 1e-12)]

    def voltage(t: float) -> float:
        if linear:
            return float(np.interp(t - delay, times[:-1], inputs))
        k = int(np.searchsorted(times, t - delay, side="right")) - 1
        return inputs[min(max(k, 0), len(inputs) - 1)]

    def rate(t: float, x: np.ndarray, held: float | None) -> np.ndarray:
        u = voltage(t) if held is None else held
        return np.asarray(PLANT_RATE(x, np.array([u])))

    state, pitch = np.zeros(2), {0.0: 0.0}
    for start, end in itertools.pairwise(edges):
        held = None if linear else voltage((start + end) / 2)
        found = scipy.integrate.solve_ivp(
            rate, (start, end), state, "DOP853", args=(held,), rtol=1e-10, atol=1e-12
        )
        state = found.y[:, -1]
        pitch[end] = state[0]
    return np.array([pitch[min(pitch, key=lambda e: abs(e - t))] for t in times])


PLANT_RATE = jax.jit(lambda x, u: PLANT.derivative(x, u, PLANT.nominal))


@pytest.mark.parametrize("delay", [-0.07, 0.0, 0.03, 0.1, 0.237])
@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
def test_a_delayed_input_acts_at_its_time(delay, uneven):
    rng = np.random.default_rng(1)
    dt = rng.uniform(0.02, 0.15, 80) if uneven else np.full(80, 0.1)
    voltage = rng.uniform(-7, 7, 80)
    plant = extended(PLANT, ["delay"])
    params = plant.Params(*PLANT.nominal, jnp.asarray(delay))
    found = response(plant, params, jnp.asarray(voltage)[:, None], dt=jnp.asarray(dt))
    # The input switches inside a step, here several times; its mean and first moment are kept.
    atol = 3e-5 if uneven else 3e-6
    np.testing.assert_allclose(found[:, 0], solved(voltage, dt, delay), atol=atol)


@pytest.mark.parametrize("linear", [False, True], ids=["held", "linear"])
def test_a_delay_keeps_the_mean_and_the_first_moment_of_every_step(linear):
    rng = np.random.default_rng(2)
    dt, u, delay = rng.uniform(0.5, 1.5, 30), rng.normal(size=31), 2.3
    ends = u[1:] if linear else u[:-1]
    first, last = delayed(
        jnp.asarray(u[:-1, None]), jnp.array([delay]), jnp.asarray(dt), jnp.asarray(ends[:, None])
    )
    times = np.concatenate([[0.0], np.cumsum(dt)])
    fine = (np.arange(20_000) + 0.5) / 20_000

    def at(t: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, 29)
        part = np.clip((t - times[k]) / dt[k], 0.0, 1.0)
        return u[:-1][k] + part * (ends - u[:-1])[k]

    for k in range(30):
        values = at(times[k] + fine * dt[k] - delay)
        straight = first[k, 0] + fine * (last[k, 0] - first[k, 0])
        assert np.mean(straight) == pytest.approx(np.mean(values), abs=2e-4)
        assert np.mean(fine * straight) == pytest.approx(np.mean(fine * values), abs=2e-4)


def test_an_input_that_would_act_before_it_is_chosen_is_refused():
    with pytest.raises(ValueError, match=r"input 'voltage' has a delay of -0\.05 s"):
        simulate("aero2+delay", params={"delay_voltage": -0.05})


@pytest.mark.parametrize(
    "use",
    [
        lambda out: ex.design("aero2+delay", steps=10, out=out),
        lambda out: ex.train("aero2+delay", out=out),
        lambda out: ex.run(plant="aero2+delay", out=out),
        lambda out: Env.of(plant_from("aero2+delay")),
    ],
    ids=["design", "train", "run", "process"],
)
def test_designs_policies_and_rigs_refuse_a_delay(use, tmp_path):
    with pytest.raises(ValueError, match=r"plant 'aero2\+delay_voltage' delays its inputs"):
        use(tmp_path / "out.csv")
    assert not list(tmp_path.iterdir())


def test_no_delay_changes_nothing():
    rng = np.random.default_rng(3)
    u, dt = jnp.asarray(rng.normal(size=(50, 2))), jnp.asarray(rng.uniform(0.1, 0.2, 50))
    following = jnp.asarray(rng.normal(size=(50, 2)))
    for after in (None, following):
        first, last = delayed(u, jnp.zeros(2), dt, after)
        np.testing.assert_allclose(first, u, atol=1e-12)
        np.testing.assert_allclose(last, u if after is None else after, atol=1e-12)


@pytest.mark.parametrize("delay", [0.07, 0.1, 0.26])
def test_a_simulated_episode_and_the_response_delay_alike(delay):
    plant = extended(PLANT, ["delay"])
    record = simulate(
        plant, "prbs", params={"delay_voltage": delay}, noise={"pitch": 0.0}, steps=60
    )
    params = plant.Params(*PLANT.nominal, jnp.asarray(delay))
    np.testing.assert_allclose(
        response(plant, params, jnp.asarray(record.inputs[:-1])), record.outputs, atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.02, 0.25, 1.05])
def test_a_delay_is_estimated_with_its_interval(delay):
    record = simulate("aero2+delay", "prbs", params={"delay_voltage": delay}, seed=3)
    result = ex.identify(record, "aero2+delay_voltage")
    low, high = result.ci95("delay_voltage")
    assert low - 0.001 < delay < high + 0.001
    assert high - low < 0.002


def extension_by_hand(name: str, value: float) -> tuple:
    """Rates of states and outputs of a DC motor with an extension, in NumPy; states may follow."""
    R, L, K, J, b = (float(p) for p in DCMotor().nominal)
    kind = name.rpartition("_")[0] if not name.startswith("dead") else "dead_zone"

    def rate(x: np.ndarray, u: float) -> list[float]:
        speed, current, *more = x
        extra = []
        if kind == "lag":
            extra, u = [(u - more[0]) / value], more[0]
        u = {
            "offset": u + value,
            "saturation": np.clip(u, -value, value),
            "dead_zone": np.sign(u) * max(abs(u) - value, 0.0),
        }.get(kind, u)
        slower = {
            "coulomb": value * np.tanh(speed / 2.0),
            "drag": value * speed * abs(speed),
        }.get(kind, 0.0)
        if kind == "drift":
            extra = [value]
        torque = (K * current - b * speed) / J - slower
        return [torque, (u - R * current - K * speed) / L, *extra]

    return rate, kind


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lag_voltage", 0.003), ("offset_voltage", -0.4), ("saturation_voltage", 1.5),
        ("dead_zone_voltage", 0.5), ("coulomb_speed", 300.0), ("drag_speed", 0.3),
        ("bias_current", 0.2), ("drift_speed", 30.0),
    ],
)  # fmt: skip
def test_an_extension_is_what_its_name_says(name, value):
    plant = plant_from(f"dc_motor+{name}")
    voltage = 3.0 * np.sin(0.2 * np.arange(60)) * np.linspace(0, 1, 60)
    params = plant.Params(*DCMotor().nominal, jnp.asarray(value))
    found = np.asarray(response(plant, params, jnp.asarray(voltage)[:, None]))
    rate, kind = extension_by_hand(name, value)
    state = np.zeros(2 + (kind in ("lag", "drift")))
    outputs = [state.copy()]
    for u in voltage:
        state = scipy.integrate.solve_ivp(
            lambda t, x, u=u: rate(x, u), (0, 0.001), state, rtol=1e-9, atol=1e-11
        ).y[:, -1]
        outputs.append(state)
    expected = np.array(outputs)[:, :2]
    if kind == "bias":
        expected[:, CHANNELS["current"]] += value
    if kind == "drift":
        expected[:, CHANNELS["speed"]] += np.array(outputs)[:, 2]
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / size, expected / size, atol=2e-3)


def test_extensions_are_named_in_one_order_and_can_be_combined():
    one, other = plant_from("aero2+lag+delay_voltage"), plant_from("aero2+delay+lag")
    assert type(one) is type(other)
    assert one.definition.name == "aero2+delay_voltage+lag_voltage"
    assert type(extended(plant_from("aero2+lag"), ["delay"])) is type(one)
    assert one.definition.parameters[-1].name == "lag_voltage"
    assert "delay_voltage" not in extensions_of(one)
    changed = one.changed(g=1.62, dt=0.05)
    assert type(changed) is type(one)
    assert float(changed.constants.g) == 1.62
    assert changed.substeps == 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("aero2+delay_thrust", "unknown extension of plant 'aero2': 'delay_thrust'; did you mean"),
        ("aero2+", "unknown extension of plant 'aero2': ''"),
        ("aero2+delay+delay_voltage", "plant 'aero2' has 'delay_voltage' already"),
        ("dc_motor+drift", r"there is drift_speed, drift_current\)"),
        ("nothing+delay", "unknown plant 'nothing'"),
        ("aero2+linear_voltage", "'linear_voltage' .*, but the option --hold-input voltage=linear"),
        ("aero2+constant_voltage", "but the option --hold-input voltage=constant"),
        ("aero2+linear_thrust", "unknown extension of plant 'aero2': 'linear_thrust'"),
        ("aero2+lag+outliers", "'outliers' is no extension .*the option --likelihood student"),
    ],
)
def test_an_extension_that_does_not_exist_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        plant_from(name)


def test_a_plant_of_a_file_can_be_extended(tmp_path):
    path = tmp_path / "c++" / "tank.py"
    path.parent.mkdir()
    path.write_text(
        "import excite as ex\n"
        "class Tank(ex.AbstractPlant):\n"
        "    definition = ex.PlantDescription(name='tank', states=(ex.State('level', 'm'),),\n"
        "        inputs=(ex.Input('inflow', 'm³/s', 0.0, 0.02),),\n"
        "        outputs=(ex.Output('level', 'm', 1.0, 0.01),),\n"
        "        parameters=(ex.Parameter('area', 'm²', 1.5),), dt=1.0, band=(0.001, 0.1))\n"
        "    def derivative(self, state, input, params):\n"
        "        return (input - 0.005 * state) / params.area\n"
        "    def output(self, state, params):\n"
        "        return state\n"
    )
    plant = plant_from(f"{path}:Tank+delay")
    assert plant.definition.name == "tank+delay_inflow"
    assert simulate(plant, "prbs", steps=20).outputs.shape == (21, 1)
