"""Experiments that go on where another one ended: their state, signals, players and campaigns."""

import json
import math
import shutil
from concurrent.futures import Future

import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.environment.falsification import nearness
from excite.excitation import Replay
from excite.information import Past, experiment_information, running_information, start_after
from excite.plant import Aero2
from excite.plant.extension import extended
from excite.record import Record
from excite.rig.contract import Sample
from excite.rig.loop import COMPLETE
from excite.rig.player import Sequel, SequelPlayer, SignalPlayer
from excite.simulation import response
from excite.study.campaign import REACHED, Campaign
from excite.study.campaign_on_rig import _Experiment, _Folder
from excite.study.monitor import Monitor
from excite.study.next_experiment import next_experiment
from excite.study.targets import targets_from

PLANT = Aero2()
TRUE = {"J_p": 0.025, "K_pu": 0.0110, "D_p": 0.0011}
SQUARE = 8.0 * np.sign(np.sin(np.arange(30) + 0.5))[:, None]


def past(pause: int = 5) -> Past:
    """After 30 samples, with room for more, which must not count."""
    room = np.concatenate([SQUARE, np.full((12, 1), 9.0)])
    return Past(jnp.asarray(room), jnp.asarray(30), pause)


# ------------------------------------------------------------------------- state and information


def test_the_state_after_an_experiment_is_that_of_its_simulation():
    params = PLANT.Params(**TRUE)
    start = start_after(PLANT, params, past())
    whole = response(PLANT, params, jnp.asarray(np.concatenate([SQUARE, np.zeros((40, 1))])))
    on = response(PLANT, params, jnp.zeros((40, 1)), start.state)
    np.testing.assert_allclose(on, whole[30:], rtol=0, atol=1e-13)
    for i, name in enumerate(TRUE):
        moved = [
            start_after(PLANT, PLANT.Params(**{**TRUE, name: TRUE[name] * (1 + h)}), past()).state
            for h in (1e-6, -1e-6)
        ]
        slope = (moved[0] - moved[1]) / 2e-6
        np.testing.assert_allclose(start.slope[:, i], slope, rtol=1e-6, atol=1e-9)


def test_the_information_of_two_parts_is_that_of_the_whole_experiment():
    params, later = PLANT.Params(**TRUE), jnp.asarray(-SQUARE[:17])
    first, start = jnp.asarray(SQUARE), start_after(PLANT, params, past())
    whole = running_information(PLANT, params, jnp.concatenate([first, later]))
    gained = running_information(PLANT, params, later, start)
    np.testing.assert_allclose(whole[29][None] + gained, whole[30:], rtol=1e-9)
    other = experiment_information(PLANT, params, later, start=start)
    np.testing.assert_allclose(other, gained[-1], rtol=1e-9)


@pytest.fixture(scope="module")
def known() -> Record:
    return ex.simulate("aero2", "chirp", steps=60, params=TRUE, seed=1)


@pytest.mark.science  # compiles the redesign
def test_a_signal_that_goes_on_is_safe_and_predicted_as_the_whole_experiment(known):
    found = next_experiment(known, target={"D_p": "0.2%"}, steps=30, carry=8, coast=20)
    (made,) = found.candidates
    assert found.chosen is made
    assert len(made.inputs) == 38
    assert not made.inputs[:8].any()
    assert np.ptp(made.inputs[8:]) > 1
    params = PLANT.Params(*(found.known[name].estimate for name in TRUE))
    whole = jnp.concatenate([known.inputs[:-1], made.inputs, np.zeros((20, 1))])
    outputs = response(PLANT, params, whole)
    assert nearness(PLANT, outputs[60:]) <= made.nearness < 0.99
    np.testing.assert_allclose(found.record.outputs, outputs[60:99], atol=1e-9)
    assert found.record.metadata["starts_at_initial_state"] is False
    from_rest = nearness(PLANT, response(PLANT, params, whole[60:]))
    assert abs(from_rest - nearness(PLANT, outputs[60:])) > 0.01  # the state counts


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"carry": 0}, "carry must be a whole number from 1 to 10000: got 0"),
        ({"carry": 5, "ahead": 2}, "ahead is for experiments from rest: it does not go with carry"),
        ({"carry": 5, "policy": "aero2"}, "policy is for experiments from rest"),
    ],
)
def test_what_does_not_go_on_is_one_sentence(known, options, words):
    with pytest.raises(ValueError, match=words):
        next_experiment(known, **options)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"metadata": {}}, "does not say that it begins at rest"),
        ({"plant": extended(PLANT, ["delay"])}, "carry is for plants without input delay"),
        ({"time": np.cumsum([0.0, *[0.1] * 30, 0.3, *[0.1] * 29])}, "is not sampled every 0.1 s"),
    ],
)
def test_a_record_whose_end_is_not_predicted_is_one_sentence(known, changed, words):
    plant = changed.pop("plant", "aero2")
    record = Record(**{**vars(known), **changed})
    with pytest.raises(ValueError, match=words):
        next_experiment(record, plant, {"D_p": "2%"}, carry=5)


def test_a_signal_that_goes_on_is_not_played_from_rest(tmp_path, known):
    about = {**known.metadata, "starts_at_initial_state": False, "provenance": {"design": "next"}}
    Record(**{**vars(known), "metadata": about}).save(tmp_path / "next.csv")
    file, out = tmp_path / "next.csv", tmp_path / "out.csv"
    done = excite("run", "--plant", "aero2", "--input", file, "--fast", "--out", out)
    assert done.returncode == 2
    assert "goes on from the end of a record (--carry): not from rest" in done.stderr
    assert not (tmp_path / "out.csv").exists()


# ------------------------------------------------------------------------------------ players


def test_after_a_player_signals_are_played_and_the_safe_input_between():
    def played(sequel: Sequel, count: int) -> list[float]:
        player = SequelPlayer(SignalPlayer(np.full((4, 1), 1.0)), sequel, np.array([9.0]))
        assert player.num_steps == 20
        return [float(player(k, np.zeros(1))[0]) for k in range(count)]

    whole, cut, followed = Sequel(20), Sequel(20), Sequel(20)
    assert played(whole, 6) == [1, 1, 1, 1, 9, 9]
    cut.end(2)
    assert played(cut, 4) == [1, 1, 9, 9]
    followed.end(2)
    followed.begin(5, np.array([[3.0], [4.0]]))
    assert played(followed, 9)[4:] == [9, 3, 4, 9, 9]
    followed.end(6)
    assert played(followed, 9)[4:] == [9, 3, 9, 9, 9]


# ---------------------------------------------------------------------------------- campaigns


def carried(**options) -> Campaign:
    """A campaign without a policy; its robust signal takes a minute, and is another one here."""
    usual = {"policy": "none", "steps": 60, "coast": 20, "rounds": 4, "carry": 8}
    campaign = Campaign("aero2", {"D_p": "0.5%"}, **{**usual, **options})
    campaign.opening = Replay(jnp.asarray(SQUARE))
    return campaign


def asked_of(campaign: Campaign) -> np.ndarray:
    """The signal that is to be played next."""
    asked = campaign.ask()
    assert isinstance(asked, Replay)
    return np.asarray(asked.inputs)


def measured(inputs: np.ndarray) -> Record:
    """From rest, with the same noise at the same sample."""
    y = np.asarray(response(PLANT, PLANT.Params(**TRUE), jnp.asarray(inputs)))
    y = y + 2e-4 * np.random.default_rng(0).normal(size=(500, 1))[: len(y)]
    return Record(0.1 * np.arange(len(y)), np.concatenate([inputs, np.zeros((1, 1))]), y)


@pytest.mark.science  # compiles the redesign
def test_a_later_round_goes_on_where_the_last_one_ended():
    campaign = carried()
    assert not campaign.continues
    inputs = asked_of(campaign)
    first = campaign.tell(measured(inputs))
    asked = asked_of(campaign)
    assert campaign.continues
    assert campaign.playing == "redesigned, without rest"
    assert asked.shape == (68, 1)
    assert not asked[:8].any()
    inputs = np.concatenate([inputs, asked])
    second = campaign.tell(measured(inputs))
    assert (first.num_samples, second.num_samples, campaign.num_samples) == (30, 68, 98)
    assert [len(r.time) for r in campaign.records] == [99]
    assert first.nearness < 1
    assert second.nearness < 1
    assert campaign.reason == REACHED
    assert abs(campaign.known["D_p"].estimate - TRUE["D_p"]) < 0.01 * TRUE["D_p"]
    samples, halves = campaign.knowledge()
    assert len(samples) == 98
    assert halves[-1, 2] <= 0.005 * campaign.known["D_p"].estimate


@pytest.mark.science
def test_after_a_rest_a_round_begins_there():
    campaign = carried()
    inputs = asked_of(campaign)
    campaign.tell(measured(inputs))
    campaign.rest()
    assert not campaign.continues
    asked = asked_of(campaign)
    assert campaign.playing == "redesigned"
    assert asked.shape == (60, 1)
    campaign.tell(measured(asked))
    assert [len(r.time) for r in campaign.records] == [31, 61]
    assert [r.num_samples for r in campaign.rounds] == [30, 60]


def test_a_rival_with_delay_is_played_from_rest():
    campaign = carried()
    campaign.tell(measured(SQUARE))
    assert campaign.continues
    campaign.plant = extended(PLANT, ["delay"])
    assert not campaign.continues


def test_the_pause_is_safe_as_the_coast():
    assert carried(coast=20, carry=30).coast == 30


@pytest.mark.slow
def test_a_part_of_a_record_is_not_told_as_a_round_from_rest():
    campaign = carried()
    campaign.tell(measured(SQUARE))
    campaign.playing = "redesigned, without rest"
    other = measured(-SQUARE)
    with pytest.raises(ValueError, match="tell the record of everything since rest"):
        campaign.tell(other)
    campaign.rest()
    assert campaign.tell(other).num_samples == 30


@pytest.mark.slow
def test_a_round_that_goes_on_is_judged_with_the_input_that_is_held(monkeypatch):
    for at_once, played in ((True, 0.0), (False, 7.0)):
        before = {"J_p": "lognormal:0.024:5%"}
        monitor = Monitor(
            PLANT, before, targets_from(PLANT, {"D_p": "1%"}), 20, 5, True, 0.3, math.inf,
            ends_at_once=at_once,
        )  # fmt: skip
        judged: list[np.ndarray] = []

        def after(*_, own=monitor, told=judged) -> float:
            told.append(own._inputs[:, 0].copy())
            return 0.0

        monkeypatch.setattr(monitor, "_after", after)
        for k in range(12):
            y = np.asarray(measured(SQUARE).outputs[k])
            monitor(Sample(PLANT.description, 20, k, 0.1 * k, y, np.full(1, 7.0)))
        monitor.close()
        assert judged[-1][11] == played
        assert judged[-1][10] == 7.0
        assert not judged[-1][12:].any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"carry": 0}, "carry must be a whole number from 1 to 10000: got 0"),
        ({"redesign": False}, "carry needs redesigned signals: others begin at rest"),
    ],
)
def test_a_campaign_that_cannot_go_on_is_one_sentence(options, words):
    with pytest.raises(ValueError, match=words):
        carried(**options)


def test_a_guard_does_not_go_on(tmp_path):
    with pytest.raises(ValueError, match="it does not go with carry"):
        ex.campaign("aero2", {"D_p": "1%"}, policy="aero2", guard=True, carry=9, out=tmp_path / "c")
    assert not (tmp_path / "c").exists()


@pytest.fixture
def opening(monkeypatch):
    """The first signal of campaigns on rigs, without its design."""
    monkeypatch.setattr(Campaign, "opening", Replay(jnp.asarray(SQUARE)))
    monkeypatch.setattr(Campaign, "require_reachable", lambda *_, **__: None)


def played(folder, damping: str = "0.2%", **options):
    usual = {"policy": "none", "steps": 40, "coast": 20, "rounds": 5, "carry": 8, "fast": True}
    target = {"J_p": "0.05%", "K_pu": "0.05%", "D_p": damping}
    return ex.campaign("aero2", target, out=folder, seed=5, **{**usual, **options})


@pytest.mark.science  # compiles the redesign
def test_rounds_without_rest_are_one_record_and_are_resumed(tmp_path, opening):
    made = played(tmp_path / "c")
    assert made.reason == REACHED
    assert len(made.rounds) > 1
    assert {r.played for r in made.rounds[1:]} == {"redesigned, without rest"}
    assert max(r.nearness for r in made.rounds) < 1
    assert [p.name for p in sorted((tmp_path / "c").glob("*.csv"))] == [
        "knowledge.csv", "round-01.csv",
    ]  # fmt: skip
    assert (tmp_path / "c" / "round-02").is_dir()  # the run folder of what both rounds tell
    record = ex.read_record(tmp_path / "c" / "round-01.csv")
    total = sum(r.num_samples for r in made.rounds)
    assert total <= len(record.time) - 1 <= total + 8
    again = played(tmp_path / "c")
    assert again.to_dict() == made.to_dict()
    page = ex.report(tmp_path / "c")
    assert page.count("<svg") == 2  # what was known, and one record
    for other in (None, 5):
        with pytest.raises(ValueError, match=f"is another campaign, with carry 8 and not {other}"):
            played(tmp_path / "c", carry=other)
    # Killed while the second round was played: it is told as far as it went, and none is repeated.
    shutil.copytree(tmp_path / "c", tmp_path / "k")
    (tmp_path / "k" / "knowledge.csv").unlink()
    about = json.loads((tmp_path / "k" / "campaign.json").read_text())
    about.update(rounds=about["rounds"][:1], reason="", playing="redesigned, without rest")
    (tmp_path / "k" / "campaign.json").write_text(json.dumps(about))
    csv = (tmp_path / "k" / "round-01.csv").read_bytes().splitlines(keepends=True)
    first = made.rounds[0].num_samples
    (tmp_path / "k" / "round-01.csv").write_bytes(b"".join(csv[: first + 20]))
    sidecar = json.loads((tmp_path / "k" / "round-01.json").read_text())
    del sidecar["ended"]
    (tmp_path / "k" / "round-01.json").write_text(json.dumps(sidecar))
    on = played(tmp_path / "k")
    assert [r.num_samples for r in on.rounds[:2]] == [first, 18]
    assert on.rounds[0].to_dict() == made.rounds[0].to_dict()
    assert on.rounds[1].ended == "interrupted"
    assert on.rounds[1].played == "redesigned, without rest"
    assert (tmp_path / "k" / "round-03.csv").exists()
    assert not (tmp_path / "k" / "round-02.csv").exists()
    assert on.rounds[2].played == "redesigned"
    assert on.reason == REACHED
    # Killed before the first round was written down: it is one round, with its pause.
    shutil.copytree(tmp_path / "k", tmp_path / "e")
    for path in (tmp_path / "e").glob("round-03*"):
        path.unlink() if path.is_file() else shutil.rmtree(path)
    about.update(rounds=[], playing="robust")
    (tmp_path / "e" / "campaign.json").write_text(json.dumps(about))
    (tmp_path / "e" / "round-01.csv").write_bytes(b"".join(csv[: first + 6]))
    early = played(tmp_path / "e")
    assert [r.num_samples for r in early.rounds[:1]] == [first + 4]
    assert (tmp_path / "e" / "round-02.csv").exists()
    # A trip in the pause counts, although the round was written down as complete.
    about.update(rounds=[made.rounds[0].to_dict()])
    shutil.rmtree(tmp_path / "e")
    shutil.copytree(tmp_path / "k", tmp_path / "e")
    for path in (tmp_path / "e").glob("round-03*"):
        path.unlink() if path.is_file() else shutil.rmtree(path)
    (tmp_path / "e" / "campaign.json").write_text(json.dumps(about))
    (tmp_path / "e" / "round-01.csv").write_bytes(b"".join(csv[: first + 6]))
    sidecar["ended"] = {"reason": "a level", "trip": "level"}
    (tmp_path / "e" / "round-01.json").write_text(json.dumps(sidecar))
    tripped = played(tmp_path / "e")
    assert [r.num_samples for r in tripped.rounds] == [first, 4]
    assert tripped.reason == "unsafe: a level"


@pytest.mark.science
def test_a_round_that_ended_too_early_is_followed_by_a_whole_one(tmp_path, opening, monkeypatch):
    monkeypatch.setattr(Monitor, "__call__", lambda _, sample: sample.k >= 19)
    made = played(tmp_path / "c", "0.01%", rounds=3)
    assert [(r.num_samples, r.ended) for r in made.rounds] == [
        (20, REACHED), (48, "complete"), (9, REACHED),
    ]  # fmt: skip
    assert made.round_rows()[0][-1].startswith("ended early by the running estimate; go on")


def test_a_decision_that_comes_too_late_ends_the_experiment(tmp_path):
    def going_on(decision: Future, k: int) -> tuple[_Experiment, Sequel]:
        folder = _Folder(tmp_path, {}, "")
        experiment = _Experiment(carried(), folder, lambda _: None, lambda *_: None)
        experiment._waits, experiment._end = False, 30
        sequel = Sequel(200)
        experiment._go_on(sequel, decision, k)
        return experiment, sequel

    pending, ready, ended = Future(), Future(), Future()
    ready.set_result(np.full((5, 1), 3.0))
    ended.set_result(None)
    for k in range(30, 37):  # the pause is from 30 to 37
        assert not going_on(pending, k)[0]._stop.reason
        assert going_on(ready, k)[1].input(38) is None
    late, sequel = going_on(pending, 37)
    assert late.is_late
    assert late._stop.reason == COMPLETE
    assert sequel.input(38) is None
    in_time, sequel = going_on(ready, 37)
    assert not in_time.is_late
    assert not in_time._stop.reason
    assert [sequel.input(k) for k in (37, 38, 42, 43)] == [None, 3.0, 3.0, None]
    assert going_on(ended, 31)[0]._stop.reason == COMPLETE
