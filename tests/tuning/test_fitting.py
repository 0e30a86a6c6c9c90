"""Noise tuned on simulated episodes whose true noise parameters are known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from experiments import exact_model
from jaxslam.tuning import fitting, optimizers, parameters, sequences, standard_errors
from jaxslam.tuning.losses import WeightedLoss, check_loss, innovation_nll, pose_mse, pose_nll
from jaxslam.tuning.tune_state import TuneState

B, STEPS = 8, 12
CONFIG, TRUTH = exact_model.CONFIG, exact_model.true_params()
LOSS = WeightedLoss(((3.0, pose_mse), (1.0, innovation_nll), (0.2, pose_nll)))
P = len(parameters.param_names(TRUTH))
OFF = jax.tree.map(lambda x: x * np.exp(0.7), TRUTH)


@pytest.fixture(scope="module", autouse=True)
def one_device():
    """Each device compiles its own program; `test_batching` asserts that their results agree."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "devices", lambda real=jax.devices: real()[:1])
        yield


def select(episodes, chosen):
    return jax.tree.map(lambda x: x[chosen], episodes)


def flat(noise):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(noise)])


@pytest.fixture(scope="module")
def episodes():
    return exact_model.drives(jax.random.key(3), TRUTH, num_trials=B, num_scans=STEPS)


def tuned(episodes, **changes):
    """Tune from the wrong noise `OFF`."""
    given = {"loss": LOSS, "num_updates": 5} | changes
    return fitting.tune(CONFIG, OFF, episodes, **given)


def test_names_are_those_of_the_parameters_in_their_order():
    names = parameters.param_names(TRUTH)
    assert names[:4] == tuple(f"odometry_coefficients[{i}]" for i in range(4))
    assert names[4:] == ("range_std", "bearing_std", "feature_std_scale", "wall_angle_std")
    mask = parameters.trainable_mask(TRUTH, ("odometry_coefficients", "wall_angle_std"))
    assert mask.tolist() == [False] * 4 + [True] * 3 + [False]
    for i in range(P):
        ratio = flat(parameters.shift_param(TRUTH, i, 0.3)) / flat(TRUTH)
        np.testing.assert_allclose(ratio, np.where(np.arange(P) == i, np.exp(0.3), 1.0))


def test_gradients_agree_with_finite_differences(episodes):
    """Landmark ids are given here: the loss is smooth."""
    _, ours = fitting.gradients(CONFIG, TRUTH, episodes, LOSS)
    step = 1e-5
    for i in range(P):
        up, down = (
            fitting.values(CONFIG, parameters.shift_param(TRUTH, i, by), episodes, LOSS)
            for by in (step, -step)
        )
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(ours[:, i], slope, rtol=2e-5, atol=2e-7, err_msg=str(i))


@pytest.mark.slow
def test_the_likelihood_is_stationary_at_the_true_parameters():
    """The score has mean zero at the truth; 4.5 standard errors."""
    many = exact_model.drives(jax.random.key(4), TRUTH, num_trials=64, num_scans=30)
    _, each = fitting.gradients(CONFIG, TRUTH, many, innovation_nll)
    z = each.mean(axis=0) / (each.std(axis=0, ddof=1) / np.sqrt(len(each)))
    assert np.abs(z).max() < 4.5, z
    _, off = fitting.gradients(CONFIG, OFF, many, innovation_nll)
    assert np.all(off[:, 2:7].mean(axis=0) > 0)  # too large, all of them


def test_tuning_reduces_the_loss_and_keeps_frozen_parameters(episodes):
    found = tuned(episodes, frozen=("odometry_coefficients", "wall_angle_std"))
    assert found.loss[-1] < found.loss[0] and found.best == np.argmin(found.loss)
    np.testing.assert_allclose(
        found.history.odometry_coefficients, np.tile(OFF.odometry_coefficients, (6, 1)), rtol=1e-12
    )
    np.testing.assert_allclose(
        found.params.odometry_coefficients, OFF.odometry_coefficients, rtol=1e-12
    )
    np.testing.assert_allclose(found.params.wall_angle_std, OFF.wall_angle_std, rtol=1e-12)
    moved = flat(found.history)[4 * 6 : -6]
    assert np.abs(np.diff(moved.reshape(3, 6), axis=1)).min() > 0
    assert np.isnan(found.heldout).all() and not found.skipped.any()


def test_an_episode_without_a_finite_loss_is_left_out_and_counted(episodes):
    broken = episodes._replace(odometry=episodes.odometry.copy())
    broken.odometry[2, 4] = np.nan
    rest = select(episodes, [0, 1, 1, 3, 4, 5, 6, 7])
    values, each = fitting.gradients(CONFIG, TRUTH, broken, LOSS)
    assert np.isfinite(values).tolist() == [i != 2 for i in range(B)]
    mean, slope, bad = sequences.mean_gradient(values, each)
    right = fitting.gradients(CONFIG, TRUTH, rest, LOSS)
    keep = np.arange(B) != 2
    np.testing.assert_allclose(mean, right[0][keep].mean())
    np.testing.assert_allclose(slope, right[1][keep].mean(axis=0))
    assert bad == 1
    assert tuned(broken, num_updates=1).skipped.tolist() == [1, 1]
    nothing = sequences.mean_gradient(np.full(2, np.nan), np.zeros((2, 3)))
    assert np.isnan(nothing[0]) and not nothing[1].any() and nothing[2] == 2


@pytest.mark.parametrize("changes", [{}, {"batch_size": 4, "optimizer": optax.adam(0.1)}])
def test_validation_beside_the_gradients_is_that_by_itself(episodes, monkeypatch, changes):
    """The same losses, whichever program evaluates the held-out sequences; one need not be good."""
    some = [0, 1, 6, 7]
    heldout = select(episodes, some)._replace(odometry=episodes.odometry[some].copy())
    heldout.odometry[2, 4] = np.nan
    given = {"heldout": heldout, "num_updates": 2} | changes
    beside = tuned(episodes, **given)
    kept = []
    tuned(episodes, callback=kept.append, **given)
    jax.tree.map(np.testing.assert_array_equal, beside, tuned(episodes, state=kept[0], **given))
    monkeypatch.setattr(fitting, "TOGETHER_STEPS", 0)
    alone = tuned(episodes, **given)
    assert np.isfinite(beside.heldout).all() and not np.isclose(*beside.heldout[:2])
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12), beside, alone)


@pytest.mark.parametrize("stop", [1, 4, 6])
def test_a_resumed_tuning_ends_as_an_uninterrupted_one(episodes, stop):
    seen = []
    whole = tuned(episodes, callback=seen.append, heldout=episodes, evaluate_every=2)
    assert [int(state.step) for state in seen] == list(range(1, 7))
    kept = jax.tree.map(np.asarray, seen[stop - 1])
    again = tuned(episodes, state=kept, heldout=episodes, evaluate_every=2)
    jax.tree.map(np.testing.assert_array_equal, whole, again)
    assert np.isfinite(whole.heldout).tolist() == [True, False, True, False, True, True]


def test_minibatches_take_all_episodes_in_turn():
    for seed in range(3):
        seen = np.concatenate([sequences.draw_batch(seed, step, 12, 5) for step in range(12)])
        assert np.bincount(seen, minlength=12).tolist() == [5] * 12
        orders = [sequences.draw_batch(seed, step, 12, 12) for step in range(2)]
        assert all(order.tolist() == list(range(12)) for order in orders)
    assert not np.array_equal(sequences.draw_batch(0, 0, 12, 5), sequences.draw_batch(1, 0, 12, 5))


def state_of(heldout, loss):
    none = np.zeros(len(loss))
    heldout, loss = np.array(heldout), np.array(loss)
    return TuneState(np.int64(len(loss)), none, (), np.zeros((len(loss), P)), loss, heldout, none)


def test_the_best_is_by_heldout_loss_or_by_training_loss_or_the_last():
    nan = np.nan
    validated = state_of([4.0, nan, 2.0, nan, 3.0], [5.0, 1.0, 4.0, 4.0, 4.0])
    alone = validated._replace(heldout=np.full(5, nan))
    assert fitting.result(validated, TRUTH).best == 2
    assert fitting.result(alone, TRUTH).best == 1
    assert fitting.result(alone, TRUTH, whole=False).best == 4


def test_it_stops_when_the_heldout_loss_no_longer_improves(episodes):
    climbs = tuned(episodes, num_updates=9, heldout=episodes, patience=2, optimizer=optax.sgd(-0.2))
    assert len(climbs.loss) == 3 and climbs.best == 0
    falls = tuned(episodes, num_updates=5, heldout=episodes, patience=2)
    assert len(falls.loss) == 6


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"frozen": ("rnage",)}, "rnage"),
        ({"frozen": parameters.param_names(TRUTH)}, "frozen"),
        ({"batch_size": 0}, "batch_size is 0"),
        ({"patience": 0}, "patience is 0"),
        ({"evaluate_every": -1}, "evaluate_every is -1"),
    ],
)
def test_bad_arguments_are_refused(episodes, changes, message):
    with pytest.raises(ValueError, match=message):
        tuned(episodes, **changes)


def test_episodes_without_the_truth_that_the_loss_needs_are_refused(episodes):
    blind = np.ones((B, STEPS), bool)
    blind[5] = False
    blind = episodes._replace(truth_mask=blind)
    with pytest.raises(ValueError, match="episode 5 has no reference"):
        tuned(blind)
    with pytest.raises(ValueError, match="heldout: episode 5"):
        tuned(episodes, heldout=blind)
    check_loss(innovation_nll, blind)
    with pytest.raises(ValueError, match="no episodes"):
        tuned(select(episodes, slice(0)))
    with pytest.raises(ValueError, match="not positive"):
        fitting.tune(CONFIG, TRUTH._replace(wall_angle_std=jnp.array(0.0)), episodes, loss=LOSS)


def quadratic(monkeypatch, curvatures, centres):
    """Make the loss of episode i (x - c_i)^T A_i (x - c_i) / 2, x the logarithms of the noise."""

    def gradients_of(problem):
        x = np.log(flat(problem.params))
        slopes = np.einsum("bij,bj->bi", curvatures, x - centres)
        return np.einsum("bi,bi->b", slopes, x - centres) / 2, slopes

    monkeypatch.setattr(fitting, "gradients_of", gradients_of)


def test_narrow_valleys_are_followed_to_the_minimum(episodes, monkeypatch):
    """Strongly correlated parameters: 45 updates of L-BFGS find the minimum."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(P, P)))[0]
    a = np.tile(turn * np.geomspace(1e-2, 10.0, P) @ turn.T, (B, 1, 1))
    least = np.log(flat(TRUTH)) + np.linspace(-1.0, 1.0, P)
    quadratic(monkeypatch, a, np.tile(least, (B, 1)))
    found = fitting.tune(CONFIG, TRUTH, episodes, num_updates=45)
    np.testing.assert_allclose(np.log(flat(found.params)), least, atol=0.05)
    # It never continues from a point that is worse than one before.
    thetas = np.log([flat(select(found.history, i)) for i in range(46)])
    for i in range(1, 46):
        before = thetas[np.argmin(found.loss[:i])]
        assert np.abs(thetas[i] - before).max() < optimizers.MAX_CHANGE * (1 + 1e-6)


def test_standard_errors_are_those_of_the_sandwich(episodes, monkeypatch):
    """Against the formula written out, at the minimum of a sum of quadratic losses."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(B, P, P))
    a = root @ root.swapaxes(1, 2) + np.eye(P)
    centres = np.log(flat(TRUTH)) + 0.1 * rng.normal(size=(B, P))
    least = np.linalg.solve(a.sum(axis=0), np.einsum("bij,bj->i", a, centres))
    noise = type(TRUTH)(*map(jnp.asarray, [np.exp(least[:4]), *np.exp(least[4:])]))
    quadratic(monkeypatch, a, centres)
    found = standard_errors.standard_errors(CONFIG, noise, episodes)
    slopes = np.einsum("bij,bj->bi", a, least - centres)
    inverse = np.linalg.inv(a.mean(axis=0))
    right = inverse @ (slopes.T @ slopes / B) @ inverse / B
    np.testing.assert_allclose(found.covariance, right, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.relative, np.sqrt(np.diag(right)), rtol=1e-6)
    assert found.identifiable.all() and found.warnings == ()


def test_a_parameter_without_influence_is_not_identifiable(episodes, monkeypatch):
    a = np.tile(np.diag([2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0]), (B, 1, 1))
    centres = np.log(flat(TRUTH)) + 0.05 * np.random.default_rng(1).normal(size=(B, P))
    quadratic(monkeypatch, a, centres)
    found = standard_errors.standard_errors(CONFIG, TRUTH, episodes, frozen=("wall_angle_std",))
    assert found.identifiable.tolist() == [True] * 6 + [False, False]
    assert np.isinf(found.relative[6]) and np.isnan(found.relative[7])
    warning, _ = found.warnings  # the other: it is not evaluated at the minimum
    assert "feature_std_scale" in warning and "wall_angle_std" not in warning
    assert "8 episodes" in warning


def test_one_episode_gives_no_standard_errors(episodes):
    with pytest.raises(ValueError, match="two episodes"):
        standard_errors.standard_errors(CONFIG, TRUTH, select(episodes, slice(1)))


def test_standard_errors_count_only_the_episodes_with_finite_gradients(episodes, monkeypatch):
    """Two of eight have none: the errors are those of the other six alone."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(B, P, P))
    a = root @ root.swapaxes(1, 2) + np.eye(P)
    centres = np.log(flat(TRUTH)) + 0.1 * rng.normal(size=(B, P))
    six = np.arange(B) >= 2
    quadratic(monkeypatch, a[six], centres[six])
    right = standard_errors.standard_errors(CONFIG, TRUTH, select(episodes, six))
    a[:2] = np.nan
    quadratic(monkeypatch, a, centres)
    found = standard_errors.standard_errors(CONFIG, TRUTH, episodes)
    np.testing.assert_allclose(found.covariance, right.covariance, rtol=1e-12)
    np.testing.assert_allclose(found.relative, right.relative, rtol=1e-12)


@pytest.mark.parametrize("finite", [0, 1])
def test_one_finite_episode_or_none_determines_nothing(episodes, monkeypatch, finite):
    a = np.tile(np.eye(P), (B, 1, 1))
    a[finite:] = np.nan
    quadratic(monkeypatch, a, np.tile(np.log(flat(TRUTH)) + 0.1, (B, 1)))
    found = standard_errors.standard_errors(CONFIG, TRUTH, episodes, frozen=("range_std",))
    assert np.isnan(found.relative[4]) and np.isinf(np.delete(found.relative, 4)).all()
    assert not found.identifiable.any() and f"these {finite} episodes" in found.warnings[0]
