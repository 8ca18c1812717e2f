"""`driftjax simulate`: what it writes reads back, hides the truth, and repeats; what it refuses, in one sentence."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from driftjax.cli import main
from driftjax.diagnosis.parity import parity
from driftjax.logs import read_log
from driftjax.manoeuvres import campaign
from driftjax.manoeuvres.campaign import Campaign, drive_manoeuvre, record_runs, typical_conditions
from driftjax.manoeuvres.library import MANOEUVRES
from driftjax.manoeuvres.truth import effect_strengths
from driftjax.sim.log_flaws import dropouts
from driftjax.vehicle import EstimatedNoise, PerChannel, load_vehicle, with_effects
from driftjax.vehicle.effect import EFFECTS

SEDAN = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0)
NEUTRAL = effect_strengths(SEDAN, ())
NAMES = ("grip_sine", "slalom", "step_steer", "throttle_steps", "coast_down", "slalom", "grip_sine")
SHORT = Campaign(NAMES, duration=2.0)
FLAGS = ["simulate", "--manoeuvres", *NAMES, "--duration", "2"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Every test works in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def signals(runs, *names: str) -> np.ndarray:
    return np.stack([np.stack([getattr(run, name) for name in names], axis=1) for run in runs])


def test_noise_is_as_asked_and_beside_the_truth():
    runs, truth = record_runs(SEDAN, NEUTRAL, dataclasses.replace(SHORT, noise=2.0))
    error = signals(runs, "V", "beta", "r") - np.stack([truth.states[run.name] for run in runs])
    np.testing.assert_allclose(error.std((0, 1)), 2 * np.array([0.05, 0.0087, 0.0087]), rtol=0.08)
    np.testing.assert_allclose(error.std((0, 1)), list(truth.noise.values()), rtol=0.08)
    turned = np.stack([run.extra["psi"][-1] - np.sum(truth.states[run.name][:-1, 2]) / 100 for run in runs])
    assert np.abs(turned).max() < 0.05


def test_an_extended_car_keeps_its_effects():
    own = with_effects(SEDAN, {"friction_rear": {"p": -0.1}, "steer_lag": {"tau": 0.05}})
    theta = effect_strengths(own, ["steer_lag.tau=0.1"])
    np.testing.assert_allclose(theta, effect_strengths(SEDAN, ["friction_rear.p=-0.1", "steer_lag.tau=0.1"]))
    short = dataclasses.replace(SHORT, manoeuvres=SHORT.manoeuvres[:1])
    (run,), truth = record_runs(own, theta, short)
    (plain,), _ = record_runs(SEDAN, theta, short)
    assert truth.effects == {"friction_rear": {"p": -0.1}, "steer_lag": {"tau": 0.1}}
    np.testing.assert_array_equal(run.beta, plain.beta)


@pytest.mark.parametrize(
    ("effects", "shown"),
    [((), None), (("friction_rear.p=-0.15", "aero_drag=2"), None), (("road_bank.phi=0.05",), 0.05 * 9.81)],
    ids=["nothing", "physics", "road"],
)
def test_accelerations_tell_the_motion_but_for_the_pull_of_the_road(effects, shown):
    runs, _ = record_runs(SEDAN, effect_strengths(SEDAN, effects), SHORT)
    result = parity(SEDAN, runs, np.array([0.05, 0.0087, 0.0087]))
    assert result is not None and result.num == len(NAMES) * 6
    V, beta = np.moveaxis(signals(runs, "V", "beta"), -1, 0)
    if shown is None:
        np.testing.assert_allclose(result.rms / result.floor, 1.0, atol=0.35)
        assert "agree within noise" in result.statement
        assert abs(result.mean[1]) < 0.015
    else:
        assert result.z[1] > 4 and "the road" in result.statement
        assert result.mean[1] == pytest.approx(np.mean(shown * np.cos(beta) / V), abs=0.015)


def test_accelerations_of_a_car_faster_than_its_log_tell_its_motion_too():
    """Between two rows the RC car answers to a command and has nearly settled again."""
    rc = dataclasses.replace(load_vehicle("rc"), combined_slip=1.0)
    runs, _ = record_runs(rc, NEUTRAL, dataclasses.replace(SHORT, noise=0.0))
    result = parity(rc, runs, np.asarray(typical_conditions(rc).sigma))
    assert result is not None
    assert (result.rms < np.array([0.3, 0.6]) * result.floor).all() and np.abs(result.mean).max() < 5e-3, result


NOISE = EstimatedNoise(PerChannel(0.02, 0.001, 0.03), PerChannel(2.0, 0.05, 0.2), 0.05)


def test_stochastic_runs_have_the_noise_that_a_diagnosis_found():
    noisy = dataclasses.replace(SEDAN, noise=NOISE)
    stochastic = dataclasses.replace(SHORT, stochastic=True)
    runs, truth = record_runs(noisy, NEUTRAL, stochastic)
    assert truth.process_noise == {"V": 2.0, "beta": 0.05, "r": 0.2, "correlation": 0.05}
    error = signals(runs, "V", "beta", "r") - np.stack([truth.states[run.name] for run in runs])
    np.testing.assert_allclose(error.std((0, 1)), [0.02, 0.001, 0.03], rtol=0.08)
    _, still = record_runs(noisy, NEUTRAL, dataclasses.replace(stochastic, process_noise=0.0))
    pushed = np.diff(truth.states["coast_down-5"][:, 0] - still.states["coast_down-5"][:, 0]) * 100  # m/s^2
    assert pushed.std() == pytest.approx(2.0, rel=0.35)  # of 40 correlation times
    again, _ = record_runs(noisy, NEUTRAL, stochastic)
    np.testing.assert_array_equal(signals(again, "V"), signals(runs, "V"))
    other, _ = record_runs(noisy, NEUTRAL, dataclasses.replace(stochastic, seed=1))
    assert np.abs(signals(other, "V") - signals(runs, "V")).max() > 0.1


def test_stochastic_runs_need_a_car_with_noise(capsys):
    assert main([*FLAGS, "--stochastic", "--out", "s"]) == 2
    assert "its file has no key 'noise', which stochastic runs need" in capsys.readouterr().err
    assert not Path("s").exists()


def test_noise_of_the_rc_car_follows_its_size():
    np.testing.assert_allclose(typical_conditions(load_vehicle("rc")).sigma, [0.02, 0.0087, 0.03], rtol=0.3)


def test_without_noise_and_disturbance_a_log_is_the_truth_but_for_effects():
    still = dataclasses.replace(SHORT, noise=0.0, process_noise=0.0)
    plain, truth = record_runs(SEDAN, NEUTRAL, still)
    np.testing.assert_array_equal(signals(plain, "V", "beta", "r"), np.stack(list(truth.states.values())))
    theta = effect_strengths(SEDAN, ("friction_front.p=-0.1", "gyro_bias=1"))
    changed, truth = record_runs(SEDAN, theta, still)
    scale = EFFECTS["gyro_bias"].parameters[0].scale(SEDAN)
    assert truth.effects["friction_front"] == {"p": -0.1}
    assert truth.effects["gyro_bias"]["p"] == pytest.approx(scale)
    noise_difference = signals(changed, "r")[..., 0] - np.stack(list(truth.states.values()))[..., 2]
    np.testing.assert_allclose(noise_difference, scale, atol=1e-12)
    assert np.abs(signals(changed, "beta") - signals(plain, "beta")).max() > 1e-4


def test_side_by_side_is_as_one_by_one(monkeypatch):
    few = {name: EFFECTS[name] for name in ("friction", "gyro_bias")}
    monkeypatch.setattr(campaign, "EFFECTS", few)  # compiles sooner
    names, t = ("drift", "slalom", "coast_down"), np.arange(100) / 100
    drives = [MANOEUVRES[name](SEDAN, np.random.default_rng(i), t) for i, name in enumerate(names)]
    stack = lambda some: jax.tree.map(lambda *a: jnp.stack(a), *some)
    one = lambda drive, seed: drive_manoeuvre(
        SEDAN, jnp.array([-0.5, 1.0]), drive, typical_conditions(SEDAN), seed, 0.01
    )
    together, run = jax.jit(jax.vmap(one))(stack(drives), jnp.arange(3)), jax.jit(one)
    for i, drive in enumerate(drives):
        for a, b in zip(jax.tree.leaves(run(drive, jnp.array(i))), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-9, atol=1e-9)


def test_dropouts_and_outliers_have_their_shares():
    spoilt, truth = record_runs(SEDAN, NEUTRAL, dataclasses.replace(SHORT, dropouts=0.1, outliers=0.05))
    y = signals(spoilt, "V", "beta", "r")
    gone = np.isnan(y)
    assert (gone.all(-1) == gone.any(-1)).all() and 0.04 < gone.mean() < 0.18
    off = np.abs(y - np.stack(list(truth.states.values()))) / typical_conditions(SEDAN).sigma > 6
    assert 0.03 < off[~gone].reshape(-1).mean() < 0.07
    assert np.isfinite(signals(spoilt, "delta", "Fxr")).all()
    lost = dropouts(np.random.default_rng(0), 100_000, 0.2)
    assert lost.mean() == pytest.approx(0.2, rel=0.1)
    assert lost.sum() / np.sum(np.diff(lost.astype(int)) == 1) == pytest.approx(5, rel=0.1)


def test_runs_that_are_lost_are_drawn_again_then_left_out(monkeypatch, capsys):
    monkeypatch.setattr(campaign, "SLOWEST", 3.2)  # only some fast coasting passes
    names = ["coast_down"] * 5 + ["slalom"] * 2
    assert main(["simulate", "--manoeuvres", *names, "--duration", "2", "--out", "a"]) == 0
    said = capsys.readouterr().out
    assert "slalom-6: the car spun or came to a stop in every draw; the run was left out." in said
    assert yaml.safe_load(Path("a/truth.yaml").read_text())["left_out"] == ["slalom-6", "slalom-7"]
    assert [run.name for run in read_log([Path("a/log.csv")]).runs] == [f"coast_down-{i}" for i in range(1, 6)]
    monkeypatch.setattr(campaign, "SLOWEST", 9.0)
    assert main([*FLAGS, "--out", "b"]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1 and not Path("b/log.csv").exists()


def test_the_log_reads_back_repeats_and_hides_the_truth(capsys):
    Path("c.yaml").write_text("seed: 3\neffects: [friction.p=0.05]\nmanoeuvres: [drift]\n")
    flags = [*FLAGS, "--config", "c.yaml", "--effects", "friction_front=-1", "--effects", "load_transfer_long.h=0.5"]
    assert main([*flags, "--out", "one"]) == main([*flags, "--out", "two"]) == 0
    assert main([*flags, "--seed", "4", "--out", "other"]) == 0
    log = {name: Path(name, "log.csv").read_bytes() for name in ("one", "two", "other")}
    assert log["one"] == log["two"] != log["other"]
    assert set(log["one"].splitlines()[0].decode().split(",")) == set(
        "t V beta r delta Fxr x y psi ax ay s run".split()
    )
    runs = read_log([Path("one/log.csv")]).runs
    assert [run.name for run in runs] == [f"{name}-{i + 1}" for i, name in enumerate(NAMES)]
    theta = effect_strengths(SEDAN, ("friction.p=0.05", "friction_front=-1", "load_transfer_long.h=0.5"))
    made, _ = record_runs(SEDAN, theta, dataclasses.replace(SHORT, seed=3))
    for a, b in zip(runs, made, strict=True):
        np.testing.assert_array_equal(a.V, b.V)
        np.testing.assert_array_equal(a.extra["s"], b.extra["s"])
    truth = yaml.safe_load(Path("one/truth.yaml").read_text())
    strong = {"friction": {"p": 0.05}, "friction_front": {"p": -0.06}, "load_transfer_long": {"h": 0.5}}
    assert truth["effects"] == strong
    assert (truth["seed"], truth["vehicle"], truth["left_out"]) == (3, "sedan", [])
    assert b"friction" not in log["one"]
    assert main(["runs", "--root", "."]) == 0 and "simulate" in capsys.readouterr().out


def test_an_extended_car_is_simulated_with_its_effects_and_ellipse():
    nominal = {k: v for k, v in dataclasses.asdict(SEDAN).items() if k not in ("effects", "covariance", "noise")}
    effects_written = {"friction": {"p": 0.05}, "gyro_bias": {"p": {"value": 0.01, "ci95_half": 0.002}}}
    Path("extended.yaml").write_text(yaml.safe_dump({"nominal": nominal, "effects": effects_written}))
    flags = [*FLAGS, "--vehicle", "extended.yaml", "--effects", "friction.p=-0.05"]
    assert main([*flags, "--out", "e"]) == 0
    truth = yaml.safe_load(Path("e/truth.yaml").read_text())
    assert truth["effects"] == {"friction": {"p": -0.05}, "gyro_bias": {"p": 0.01}} and truth["combined_slip"] == 1.0


BAD = {
    "--effects frction=1": "effect 'frction': no such effect",
    "--effects friction.q=1": "has no parameter 'q'; it has p.",
    "--effects friction": "effect 'friction': there is no number",
    "--effects friction.p=nan": "there is no number",
    "--effects friction.p=0.9": "the value lies in -0.84..0.6.",
    "--effects load_transfer_long=-1": "the value lies in 0..4 typical sizes.",
    "--manoeuvres loop": "has 'loop'; choose from drift, steady_drift",
    "--manoeuvres": "name one at least",
    "--duration 0": "key 'duration' is 0.0",
    "--rate 5": "key 'rate' is 5.0",
    "--noise -1": "key 'noise' is -1.0",
    "--dropouts 0.9": "key 'dropouts' is 0.9",
    "--seed -1": "key 'seed' is -1",
    "--vehicle tram": "tram: no such file",
    "--combined-slip 2": "key 'combined_slip' is 2.0",
    "--config absent.yaml": "absent.yaml: no such file",
    "--config bad.yaml": "unknown key 'lenght'",
    "--out taken": "exists already; give another folder (--out).",
    "--out file/run": "give another folder (--out)",
}


@pytest.mark.parametrize("flags", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(flags, here, capsys):
    Path("taken").mkdir()
    Path("taken/log.csv").write_text("mine")
    Path("bad.yaml").write_text("lenght: 3\n")
    Path("file").write_text("mine")
    before = sorted(here.rglob("*"))
    assert main(["simulate", *flags.split()]) == 2
    output = capsys.readouterr()
    lines = output.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].endswith(".") and BAD[flags] in lines[0], output.err
    assert output.out == "" and sorted(here.rglob("*")) == before
